"""What changes in the course of training: the noise level of distillation, and the strength of regularization.

Values from the paper's supplement: "Implementation Details" for timesteps, "Scheduler Comparison" for the weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch


@dataclass(frozen=True, kw_only=True)
class TimestepSchedule:
    """Noise levels, drawn uniformly from t_min .. t_max, where t_max falls linearly: coarse matters first, detail later."""

    t_min: int = 20
    """Smallest timestep."""
    t_max_first: int = 980
    """Largest timestep at the start of training."""
    t_max_last: int = 740
    """Largest timestep at the end of training."""

    def __post_init__(self) -> None:
        if not 0 <= self.t_min <= min(self.t_max_first, self.t_max_last):
            raise ValueError(
                f"timesteps need 0 <= t_min <= t_max, got t_min {self.t_min}, t_max {self.t_max_first} to {self.t_max_last}"
            )

    def t_max(self, step: int, steps: int) -> int:
        """Largest timestep (inclusive) at one step of a training.

        Args:
            step: training step, counted from 0; one past the end counts as the last.
            steps: length of the training.
        """
        progress = min(max(step / max(steps - 1, 1), 0.0), 1.0)
        return round(self.t_max_first + progress * (self.t_max_last - self.t_max_first))

    def sample(self, step: int, steps: int, generator: torch.Generator) -> int:
        """A timestep for one step of a training.

        Args:
            step: training step, counted from 0.
            steps: length of the training.
            generator: source of the draw.
        """
        return int(torch.randint(self.t_min, self.t_max(step, steps) + 1, (), generator=generator))


Weighting = Literal["adaptive", "constant", "linear", "exponential", "cosine"]
"""adaptive: every regularization weight times |L_SDS|, so that physics holds tighter where the video prior pulls harder.
constant: the weights as they are. linear, exponential, cosine: the weights times a factor that falls in the course of training,
whatever the video prior says; the paper's supplement finds all three worse than adaptive."""


@dataclass(frozen=True, kw_only=True)
class WeightDecay:
    """How far the fixed schedules fall. The paper gives the values of lambda itself, for |L_SDS| of its clips of 720x480."""

    first: float = 1e6
    """Factor at the first step; 1e6 as in the paper."""
    last: float = 1e2
    """Factor at the last step of linear and cosine; 1e2 as in the paper."""
    rate: float = 0.995
    """Base of the exponential, first rate^iteration for a training of 1000 iterations, as in the paper; a training of another
    length takes the same course in its own number of steps. The paper names no end: rate^1000 is 0.0067."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.first) and 0 <= self.last <= self.first):
            raise ValueError(f"a decay of weights needs 0 <= last <= first, got first {self.first:g}, last {self.last:g}")
        if not 0 < self.rate <= 1:
            raise ValueError(f"the rate of an exponential decay must lie in 0-1, got {self.rate:g}")


PAPER_DECAY = WeightDecay()
PAPER_ITERATIONS = 1000


def regularization_scale(
    weighting: Weighting,
    sds_loss: float,
    step: int | None = None,
    steps: int | None = None,
    *,
    decay: WeightDecay = PAPER_DECAY,
) -> float:
    """Factor on all regularization weights in this step.

    Args:
        weighting: kind of schedule.
        sds_loss: magnitude of the distillation loss in this step; judged always, used by adaptive.
        step: training step, counted from 0; needed by linear, exponential and cosine. A step past the end counts as the last.
        steps: length of the training, 1 or more; needed by the same.
        decay: where those three begin and end.

    Raises:
        ValueError: the magnitude is no finite, non-negative number, the weighting is unknown, or step and steps are missing.
    """
    if not (math.isfinite(sds_loss) and sds_loss >= 0):
        raise ValueError(f"|L_SDS| must be finite and not negative, got {sds_loss}")
    if weighting == "adaptive":
        return sds_loss
    if weighting == "constant":
        return 1.0
    if weighting not in get_args(Weighting):
        known = ", ".join(get_args(Weighting)[:-1])
        raise ValueError(f"the weighting must be {known} or {get_args(Weighting)[-1]}, got {weighting!r}")
    if step is None or steps is None or step < 0 or steps < 1:
        raise ValueError(
            f"{weighting} weights need the training step (0 or more) and the number of steps (1 or more), got {step} of {steps}"
        )
    if weighting == "exponential":
        return decay.first * decay.rate ** (PAPER_ITERATIONS * min(step, steps) / steps)
    progress = min(step / max(steps - 1, 1), 1.0)
    remaining = 1.0 - progress if weighting == "linear" else 0.5 + 0.5 * math.cos(math.pi * progress)
    return decay.last + remaining * (decay.first - decay.last)
