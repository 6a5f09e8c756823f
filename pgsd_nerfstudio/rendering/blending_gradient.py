"""The backward pass of blending: gradients of the dynamic splats from those of the pixels.

The walk goes front to back again instead of back to front. With v the gradient of a pixel, S = v . C starts as the whole of
the pixel and loses v . c_i alpha_i T_i at every splat, so that the part behind the splat remains and

    dL/dalpha_i = v . c_i T_i - S_behind / (1 - alpha_i).

Nothing is ever divided by a transmittance.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.compilation import inlined, kernel
from pgsd_nerfstudio.rendering.projection import (
    BLUE,
    CUTOFF,
    DEPTH,
    DROP,
    GREEN,
    OPACITY,
    PRECISION,
    RED,
    SHEAR,
    X,
    Y,
)
from pgsd_nerfstudio.rendering.rasterizer import TILE
from pgsd_nerfstudio.rendering.tile import LIGHT, F, clear, ellipse, falloff, light_left, row_misses, row_of, rows_of

# Places in the rows of a tile in the backward pass: light as in blending, v . C of the part behind, gradients of the pixel.
BEHIND, TO_R, TO_G, TO_B, TO_Z = 16, 32, 48, 64, 80
GRADIENT_ROW = 96

# Places in the sums over a splat's pixels, one sum for each column of the tile: moments of dL/dsigma in u = dx + S dy and in
# dy, from which all gradients of the shape follow, then the gradients of colour and depth.
M_1, M_U, M_UU, M_Y, M_YU, M_YY, S_R, S_G, S_B, S_Z = range(0, 160, 16)
SUMS = 160


@kernel()
def pass_frozen(splats, i, tile, left, top, max_alpha, min_transmittance):
    """Subtract a frozen splat, which gets no gradient, from the part behind in a tile [16, 96]."""
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
            row[BEHIND + x] -= weight * (
                row[TO_R + x] * red + row[TO_G + x] * green + row[TO_B + x] * blue + row[TO_Z + x] * depth
            )
            row[LIGHT + x] = light_left(before, after, touched, finished)


@inlined()
def _take(sums, place):
    """Sum of the sixteen numbers from `place` on; sets them to zero."""
    total = F(0)
    for x in range(16):
        total += sums[place + x]
        sums[place + x] = F(0)
    return total


@kernel()
def pass_dynamic(splats, i, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """Subtract a dynamic splat and add to its row of `gradients` [m, 10]; `sums` [160] are zero before and after."""
    half_precision, shear, half_drop = ellipse(splats, i)
    opacity, cutoff = splats[i, OPACITY], splats[i, CUTOFF]
    red, green, blue, depth = splats[i, RED], splats[i, GREEN], splats[i, BLUE], splats[i, DEPTH]
    first, last = rows_of(splats, i, top)
    for y in range(first, last):
        dy, base, offset = row_of(splats, i, shear, half_drop, left, top + y)
        if row_misses(offset, half_precision, base, cutoff):
            continue
        row = tile[y]
        for x in range(16):
            across = F(np.int32(x)) + offset
            sigma = half_precision * across * across + base
            unclipped = opacity * falloff(sigma)
            alpha = min(unclipped, max_alpha)
            before = row[LIGHT + x]
            passes = F(1) - alpha
            after = before * passes
            touched = (sigma <= cutoff) & (before > F(0))
            finished = after <= min_transmittance
            drawn = touched & (not finished)
            weight = alpha * before if drawn else F(0)
            to_r, to_g, to_b, to_z = row[TO_R + x], row[TO_G + x], row[TO_B + x], row[TO_Z + x]
            worth = to_r * red + to_g * green + to_b * blue + to_z * depth
            rest = row[BEHIND + x] - weight * worth
            row[BEHIND + x] = rest
            row[LIGHT + x] = light_left(before, after, touched, finished)
            to_sigma = alpha * (rest / passes - worth * before) if drawn & (unclipped <= max_alpha) else F(0)
            to_across = to_sigma * across
            sums[M_1 + x] += to_sigma
            sums[M_U + x] += to_across
            sums[M_UU + x] += to_across * across
            sums[M_Y + x] += dy * to_sigma
            sums[M_YU + x] += dy * to_across
            sums[M_YY + x] += dy * dy * to_sigma
            sums[S_R + x] += weight * to_r
            sums[S_G + x] += weight * to_g
            sums[S_B + x] += weight * to_b
            sums[S_Z + x] += weight * to_z
    precision = splats[i, PRECISION]
    m_u, m_y = _take(sums, M_U), _take(sums, M_Y)
    gradients[i, X] -= precision * m_u
    gradients[i, Y] -= precision * shear * m_u + splats[i, DROP] * m_y
    gradients[i, PRECISION] += F(0.5) * _take(sums, M_UU)
    gradients[i, SHEAR] += precision * _take(sums, M_YU)
    gradients[i, DROP] += F(0.5) * _take(sums, M_YY)
    gradients[i, OPACITY] -= _take(sums, M_1) / opacity
    gradients[i, RED] += _take(sums, S_R)
    gradients[i, GREEN] += _take(sums, S_G)
    gradients[i, BLUE] += _take(sums, S_B)
    gradients[i, DEPTH] += _take(sums, S_Z)


@inlined()
def _start_row(row, plane, found, to_found, length):
    for x in range(length):
        row[BEHIND + x] += to_found[x] * found[x]
    if plane > 0:
        for x in range(length):
            row[BEHIND + 16 * plane + x] = to_found[x]


@inlined()
def start_tile(tile, columns, rows, left, top, image, to_image):
    """Set a tile [16, 96] to its state before the first splat: full light, and the whole picture behind."""
    clear(tile, GRADIENT_ROW, columns, rows)
    for plane in range(5):
        for y in range(rows):
            found, to_found = image[plane, top + y, left:], to_image[plane, top + y, left:]
            if columns == TILE:  # a loop of constant length, as everywhere
                _start_row(tile[y], plane, found, to_found, 16)
            else:
                _start_row(tile[y], plane, found, to_found, columns)
