"""Heights of the ground as a map: rays from above, levelled, and mended where a scanned mesh has holes and dents."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MENDED = (0.27, 0.12, 0.1)  # m, m, m^2: width of the median that takes dents out of a mesh, deepest dent, largest hole
LEVELLED = (0.15, 0.10, 0.06, 0.04, 0.03, 0.03)  # m around the ground within which heights tell its plane, round by round
TILTED = 2.5  # degrees by which a capture's up may be wrong
SAME = 0.04  # m; greatest difference in height of neighbouring cells of one surface
WAVES = (0.25, 2.0)  # m; shortest and longest wavelength of the unevenness that a mesh does not resolve


def heights_below(surface: SurfaceMesh, at: Float[ndarray, "n 2"], start: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Height of the first surface below places, m; NaN where there is none or where its underside is met.

    Args:
        surface: the mesh in metres.
        at: places, m.
        start: heights above them, m.
    """
    origins = np.concatenate([at, start[:, None]], 1).astype(np.float32)
    down = np.zeros_like(origins)
    down[:, 2] = -1.0
    hits = surface.cast(origins, down)
    distance, upward = hits.distance.numpy().astype(np.float64), hits.normal.numpy()[:, 2] > 0
    return np.where(np.isfinite(distance) & upward, start - distance, np.nan)


def ground_plane(at: Float[ndarray, "n 2"], heights: Float[ndarray, " n"]) -> Float[ndarray, "3"]:
    """The plane of the ground if it is nearly level, else that of z = 0.

    The up of a capture is known to a degree or two only, and water would run off ground that is level in truth.
    """
    known = np.isfinite(heights)
    columns = np.concatenate([np.ones((len(at), 1)), at], 1)
    plane = np.zeros(3)
    for band in LEVELLED:
        near = known & (np.abs(heights - columns @ plane) < band)
        if near.sum() < 3:
            return np.zeros(3)
        plane = np.linalg.lstsq(columns[near], heights[near], rcond=None)[0]
    return plane if math.hypot(*plane[1:]) < math.tan(math.radians(TILTED)) else np.zeros(3)


def patches(cells: Bool[ndarray, "x y"]) -> tuple[Int[ndarray, "x y"], int]:
    """Number from 1 on of the connected patch of each cell, 0 outside, and how many there are."""
    found: Any = ndimage.label(cells, np.ones((3, 3)))
    return found


def filled_in(ground: Float[ndarray, "x y"]) -> Float[ndarray, "x y"]:
    """Heights of which unknown ones are those of the nearest known cell."""
    nearest: Any = ndimage.distance_transform_edt(~np.isfinite(ground), return_distances=False, return_indices=True)
    return ground[tuple(nearest)]


def mended(ground: Float[ndarray, "x y"], cell: float) -> Float[ndarray, "x y"]:
    """Heights without the small holes and dents of a scanned mesh, through which no water leaves."""
    width, dent, hole = MENDED
    unknown = ~np.isfinite(ground)
    if unknown.all():
        return ground
    labels, count = patches(unknown)
    small = np.append(False, np.bincount(labels.ravel(), minlength=count + 1)[1:] * cell**2 < hole)
    whole = filled_in(ground)
    median = ndimage.median_filter(whole, size=2 * round(width / cell / 2) + 1, mode="nearest")
    flat = np.where(np.abs(whole - median) < dent, median, whole)
    return np.where(unknown & ~small[labels], np.nan, flat)


def smoothed(ground: Float[ndarray, "x y"], sigma: float) -> Float[ndarray, "x y"]:
    """Heights averaged over neighbours of the same surface, so that tables and walls keep their edges."""
    result = ground
    for _ in range(max(round(2 * sigma**2), 1)):  # each round adds half a cell squared to the variance along both axes
        total, weight = np.nan_to_num(result), np.isfinite(result).astype(float)
        own = total.copy()
        for axis in range(2):
            for step in (1, -1):
                other = np.roll(result, step, axis)
                same = np.abs(other - result) < SAME  # false where either is unknown
                edge = 0 if step == 1 else -1
                np.moveaxis(same, axis, 0)[edge] = False
                total = total + np.where(same, np.nan_to_num(other), 0.0) * 0.5
                weight = weight + 0.5 * same
        result = np.where(weight > 0, total / np.maximum(weight, 1e-9), own)
        result = np.where(np.isfinite(ground), result, np.nan)
    return result


def uneven(points: Float[ndarray, "n 2"], seed: int) -> Float[ndarray, " n"]:
    """A smooth random function of place with mean square 1; longer waves are higher."""
    rng = np.random.default_rng([seed, 0x0B01])
    shortest, longest = WAVES
    lengths = longest * (shortest / longest) ** rng.random(40)
    turns, phases = rng.random((2, 40)) * 2 * np.pi
    heights = lengths / np.sqrt((lengths**2).sum())
    result = np.zeros(len(points))
    for length, turn, phase, height in zip(lengths, turns, phases, heights, strict=True):
        along = points[:, 0] * math.cos(turn) + points[:, 1] * math.sin(turn)
        result += math.sqrt(2) * height * np.sin(2 * np.pi * along / length + phase)
    return result
