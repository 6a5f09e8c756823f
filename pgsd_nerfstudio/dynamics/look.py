"""Changes of appearance: of single particles against their initial look, and the one shift that all particles share.

Opacity changes linearly within 0..1, scale as a factor (its logarithm adds up) within 1/8..8 of the initial one, colour
linearly within 0..1. A change of zero leaves every bit of the initial look as it is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook

LOG_SCALE_BOUND = math.log(8.0)
LOGIT_BOUND = 6.0
OPACITY_UNIT, COLOUR_UNIT = 3.0, 2.0  # one number moves a look as far as another: an optimizer moves all alike


class Change(NamedTuple):
    """Change of the appearance of n particles."""

    opacity: Float[Tensor, " n"]
    log_scale: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]

    @staticmethod
    def none(count: int, like: Tensor) -> Change:
        """No change of `count` particles; device and dtype of `like`."""
        return Change(like.new_zeros(count), like.new_zeros(count, 3), like.new_zeros(count, 3))

    def times(self, factor: Float[Tensor, " n"]) -> Change:
        return Change(self.opacity * factor, self.log_scale * factor[:, None], self.rgb * factor[:, None])


def changed(look: ParticleLook, change: Change) -> ParticleLook:
    """The look with the change applied."""
    return ParticleLook(look.opacity + change.opacity, look.scales * change.log_scale.exp(), look.rgb + change.rgb)


def accumulate(look: ParticleLook, change: Change, delta: Change) -> Change:
    """`change` + `delta`, kept where the look it applies to stays within its bounds."""
    return Change(
        clamp(change.opacity + delta.opacity, -look.opacity, 1 - look.opacity),
        clamp(change.log_scale + delta.log_scale, -LOG_SCALE_BOUND, LOG_SCALE_BOUND),
        clamp(change.rgb + delta.rgb, -look.rgb, 1 - look.rgb),
    )


class LearnedLook(nn.Module):
    """One shift of the look for all active particles and one for all collided ones: 2 x (opacity 1, scale 3, colour 3).

    The paper says that the initial appearance itself is optimized; a shift that all share moves it coherently and with few
    numbers, while the field adds the differences by place and time. Zero, its start, is the initial look bit for bit.

    Size changes at constant matter: a flake twice as wide has a quarter of the odds of being opaque. Otherwise the two hide
    each other: a flake that is too faint gains as much light by growing as by thickening, and descent would grow it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.active = nn.Parameter(torch.zeros(7))
        """Logit of the opacity, logarithm of the three scales, colour, in the units of OPACITY_UNIT, 1 and COLOUR_UNIT."""
        self.collided = nn.Parameter(torch.zeros(7))

    def forward(self, look: InitialLook) -> InitialLook:
        """The initial look, shifted."""
        active, collided = _shifted(look.active, self.active), _shifted(look.collided, self.collided)
        return InitialLook(active, collided, look.settle_seconds, look.buried)

    def bounded(self) -> tuple[Change, Change]:
        """The shifts in use (active, collided), each as a Change of one particle whose opacity is a logit."""
        return _bounded(self.active), _bounded(self.collided)


def _bounded(raw: Float[Tensor, "7"]) -> Change:
    log_scale = LOG_SCALE_BOUND * torch.tanh(raw[None, 1:4] / LOG_SCALE_BOUND)
    logit = OPACITY_UNIT * raw[:1] - 2 * log_scale.mean(dim=1)  # 2: matter on a pixel is opacity times area
    return Change(
        LOGIT_BOUND * torch.tanh(logit / LOGIT_BOUND),
        log_scale,
        torch.tanh(COLOUR_UNIT * raw[None, 4:]),
    )


def _shifted(look: ParticleLook, raw: Float[Tensor, "7"]) -> ParticleLook:
    shift = _bounded(raw.to(look.opacity))
    # sigmoid(logit(o) + x) without logarithms: exact where x = 0, and where o is 0 or 1.
    odds = shift.opacity.exp()
    opacity = look.opacity * odds / (1 + look.opacity * (odds - 1))
    return ParticleLook(opacity, look.scales * shift.log_scale.exp(), clamp(look.rgb + shift.rgb, 0.0, 1.0))


def clamp(x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """Clamp whose gradient vanishes only for a descent that would lead further out: saturated values can come back."""
    if not torch.is_grad_enabled():
        return torch.clamp(x, low, high)  # type: ignore[arg-type]
    return _Clamp.apply(x, low, high)  # type: ignore[return-value]


class _Clamp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
        ctx.save_for_backward(x < low, x > high)
        low, high = torch.as_tensor(low).to(x), torch.as_tensor(high).to(x)
        return torch.minimum(torch.maximum(x, low), high)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        below, above = ctx.saved_tensors
        outward = (below & (gradient > 0)) | (above & (gradient < 0))
        return gradient.masked_fill(outward, 0.0), None, None
