"""The way back through blending: gradients of the dynamic splats from those of the pixels.

Walks front to back again instead of back to front: with v the gradient of a pixel, S = v . C starts as the whole of the pixel
and loses v . c_i alpha_i T_i at every splat, so that what remains is the part behind it and

    dL/dalpha_i = v . c_i T_i - S_behind / (1 - alpha_i).

No transmittance is ever divided out, the walk ends at the last dynamic splat of a tile, and tiles without any are not visited.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from pgsd_nerfstudio.rendering.blending import CHECK_EVERY, any_light, falloff, row_misses
from pgsd_nerfstudio.rendering.compilation import kernel, parallel_kernel
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

# Planes of a tile on the way back: light as in blending, v . C of what is still to come, and the gradients of the pixel.
LIGHT, BEHIND, TO_R, TO_G, TO_B, TO_Z = 0, 1, 2, 3, 4, 5


@kernel()
def _pass_frozen(splat, tile, left, top, max_alpha, min_transmittance):
    """Take a frozen splat off what is behind; it wants no gradient."""
    half_precision, shear, half_drop = F(0.5) * splat[PRECISION], splat[SHEAR], F(0.5) * splat[DROP]
    opacity, cutoff = splat[OPACITY], splat[CUTOFF]
    red, green, blue, depth = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
    for row in range(max(int(splat[TOP]) - top, 0), min(int(splat[BOTTOM]) - top, TILE)):
        dy = F(top + row) + F(0.5) - splat[Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splat[X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        light, behind = tile[LIGHT, row], tile[BEHIND, row]
        to_r, to_g, to_b, to_z = tile[TO_R, row], tile[TO_G, row], tile[TO_B, row], tile[TO_Z, row]
        for x in range(16):
            across = F(np.int32(x)) + offset
            sigma = half_precision * across * across + base
            alpha = min(opacity * falloff(min(sigma, F(80))), max_alpha)
            before = light[x]
            after = before * (F(1) - alpha)
            touched = (sigma <= cutoff) & (before > F(0))
            finished = after <= min_transmittance
            weight = alpha * before if touched & (not finished) else F(0)
            behind[x] -= weight * (to_r[x] * red + to_g[x] * green + to_b[x] * blue + to_z[x] * depth)
            light[x] = (-before if finished else after) if touched else before


@kernel()
def _pass_dynamic(splat, tile, left, top, max_alpha, min_transmittance, gradient):
    """The same for a dynamic splat, adding to its `gradient` [10]."""
    half_precision, shear, half_drop = F(0.5) * splat[PRECISION], splat[SHEAR], F(0.5) * splat[DROP]
    opacity, cutoff = splat[OPACITY], splat[CUTOFF]
    red, green, blue, depth = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
    to_red, to_green, to_blue, to_depth = F(0), F(0), F(0), F(0)
    # Moments of dL/dsigma over the pixels: in u = dx + S dy and in dy. All gradients of the shape follow from these six.
    m_1, m_u, m_uu, m_y, m_yu, m_yy = F(0), F(0), F(0), F(0), F(0), F(0)
    for row in range(max(int(splat[TOP]) - top, 0), min(int(splat[BOTTOM]) - top, TILE)):
        dy = F(top + row) + F(0.5) - splat[Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splat[X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        light, behind = tile[LIGHT, row], tile[BEHIND, row]
        to_r, to_g, to_b, to_z = tile[TO_R, row], tile[TO_G, row], tile[TO_B, row], tile[TO_Z, row]
        row_1, row_u, row_uu = F(0), F(0), F(0)
        for x in range(16):
            across = F(np.int32(x)) + offset
            sigma = half_precision * across * across + base
            unclipped = opacity * falloff(min(sigma, F(80)))
            alpha = min(unclipped, max_alpha)
            before = light[x]
            passes = F(1) - alpha
            after = before * passes
            touched = (sigma <= cutoff) & (before > F(0))
            finished = after <= min_transmittance
            drawn = touched & (not finished)
            weight = alpha * before if drawn else F(0)
            worth = to_r[x] * red + to_g[x] * green + to_b[x] * blue + to_z[x] * depth
            rest = behind[x] - weight * worth
            behind[x] = rest
            light[x] = (-before if finished else after) if touched else before
            to_sigma = alpha * (rest / passes - worth * before) if drawn & (unclipped <= max_alpha) else F(0)
            row_1 += to_sigma
            row_u += to_sigma * across
            row_uu += to_sigma * across * across
            to_red += weight * to_r[x]
            to_green += weight * to_g[x]
            to_blue += weight * to_b[x]
            to_depth += weight * to_z[x]
        m_1 += row_1
        m_u += row_u
        m_uu += row_uu
        m_y += dy * row_1
        m_yu += dy * row_u
        m_yy += dy * dy * row_1
    precision = splat[PRECISION]
    gradient[X] -= precision * m_u
    gradient[Y] -= precision * shear * m_u + splat[DROP] * m_y
    gradient[PRECISION] += F(0.5) * m_uu
    gradient[SHEAR] += precision * m_yu
    gradient[DROP] += F(0.5) * m_yy
    gradient[OPACITY] -= m_1 / opacity
    gradient[RED] += to_red
    gradient[GREEN] += to_green
    gradient[BLUE] += to_blue
    gradient[DEPTH] += to_depth


@kernel()
def _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, gradients):
    """The walk of blending over tile t, up to its last dynamic splat."""
    i, i_end = frozen.offsets[t], frozen.offsets[t + 1]
    j, j_end = dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while j < j_end:
        if i < i_end and frozen.splats[frozen.entries[i], DEPTH] <= dynamic.splats[dynamic.entries[j], DEPTH]:
            _pass_frozen(frozen.splats[frozen.entries[i]], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            splat = dynamic.entries[j]
            _pass_dynamic(dynamic.splats[splat], tile, left, top, max_alpha, min_transmittance, gradients[splat])
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile[LIGHT]):
            break


@parallel_kernel()
def blend_backward(
    frozen,
    dynamic,
    width,
    height,
    max_alpha,
    min_transmittance,
    color,
    depth,
    transmittance,
    to_color,
    to_depth,
    to_transmittance,
    gradients,
):
    """Add the gradients of the dynamic splats to `gradients` [workers, m, 10].

    The images are the results of `blend_merged`, then the gradients of these. Each worker has its own sums: no two write to one
    place, and the order of summation never changes.
    """
    tiles_across = (width + TILE - 1) // TILE
    tiles = tiles_across * ((height + TILE - 1) // TILE)
    workers = gradients.shape[0]
    for worker in prange(workers):
        tile = np.empty((6, TILE, TILE), np.float32)
        for t in range(worker, tiles, workers):
            if dynamic.offsets[t] == dynamic.offsets[t + 1]:
                continue
            left, top = (t % tiles_across) * TILE, (t // tiles_across) * TILE
            tile[:] = F(0)
            tile[LIGHT] = F(-1)
            for row in range(min(TILE, height - top)):
                for column in range(min(TILE, width - left)):
                    y, x = top + row, left + column
                    red, green, blue, away = to_color[y, x, 0], to_color[y, x, 1], to_color[y, x, 2], to_depth[y, x]
                    tile[LIGHT, row, column] = F(1)
                    tile[TO_R, row, column] = red
                    tile[TO_G, row, column] = green
                    tile[TO_B, row, column] = blue
                    tile[TO_Z, row, column] = away
                    tile[BEHIND, row, column] = (
                        red * color[y, x, 0]
                        + green * color[y, x, 1]
                        + blue * color[y, x, 2]
                        + away * depth[y, x]
                        + to_transmittance[y, x] * transmittance[y, x]
                    )
            _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, gradients[worker])
