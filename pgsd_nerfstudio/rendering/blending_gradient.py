"""The way back through blending: gradients of the dynamic splats from those of the pixels.

Walks front to back again instead of back to front: with v the gradient of a pixel, S = v . C starts as the whole of the pixel
and loses v . c_i alpha_i T_i at every splat, so that what remains is the part behind it and

    dL/dalpha_i = v . c_i T_i - S_behind / (1 - alpha_i).

No transmittance is ever divided out, the walk ends at the last dynamic splat of a tile, and tiles without any are not visited.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import CHECK_EVERY, any_light, falloff, row_misses
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out
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

# Places in the rows of a tile on the way back: light as in blending, v . C of what is still to come, gradients of the pixel.
LIGHT, BEHIND, TO_R, TO_G, TO_B, TO_Z = 0, 16, 32, 48, 64, 80
ROW = 96

# Places in the sums over a splat's pixels, one for each column of the tile: moments of dL/dsigma in u = dx + S dy and in dy,
# from which all gradients of the shape follow, and the gradients of colour and depth.
M_1, M_U, M_UU, M_Y, M_YU, M_YY, S_R, S_G, S_B, S_Z = range(0, 160, 16)
SUMS = 160


@kernel()
def _pass_frozen(splats, i, tile, left, top, max_alpha, min_transmittance):
    """Take a frozen splat off what is behind; it wants no gradient."""
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
            row[BEHIND + x] -= weight * (
                row[TO_R + x] * red + row[TO_G + x] * green + row[TO_B + x] * blue + row[TO_Z + x] * depth
            )
            row[LIGHT + x] = (-before if finished else after) if touched else before


@inlined()
def _take(sums, place):
    """Sum of the sixteen numbers from `place` on, which are zero afterwards."""
    total = F(0)
    for x in range(16):
        total += sums[place + x]
        sums[place + x] = F(0)
    return total


@kernel()
def pass_dynamic(splats, i, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """The same for a dynamic splat, adding to its row of `gradients` [m, 10]; `sums` [160] are zero before and after."""
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
            unclipped = opacity * falloff(min(sigma, F(80)))
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
            row[LIGHT + x] = (-before if finished else after) if touched else before
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


@kernel()
def _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """The walk of blending over tile t, up to its last dynamic splat."""
    frozen_splats, frozen_entries, i, i_end = frozen.splats, frozen.entries, frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, j, j_end = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while j < j_end:
        if i < i_end and frozen_splats[frozen_entries[i], DEPTH] <= splats[entries[j], DEPTH]:
            _pass_frozen(frozen_splats, frozen_entries[i], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            pass_dynamic(splats, entries[j], tile, left, top, max_alpha, min_transmittance, sums, gradients)
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile):
            break


@inlined()
def start_tile(tile, columns, rows, left, top, image, to_image):
    """A tile [16, 96] before the first splat: all light, everything still to come."""
    for y in range(TILE):
        row = tile[y]
        for x in range(ROW):
            row[x] = F(0)
        for x in range(16):
            row[LIGHT + x] = F(1) if (y < rows) & (x < columns) else F(-1)
    for plane in range(5):
        for y in range(rows):
            row, found, to_found = tile[y], image[plane, top + y, left:], to_image[plane, top + y, left:]
            place = TO_R + 16 * (plane - 1)
            if columns == TILE:  # a loop of constant length, as everywhere
                for x in range(16):
                    row[BEHIND + x] += to_found[x] * found[x]
                if plane > 0:
                    for x in range(16):
                        row[place + x] = to_found[x]
            else:
                for x in range(columns):
                    row[BEHIND + x] += to_found[x] * found[x]
                    if plane > 0:
                        row[place + x] = to_found[x]


def blend_backward(
    frozen: Binned,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32: the result of blend_merged
    to_image: np.ndarray,  # [5, h, w] float32: its gradient
    gradients: np.ndarray,  # [workers, m, 10] float32, added to
) -> None:
    """Add the gradients of the dynamic splats to `gradients`.

    Each worker has its own sums: no two write to one place, and the order of summation never changes.
    """
    count = len(gradients)
    scratch = aligned(count, TILE, ROW), aligned(count, SUMS)
    numbers = width, height, max_alpha, min_transmittance
    share_out(_blend_backward, count, *scratch, frozen, dynamic, *numbers, image, to_image, gradients)


@kernel()
def _blend_backward(
    worker, workers, tiles, sums, frozen, dynamic, width, height, max_alpha, min_transmittance, image, to_image, gradients
):
    tile, own_sums, own = tiles[worker], sums[worker], gradients[worker]
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        if dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top = (t % across) * TILE, (t // across) * TILE
        start_tile(tile, min(TILE, width - left), min(TILE, height - top), left, top, image, to_image)
        _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, own_sums, own)
