"""Front-to-back blending of splats into pixels, 16 x 16 pixels at a time.

Kerbl et al. (2023), eq. 3: C = sum_i c_i alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j). The frozen and the dynamic splats come
with a tile list each; the two are walked together by depth, which is exactly the picture of one common list.

A row of a tile is 16 pixels and every loop over pixels has that constant length: the compiler turns it into one vector
operation, which is worth more than skipping the pixels that a splat does not reach.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from pgsd_nerfstudio.rendering.compilation import inlined, kernel, parallel_kernel
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

# Planes of a tile while it is blended. Transmittance is negative once the pixel is finished or where it lies outside the image.
LIGHT, R, G, B, Z = 0, 1, 2, 3, 4

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
def _blend_splat(splat, tile, left, top, max_alpha, min_transmittance):
    """Add one splat to a tile [5, 16, 16] whose first pixel is (left, top)."""
    half_precision, shear, half_drop = F(0.5) * splat[PRECISION], splat[SHEAR], F(0.5) * splat[DROP]
    opacity, cutoff = splat[OPACITY], splat[CUTOFF]
    red, green, blue, depth = splat[RED], splat[GREEN], splat[BLUE], splat[DEPTH]
    for row in range(max(int(splat[TOP]) - top, 0), min(int(splat[BOTTOM]) - top, TILE)):
        dy = F(top + row) + F(0.5) - splat[Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splat[X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        light, r, g, b, z = tile[LIGHT, row], tile[R, row], tile[G, row], tile[B, row], tile[Z, row]
        for x in range(16):
            across = F(np.int32(x)) + offset
            sigma = half_precision * across * across + base
            alpha = min(opacity * falloff(min(sigma, F(80))), max_alpha)
            before = light[x]
            after = before * (F(1) - alpha)
            touched = (sigma <= cutoff) & (before > F(0))
            finished = after <= min_transmittance
            weight = alpha * before if touched & (not finished) else F(0)
            r[x] += weight * red
            g[x] += weight * green
            b[x] += weight * blue
            z[x] += weight * depth
            light[x] = (-before if finished else after) if touched else before


@inlined()
def any_light(light):
    """Whether a pixel of the tile still takes light."""
    brightest = F(-1)
    for row in range(TILE):
        for x in range(16):
            brightest = max(brightest, light[row, x])
    return brightest > F(0)


@kernel()
def _reaches(splat, tile, left, top):
    """Whether a splat may still do something to a pixel of the tile; yes when in doubt by a rounding."""
    half_precision, shear, half_drop = F(0.5) * splat[PRECISION], splat[SHEAR], F(0.5) * splat[DROP]
    cutoff = splat[CUTOFF] + F(1e-3)
    for row in range(max(int(splat[TOP]) - top, 0), min(int(splat[BOTTOM]) - top, TILE)):
        dy = F(top + row) + F(0.5) - splat[Y]
        base = half_drop * dy * dy
        offset = F(left) + F(0.5) - splat[X] + shear * dy
        if row_misses(offset, half_precision, base, cutoff):
            continue
        light = tile[LIGHT, row]
        reached = False
        for x in range(16):
            across = F(np.int32(x)) + offset
            reached |= (half_precision * across * across + base <= cutoff) & (light[x] > F(0))
        if reached:
            return True
    return False


@inlined()
def _clear(tile, columns, rows):
    """An empty tile of which `columns` x `rows` pixels lie in the image."""
    tile[:] = F(0)
    tile[LIGHT] = F(-1)
    for y in range(rows):
        for x in range(columns):
            tile[LIGHT, y, x] = F(1)


@inlined()
def _store(tile, columns, rows, left, top, color, depth, transmittance):
    for y in range(rows):
        for x in range(columns):
            color[top + y, left + x, 0] = tile[R, y, x]
            color[top + y, left + x, 1] = tile[G, y, x]
            color[top + y, left + x, 2] = tile[B, y, x]
            depth[top + y, left + x] = tile[Z, y, x]
            transmittance[top + y, left + x] = abs(tile[LIGHT, y, x])


@parallel_kernel()
def blend_frozen(frozen, width, height, workers, max_alpha, min_transmittance, color, depth, transmittance, needed):
    """Blend the frozen splats alone, and mark in `needed` [k] which entries did anything.

    What does nothing here does nothing either among dynamic splats, which only take light away: such entries (a corner of the
    tile that the ellipse misses, what lies behind an opaque wall) can be dropped without changing any picture.

    Worker k takes every `workers`-th tile from k on: neighbours cost alike, so the shares are even and always the same.
    """
    tiles_across = (width + TILE - 1) // TILE
    tiles = tiles_across * ((height + TILE - 1) // TILE)
    for worker in prange(workers):
        tile = np.empty((5, TILE, TILE), np.float32)
        for t in range(worker, tiles, workers):
            left, top = (t % tiles_across) * TILE, (t // tiles_across) * TILE
            columns, rows = min(TILE, width - left), min(TILE, height - top)
            _clear(tile, columns, rows)
            for k in range(frozen.offsets[t], frozen.offsets[t + 1]):
                if k % CHECK_EVERY == 0 and not any_light(tile[LIGHT]):
                    break
                splat = frozen.splats[frozen.entries[k]]
                needed[k] = _reaches(splat, tile, left, top)
                if needed[k]:
                    _blend_splat(splat, tile, left, top, max_alpha, min_transmittance)
            _store(tile, columns, rows, left, top, color, depth, transmittance)


@kernel()
def _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance):
    """Both lists of tile t by depth; at equal depth the frozen splat comes first."""
    i, i_end = frozen.offsets[t], frozen.offsets[t + 1]
    j, j_end = dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while i < i_end or j < j_end:
        if j == j_end or (i < i_end and frozen.splats[frozen.entries[i], DEPTH] <= dynamic.splats[dynamic.entries[j], DEPTH]):
            _blend_splat(frozen.splats[frozen.entries[i]], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            _blend_splat(dynamic.splats[dynamic.entries[j]], tile, left, top, max_alpha, min_transmittance)
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile[LIGHT]):
            break


@parallel_kernel()
def blend_merged(frozen, dynamic, width, height, workers, max_alpha, min_transmittance, color, depth, transmittance):
    """Blend again those tiles that have dynamic splats; the images come as `blend_frozen` left them."""
    tiles_across = (width + TILE - 1) // TILE
    tiles = tiles_across * ((height + TILE - 1) // TILE)
    for worker in prange(workers):
        tile = np.empty((5, TILE, TILE), np.float32)
        for t in range(worker, tiles, workers):
            if dynamic.offsets[t] == dynamic.offsets[t + 1]:
                continue
            left, top = (t % tiles_across) * TILE, (t // tiles_across) * TILE
            columns, rows = min(TILE, width - left), min(TILE, height - top)
            _clear(tile, columns, rows)
            _walk_tile(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance)
            _store(tile, columns, rows, left, top, color, depth, transmittance)
