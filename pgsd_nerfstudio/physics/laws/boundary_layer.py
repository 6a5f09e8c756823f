"""Wind near the ground: the mean wind grows with the logarithm of the height, and turbulence dies out below."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

CALM = 0.6  # m above ground below which turbulence dies out


def law_of_the_wall(height: Float[ndarray, " n"], roughness: float, reference_height: float) -> Float[ndarray, " n"]:
    """Mean wind over open ground as a share of that at the reference height: logarithmic, 0 on and below the ground."""
    return np.log1p(height.clip(0.0) / roughness) / math.log1p(reference_height / roughness)


def calming(height: Float[ndarray, " n"]) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
    """g(z) and dg/dz: 0 at the ground, 1 in free air."""
    s = height.clip(0.0) / CALM
    return s**2 / (1 + s**2), 2 * s / (CALM * (1 + s**2) ** 2)
