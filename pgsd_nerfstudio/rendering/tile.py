"""Tiles of 16 x 16 pixels: the pieces of kernels that all walks over their pixels share.

A row of a tile is 16 pixels and every loop over pixels has that constant length: the compiler turns it into one vector
operation, which is worth more than skipping the pixels that a splat does not reach. All numbers of a row lie in one array at
constant distances, so that the compiler sees by itself that no two overlap.

A piece of a loop over pixels returns one number. The loops of blending.py and blending_gradient.py therefore repeat the lines
from alpha to weight: with these lines in one piece that returns a tuple, the compiler did not vectorise the loops, and the row
"forward, exact, 512x512, 80k frozen, 20k dynamic" of `pgsd bench rasterizer --quick` rose from 18 to 97 ms.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.compilation import inlined
from pgsd_nerfstudio.rendering.projection import BOTTOM, DROP, PRECISION, SHEAR, TOP, X, Y
from pgsd_nerfstudio.rendering.rasterizer import TILE

F = np.float32

LIGHT = 0
"""Place of the light of the 16 pixels in a row; it is negative for finished pixels and for those outside the image."""

CHECK_EVERY = 32
"""Splats between two checks whether the whole tile is finished."""

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
    """exp(-sigma) for sigma >= 0 to 4e-7, no less than exp(-80); without a call, so that it becomes part of a vector loop."""
    power = min(sigma, F(80)) * -_LOG2_E
    whole = np.floor(power + F(0.5))
    part = power - whole
    mantissa = (((((_E6 * part + _E5) * part + _E4) * part + _E3) * part + _E2) * part + _E1) * part + _E0
    exponent = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23))
    return mantissa * exponent.view(np.float32)


@inlined()
def tiles_of(width, height):
    """Number of tiles of an image; they are numbered row by row."""
    return ((width + TILE - 1) // TILE) * ((height + TILE - 1) // TILE)


@inlined()
def pixels_of(t, width, height):
    """Left and top pixel of tile t, then the number of its columns and rows that lie in the image."""
    across = (width + TILE - 1) // TILE
    left, top = (t % across) * TILE, (t // across) * TILE
    return left, top, min(TILE, width - left), min(TILE, height - top)


@inlined()
def clear(tile, length, columns, rows):
    """Set all numbers of a tile, whose rows have `length`, to zero, and the light of its pixels in the image to one."""
    for y in range(TILE):
        row = tile[y]
        for x in range(length):
            row[x] = F(0)
        for x in range(16):
            row[LIGHT + x] = F(1) if (y < rows) & (x < columns) else F(-1)


@inlined()
def any_light(tile):
    """Whether a pixel of the tile still takes light."""
    brightest = F(-1)
    for y in range(TILE):
        row = tile[y]
        for x in range(16):
            brightest = max(brightest, row[LIGHT + x])
    return brightest > F(0)


@inlined()
def ellipse(splats, i):
    """P / 2, S and Q / 2 of the exponent of splat i (see projection.py)."""
    return F(0.5) * splats[i, PRECISION], splats[i, SHEAR], F(0.5) * splats[i, DROP]


@inlined()
def rows_of(splats, i, top):
    """The rows of a tile from pixel `top` on that splat i may touch: the first, and one past the last."""
    return max(int(splats[i, TOP]) - top, 0), min(int(splats[i, BOTTOM]) - top, TILE)


@inlined()
def row_of(splats, i, shear, half_drop, left, y):
    """dy of the pixel row y, its share of sigma, and dx + S dy of its first pixel `left`."""
    dy = F(y) + F(0.5) - splats[i, Y]
    return dy, half_drop * dy * dy, F(left) + F(0.5) - splats[i, X] + shear * dy


@inlined()
def row_misses(offset, half_precision, base, cutoff):
    """Whether no pixel of a row, whose first pixel is at `offset` (dx + S dy), comes as near as the cutoff."""
    nearest = max(offset, -(offset + F(TILE - 1)), F(0))
    return half_precision * nearest * nearest + base > cutoff + F(1e-4)


@inlined()
def light_left(before, after, touched, finished):
    """Light of a pixel behind a splat: unchanged if the splat does not touch it, negative if the splat finishes it."""
    return (-before if finished else after) if touched else before
