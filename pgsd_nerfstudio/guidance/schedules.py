"""What changes in the course of training: the noise level of distillation, and the strength of regularization.

Values from the paper's supplement, "Implementation Details".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch


@dataclass(frozen=True, kw_only=True)
class TimestepSchedule:
    """Noise levels, drawn uniformly from t_min .. t_max, where t_max falls linearly: coarse matters first, detail later."""

    t_min: int = 20
    """Smallest timestep."""
    t_max_first: int = 980
    """Largest timestep at the start of training."""
    t_max_last: int = 740
    """Largest timestep at its end."""

    def __post_init__(self) -> None:
        if not 0 <= self.t_min <= min(self.t_max_first, self.t_max_last):
            raise ValueError(
                f"timesteps need 0 <= t_min <= t_max, got t_min {self.t_min}, t_max {self.t_max_first} to {self.t_max_last}"
            )

    def t_max(self, step: int, steps: int) -> int:
        """Largest timestep (inclusive) at training step `step` of `steps`."""
        progress = min(max(step / max(steps - 1, 1), 0.0), 1.0)
        return round(self.t_max_first + progress * (self.t_max_last - self.t_max_first))

    def sample(self, step: int, steps: int, generator: torch.Generator) -> int:
        """A timestep for training step `step` of `steps`."""
        return int(torch.randint(self.t_min, self.t_max(step, steps) + 1, (), generator=generator))


Weighting = Literal["adaptive", "constant"]
"""adaptive: every regularization weight times |L_SDS|, so that physics holds tighter where the video prior pulls harder.
constant: the weights as they are."""


def regularization_scale(weighting: Weighting, sds_loss: float) -> float:
    """Factor on all regularization weights, given the magnitude of the distillation loss in this step.

    Raises:
        ValueError: the magnitude is no finite, non-negative number, or the weighting is unknown.
    """
    if not (math.isfinite(sds_loss) and sds_loss >= 0):
        raise ValueError(f"|L_SDS| must be finite and not negative, got {sds_loss}")
    if weighting == "adaptive":
        return sds_loss
    if weighting == "constant":
        return 1.0
    raise ValueError(f"the weighting must be adaptive or constant, got {weighting!r}")
