"""Which particles are told apart, and how far: all that are near a camera, and ever fewer the farther away they are.

A camera tells a particle of diameter D apart up to the distance near(D) = sharpness * D. Every such particle is there. Farther
away a particle is one of many faint specks, and the chance to be kept falls as (near / d)^3, so that each doubling of the
distance adds a constant number of particles to a view. What is not kept takes its share of the light as haze
(response.haze_field), so that thinning changes no mean.

Each particle draws a number once, its reach: the greatest distance at which it is kept. It is near * u^(-1/3) with u even in
0..1 (a Pareto distribution), since P(reach > d) = (near / d)^3. A particle is shown at distances within its reach, fades in as
it comes closer, and neither flickers nor depends on the frame.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

FADE = 0.25  # relative difference between distance and reach over which a particle fades in


def kept(near: ndarray, distance: ndarray | float) -> ndarray:
    """Chance of particles to be kept at a distance, 0..1.

    Args:
        near: distances in metres up to which all are kept, of any shape.
        distance: from the camera in metres, 0 or more; of a shape that goes with it.
    """
    return np.asarray(np.minimum(1.0, near / np.maximum(distance, 1e-6)) ** 3)


def reaches(near: Float[ndarray, " n"], least: float, draw: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Distances in metres up to which particles are kept.

    Args:
        near: distances in metres up to which all are kept.
        least: the particles are those that are kept at this distance in metres; 0: all.
        draw: an even number from 0..1 for each.
    """
    # Those that are kept at `least` have u below kept(near, least).
    return near * np.maximum(draw * kept(near, least), 1e-12) ** (-1 / 3)


def shown(near: ndarray, distance: ndarray | float) -> ndarray:
    """Mean share of the light of all particles that those shown at a distance take, 0..1, fading included.

    The fade is linear in reach / d from 1 to 1 + FADE, so that the mean is the average of the chance of being kept over that
    range of distances.

    Args:
        near: distances in metres up to which all are kept, of any shape.
        distance: from the camera in metres; of a shape that goes with it.
    """
    # Gauss-Legendre with four nodes: the integrand is smooth but for one kink.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    factors = 1 + FADE * 0.5 * (nodes + 1)
    return np.asarray(
        sum(0.5 * weight * kept(near, factor * distance) for factor, weight in zip(factors, weights, strict=True))
    )
