"""Front-to-back blending of splats into pixels, 16 x 16 pixels at a time.

Kerbl et al. (2023), eq. 3: C = sum_i c_i alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j). The frozen and the dynamic splats come
with a tile list each; the two are walked together by depth, which is exactly the picture of one common list.

A row of a tile is 16 pixels and every loop over pixels has that constant length: the compiler turns it into one vector
operation, which is worth more than skipping the pixels that a splat does not reach.

An image here is one array [5, h, w]: light let through, red, green, blue, depth weighted like the colours.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import (
    BLUE,
    BOTTOM,
    CUTOFF,
    DEPTH,
    DROP,
    GREEN,
    OPACITY,
    PRECISION,
    RED,
    SHEAR,
    TOP,
    X,
    Y,
)
from pgsd_nerfstudio.rendering.rasterizer import TILE

F = np.float32

# A tile while it is blended: 16 rows of five times 16 floats, which begin at these places. All of a row lies in one array with
# constant distances, so that the compiler sees by itself that no two overlap. Light is negative once the pixel is finished or
# where it lies outside the image.
LIGHT, R, G, B, Z = 0, 16, 32, 48, 64
ROW = 80

CHECK_EVERY = 32
"""Splats between two looks whether the whole tile is finished."""

# exp2 on [-1/2, 1/2]: interpolation at Chebyshev nodes, relative error 1e-9 before rounding.
_E0, _E1, _E2, _E3, _E4, _E5, _E6 = (
    F(c)
    for c in np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, 6, domain=[-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)
_LOG2_E = F(np.log2(np.e))


@inlined()
def falloff(sigma):
    """exp(-sigma) for 0 <= sigma <= 80 to 4e-7, without a call, so that it becomes part of a vector loop."""
    power = sigma * -_LOG2_E
    whole = np.floor(power + F(0.5))
    part = power - whole
    mantissa = (((((_E6 * part + _E5) * part + _E4) * part + _E3) * part + _E2) * part + _E1) * part + _E0
    exponent = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23))
    return mantissa * exponent.view(np.float32)


@inlined()
def row_misses(offset, half_precision, base, cutoff):
    """Whether no pixel of a 16 pixel row, whose first lies at `offset`, comes as near as the cutoff."""
    nearest = max(offset, -(offset + F(TILE - 1)), F(0))
    return half_precision * nearest * nearest + base > cutoff + F(1e-4)


@kernel()
def blend_splat(splats, i, tile, left, top, max_alpha, min_transmittance):
    """Add one splat to a tile [16, 80] whose first pixel is (left, top)."""
    half_precision, shear, half_drop = F(0.5) * splats[i, PRECISION], splats[i, SHEAR], F(0.5) * splats[i, DROP]
    opacity, cutoff = splats[i, OPACITY], splats[i, CUTOFF]
    red, green, blue, depth = splats[i, RED], splats[i, GREEN], splats[i, BLUE], splats[i, DEPTH]
    for y in range(max(int(splats[i, TOP]) - top, 0), min(int(splats[i, BOTTOM]) - top, TILE)):
        dy = F(top + y) + F(0.5) - splats[i, Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splats[i, X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        row = tile[y]
        for x in range(16):
            across = F(np.int32(x)) + offset
            sigma = half_precision * across * across + base
            alpha = min(opacity * falloff(min(sigma, F(80))), max_alpha)
            before = row[LIGHT + x]
            after = before * (F(1) - alpha)
            touched = (sigma <= cutoff) & (before > F(0))
            finished = after <= min_transmittance
            weight = alpha * before if touched & (not finished) else F(0)
            row[R + x] += weight * red
            row[G + x] += weight * green
            row[B + x] += weight * blue
            row[Z + x] += weight * depth
            row[LIGHT + x] = (-before if finished else after) if touched else before


@inlined()
def any_light(tile):
    """Whether a pixel of the tile still takes light."""
    brightest = F(-1)
    for y in range(TILE):
        row = tile[y]
        for x in range(16):
            brightest = max(brightest, row[LIGHT + x])
    return brightest > F(0)


@kernel()
def _reaches(splats, i, tile, left, top):
    """Whether a splat may still do something to a pixel of the tile; yes when in doubt by a rounding."""
    half_precision, shear, half_drop = F(0.5) * splats[i, PRECISION], splats[i, SHEAR], F(0.5) * splats[i, DROP]
    cutoff = splats[i, CUTOFF] + F(1e-3)
    for y in range(max(int(splats[i, TOP]) - top, 0), min(int(splats[i, BOTTOM]) - top, TILE)):
        dy = F(top + y) + F(0.5) - splats[i, Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splats[i, X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        row = tile[y]
        reached = False
        for x in range(16):
            across = F(np.int32(x)) + offset
            reached |= (half_precision * across * across + base <= cutoff) & (row[LIGHT + x] > F(0))
        if reached:
            return True
    return False


@inlined()
def clear_tile(tile, columns, rows):
    """An empty tile of which `columns` x `rows` pixels lie in the image."""
    for y in range(TILE):
        row = tile[y]
        for x in range(ROW):
            row[x] = F(0)
        for x in range(16):
            row[LIGHT + x] = F(1) if (y < rows) & (x < columns) else F(-1)


@inlined()
def store_tile(tile, columns, rows, left, top, image):
    """Write a tile to its place in the image [5, h, w]."""
    for y in range(rows):
        row = tile[y]
        for plane in range(5):
            target = image[plane, top + y, left : left + columns]
            if columns == TILE:  # a loop of constant length, as everywhere
                for x in range(16):
                    target[x] = abs(row[16 * plane + x]) if plane == 0 else row[16 * plane + x]
            else:
                for x in range(columns):
                    target[x] = abs(row[16 * plane + x]) if plane == 0 else row[16 * plane + x]


def blend_frozen(
    frozen: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, written
    needed: np.ndarray,  # [k] bool, false; written
) -> None:
    """Blend the frozen splats alone, and mark in `needed` which entries did anything.

    What does nothing here does nothing either among dynamic splats, which only take light away: such entries (a corner of the
    tile that the ellipse misses, what lies behind an opaque wall) can be dropped without changing any picture.
    """
    count = workers()
    share_out(
        _blend_frozen, count, aligned(count, TILE, ROW), frozen, width, height, max_alpha, min_transmittance, image, needed
    )


@kernel()
def _blend_frozen(worker, workers, tiles, frozen, width, height, max_alpha, min_transmittance, image, needed):
    """Every `workers`-th tile from `worker` on: neighbours cost alike, so the shares are even and always the same."""
    tile, splats, entries = tiles[worker], frozen.splats, frozen.entries
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        left, top = (t % across) * TILE, (t // across) * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        clear_tile(tile, columns, rows)
        for k in range(frozen.offsets[t], frozen.offsets[t + 1]):
            if k % CHECK_EVERY == 0 and not any_light(tile):
                break
            needed[k] = _reaches(splats, entries[k], tile, left, top)
            if needed[k]:
                blend_splat(splats, entries[k], tile, left, top, max_alpha, min_transmittance)
        store_tile(tile, columns, rows, left, top, image)


@kernel()
def _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance):
    """Both lists of tile t by depth; at equal depth the frozen splat comes first."""
    frozen_splats, frozen_entries, i, i_end = frozen.splats, frozen.entries, frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, j, j_end = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while i < i_end or j < j_end:
        if j == j_end or (i < i_end and frozen_splats[frozen_entries[i], DEPTH] <= splats[entries[j], DEPTH]):
            blend_splat(frozen_splats, frozen_entries[i], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            blend_splat(splats, entries[j], tile, left, top, max_alpha, min_transmittance)
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile):
            break


def blend_merged(
    frozen: Binned,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, changed
) -> None:
    """Blend again those tiles that have dynamic splats; the image comes as `blend_frozen` left it."""
    count = workers()
    share_out(
        _blend_merged, count, aligned(count, TILE, ROW), frozen, dynamic, width, height, max_alpha, min_transmittance, image
    )


@kernel()
def _blend_merged(worker, workers, tiles, frozen, dynamic, width, height, max_alpha, min_transmittance, image):
    tile, across, down = tiles[worker], (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        if dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top = (t % across) * TILE, (t // across) * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        clear_tile(tile, columns, rows)
        _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance)
        store_tile(tile, columns, rows, left, top, image)
