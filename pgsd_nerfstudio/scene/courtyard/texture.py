"""Colours of the built-in courtyard: smooth noise in space, and tints that follow it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgsd_nerfstudio.scene.courtyard.surfels import Array


def noise(points: Array, seed: int, octaves: int = 3) -> Array:
    """Smooth pseudo-random values [n] with a mean of about 0, mostly within -1..1.

    Args:
        points: [n, 3] places.
        seed: of the values.
        octaves: number of wavelengths, the first about one unit long and each next one half as long.
    """
    total, weight = np.zeros(len(points)), 1.0
    for octave in range(octaves):
        scaled = points * 2.0**octave
        cell = np.floor(scaled).astype(np.int64)
        part = scaled - cell
        part = part * part * (3 - 2 * part)
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, part, 1 - part), axis=1)
            total += weight * share * (_hash(cell + corner, seed + octave) - 0.5)
        weight *= 0.5
    return 2.0 * total


def _hash(cell: NDArray[np.int64], seed: int) -> Array:
    """A number in 0..1 for every lattice point."""
    mixed = cell.astype(np.uint64) @ np.array([73856093, 19349663, 83492791], np.uint64) + np.uint64(seed * 2654435761)
    for shift, factor in ((33, 0xFF51AFD7ED558CCD), (29, 0xC4CEB9FE1A85EC53)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return (mixed >> np.uint64(40)).astype(np.float64) / 2.0**24


def vary(color: Array, amount: Array) -> Array:
    """One row [n, 3] per sample of a colour that is made brighter or darker.

    Args:
        color: [3], linear.
        amount: [n] natural logarithms of the factors.
    """
    return color * np.exp(amount)[:, None]
