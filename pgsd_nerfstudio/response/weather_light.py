"""The light of a weather on the frozen scene: its strength and colour, and the shadows that its clouds soften."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.response.light import saturated


def in_weather(
    light: Float[Tensor, "m 3"], ambience: Ambience, share: float, softening: Float[Tensor, "m 3"] | None
) -> Float[Tensor, "m 3"]:
    """Linear light of surfaces under a weather.

    Args:
        light: linear light without weather.
        ambience: light of the full weather.
        share: share of the full weather, 0..1.
        softening: factors on linear red, green and blue in full weather, when clouds take the sun. They differ, since
            shadows in the scene are lit by the blue sky alone, but clouds are white. None if no sun was found.
    """
    if softening is not None:
        light = light * (1 + share * (softening.to(light) - 1))
    factor = 1 + share * (2.0**ambience.stops * torch.tensor(ambience.tint).to(light) - 1)
    return saturated(light * factor, 1 + share * (ambience.saturation - 1))
