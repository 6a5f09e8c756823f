"""Display values and linear light.

Splats hold and blend display values (sRGB), as they were trained on pictures. Light adds up and is dimmed in linear units only.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

GAMMA = 2.2  # approximates sRGB, which suffices since light is changed by factors and not measured
DARKEST = 1e-30  # linear light; below it gradients would not be finite


def linear(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Linear light of sRGB values; values below 0 give 0, values above 1 continue the curve."""
    return rgb.clamp_min(0.0) ** GAMMA


def encoded(light: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """sRGB values of linear light."""
    return light.clamp_min(DARKEST) ** (1 / GAMMA)
