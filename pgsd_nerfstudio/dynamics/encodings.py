"""How positions, velocities and time enter the field: 24 numbers each, as in the paper's supplement.

Fourier features as in NeRF (Mildenhall et al. 2020, eq. 4): 4 octaves x sin and cos x 3 axes; time with 12 frequencies x sin
and cos, spaced geometrically as in transformers (Vaswani et al. 2017).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

WIDTH = 24
OCTAVES = 4
TIME_FREQUENCIES = 12
FASTEST_TIME = 32.0  # periods over the whole sequence: with 250 frames one period is 8 frames, the length of a clip


def fourier(unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n 24"]:
    """Fourier features of vectors in -1..1: sin and cos of pi, 2 pi, 4 pi and 8 pi times each component."""
    frequencies = math.pi * 2.0 ** torch.arange(OCTAVES, device=unit.device, dtype=unit.dtype)
    angles = (unit[:, :, None] * frequencies).flatten(1)
    return torch.cat([angles.sin(), angles.cos()], dim=1)


def sinusoidal(time: float, like: Tensor) -> Float[Tensor, "1 24"]:
    """Encoding of a time in 0..1, from half a period to 32 periods over the whole; device and dtype of `like`."""
    octaves = torch.linspace(-1.0, math.log2(FASTEST_TIME), TIME_FREQUENCIES, device=like.device, dtype=like.dtype)
    angles = 2 * math.pi * time * 2.0**octaves
    return torch.cat([angles.sin(), angles.cos()])[None]
