"""Front-to-back blending of splats into pixels, a tile at a time.

The formula is Kerbl et al. (2023), eq. 3: C = sum_i c_i alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j).

An image here is one array [5, h, w]: light let through, red, green, blue, depth weighted like the colours.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import BLUE, CUTOFF, DEPTH, GREEN, OPACITY, RED
from pgsd_nerfstudio.rendering.rasterizer import TILE
from pgsd_nerfstudio.rendering.tile import (
    CHECK_EVERY,
    LIGHT,
    F,
    any_light,
    clear,
    ellipse,
    falloff,
    light_left,
    pixels_of,
    row_misses,
    row_of,
    rows_of,
    tiles_of,
)

# Places in the rows of a tile while it is blended: light, colours, weighted depth; what chosen splats let through.
R, G, B, Z = 16, 32, 48, 64
ROW = 80
THROUGH, WITH_THROUGH = 80, 96


def _blender(through):
    """A kernel that blends one splat; with `through`, a constant to the compiler, it counts what such splats let through."""

    @kernel()
    def blend(splats, i, tile, left, top, max_alpha, min_transmittance):
        """Add one splat to a tile whose first pixel is (left, top)."""
        half_precision, shear, half_drop = ellipse(splats, i)
        opacity, cutoff = splats[i, OPACITY], splats[i, CUTOFF]
        red, green, blue, depth = splats[i, RED], splats[i, GREEN], splats[i, BLUE], splats[i, DEPTH]
        first, last = rows_of(splats, i, top)
        for y in range(first, last):
            _, base, offset = row_of(splats, i, shear, half_drop, left, top + y)
            if row_misses(offset, half_precision, base, cutoff):
                continue
            row = tile[y]
            for x in range(16):
                across = F(np.int32(x)) + offset
                sigma = half_precision * across * across + base
                alpha = min(opacity * falloff(sigma), max_alpha)
                before = row[LIGHT + x]
                after = before * (F(1) - alpha)
                touched = (sigma <= cutoff) & (before > F(0))
                finished = after <= min_transmittance
                weight = alpha * before if touched & (not finished) else F(0)
                row[R + x] += weight * red
                row[G + x] += weight * green
                row[B + x] += weight * blue
                row[Z + x] += weight * depth
                if through:
                    passed = row[THROUGH + x] * (F(1) - alpha)
                    row[THROUGH + x] = passed if touched & (passed > min_transmittance) else row[THROUGH + x]
                row[LIGHT + x] = light_left(before, after, touched, finished)

    return blend


blend_splat = _blender(False)
"""Add splat i to a tile [16, 80 or 96] whose first pixel is (left, top)."""
blend_counted_splat = _blender(True)
"""As `blend_splat`, of a tile [16, 96], whose last plane keeps the light that the splats added in this way let through."""


@kernel()
def _reaches(splats, i, tile, left, top):
    """Whether a splat may change a pixel of the tile; also true if that depends on a rounding."""
    half_precision, shear, half_drop = ellipse(splats, i)
    cutoff = splats[i, CUTOFF] + F(1e-3)
    first, last = rows_of(splats, i, top)
    for y in range(first, last):
        _, base, offset = row_of(splats, i, shear, half_drop, left, top + y)
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
def _store_row(row, plane, target, length):
    for x in range(length):
        target[x] = abs(row[16 * plane + x]) if plane == 0 else row[16 * plane + x]


@inlined()
def store_tile(tile, columns, rows, left, top, image):
    """Write a tile to its place in the image [5, h, w]."""
    for y in range(rows):
        for plane in range(5):
            target = image[plane, top + y, left : left + columns]
            if columns == TILE:  # a loop of constant length, as everywhere
                _store_row(tile[y], plane, target, 16)
            else:
                _store_row(tile[y], plane, target, columns)


def blend_frozen(
    frozen: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, written
    needed: np.ndarray,  # [k] bool, false; written
) -> None:
    """Blend the frozen splats alone, and mark in `needed` the entries that changed a pixel.

    An entry that changes nothing here changes nothing among dynamic splats either, since these only take light away. Such
    entries (an ellipse that misses the tile, a splat behind an opaque wall) can be dropped without changing any picture.
    """
    count = workers()
    share_out(
        _blend_frozen, count, aligned(count, TILE, ROW), frozen, width, height, max_alpha, min_transmittance, image, needed
    )


@kernel()
def _blend_frozen(worker, workers, tiles, frozen, width, height, max_alpha, min_transmittance, image, needed):
    """Blend every `workers`-th tile from `worker` on; neighbours cost alike, so shares are even, and they never change."""
    tile, splats, entries = tiles[worker], frozen.splats, frozen.entries
    for t in range(worker, tiles_of(width, height), workers):
        left, top, columns, rows = pixels_of(t, width, height)
        clear(tile, ROW, columns, rows)
        for k in range(frozen.offsets[t], frozen.offsets[t + 1]):
            if k % CHECK_EVERY == 0 and not any_light(tile):
                break
            needed[k] = _reaches(splats, entries[k], tile, left, top)
            if needed[k]:
                blend_splat(splats, entries[k], tile, left, top, max_alpha, min_transmittance)
        store_tile(tile, columns, rows, left, top, image)
