"""Wind near the ground: the mean wind grows with the logarithm of the height, and turbulence dies out towards the ground."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

CALM = 0.6  # m above the ground, where half of the turbulence is left


def law_of_the_wall(height: Float[ndarray, " n"], roughness: float, reference_height: float) -> Float[ndarray, " n"]:
    """Mean wind over open ground, relative to the wind at the reference height (logarithmic law of the wall).

    Args:
        height: metres above the ground; the wind is 0 on the ground and below.
        roughness: roughness length in metres.
        reference_height: metres above the ground.
    """
    return np.log1p(height.clip(0.0) / roughness) / math.log1p(reference_height / roughness)


def calming(height: Float[ndarray, " n"]) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Share of the turbulence that is left near the ground, 0 on it and 1 in free air, and its derivative.

    Args:
        height: metres above the ground.

    Returns:
        g(z), and dg/dz in 1/m.
    """
    s = height.clip(0.0) / CALM
    return s**2 / (1 + s**2), 2 * s / (CALM * (1 + s**2) ** 2)
