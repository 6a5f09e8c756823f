"""The light of a weather on the frozen scene: its strength and colour, and the shadows that its clouds soften."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.response.light import luminance, saturated

BLUE_SHADOWS = 0.45  # exponent of the softening by which shadows lose colour


def in_weather(
    light: Float[Tensor, "m 3"], ambience: Ambience, share: float, softening: Float[Tensor, " m"] | None
) -> Float[Tensor, "m 3"]:
    """Linear light of surfaces under a weather.

    Args:
        light: linear light without weather.
        ambience: light of the full weather.
        share: share of the full weather, 0..1.
        softening: factor on linear light in full weather, when clouds soften the shadows; None if no sun was found.
    """
    factor = 1 + share * (2.0**ambience.stops * torch.tensor(ambience.tint).to(light) - 1)
    light = saturated(light * factor, 1 + share * (ambience.saturation - 1))
    if softening is None:
        return light
    softened = 1 + share * (softening[:, None].to(light) - 1)
    # Shadows in the scene are lit by the blue sky alone, but clouds are white.
    grey = luminance(light)[:, None]
    return softened * torch.lerp(grey, light, softened.clamp_min(1.0) ** -BLUE_SHADOWS)
