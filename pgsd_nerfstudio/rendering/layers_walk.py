"""Dynamic splats blended among the layers of a frozen scene, and the way back; as blending.py and blending_gradient.py do it
among its splats."""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import (
    CHECK_EVERY,
    LIGHT,
    ROW,
    B,
    F,
    G,
    R,
    Z,
    any_light,
    blend_splat,
    clear_tile,
    store_tile,
)
from pgsd_nerfstudio.rendering.blending_gradient import BEHIND, SUMS, TO_B, TO_G, TO_R, TO_Z, pass_dynamic, start_tile
from pgsd_nerfstudio.rendering.blending_gradient import ROW as GRADIENT_ROW
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.layers import Layers
from pgsd_nerfstudio.rendering.projection import DEPTH
from pgsd_nerfstudio.rendering.rasterizer import TILE


@inlined()
def _blend_layer(planes, steps, k, tile):
    """Lay layer k behind what is in the tile."""
    through, red, green, blue, depth = steps[k, 0], steps[k, 1], steps[k, 2], steps[k, 3], steps[k, 4]
    for y in range(TILE):
        row, own = tile[y], planes[k, y]
        for x in range(16):
            before = row[LIGHT + x]
            light = max(before, F(0))
            row[R + x] += light * (red * F(own[R + x]))
            row[G + x] += light * (green * F(own[G + x]))
            row[B + x] += light * (blue * F(own[B + x]))
            row[Z + x] += light * (depth * F(own[Z + x]))
            row[LIGHT + x] = before * (through * F(own[LIGHT + x])) if before > F(0) else before


@kernel()
def _walk_tile(layers, dynamic, t, tile, left, top, max_alpha, min_transmittance):
    depths, planes, steps = layers.depths, layers.planes, layers.steps
    k, k_end = layers.offsets[t], layers.offsets[t + 1]
    splats, entries, first, last = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    for j in range(first, last):
        i = entries[j]
        while k < k_end and depths[k] <= splats[i, DEPTH]:
            _blend_layer(planes, steps, k, tile)
            k += 1
        blend_splat(splats, i, tile, left, top, max_alpha, min_transmittance)
        if (j - first) % CHECK_EVERY == CHECK_EVERY - 1 and not any_light(tile):
            return
    while k < k_end:
        _blend_layer(planes, steps, k, tile)
        k += 1


def blend_layered(
    layers: Layers,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, changed
) -> None:
    """As `blend_merged`, with layers in place of the frozen splats."""
    count = workers()
    share_out(
        _blend_layered, count, aligned(count, TILE, ROW), layers, dynamic, width, height, max_alpha, min_transmittance, image
    )


@kernel()
def _blend_layered(worker, workers, tiles, layers, dynamic, width, height, max_alpha, min_transmittance, image):
    tile, across, down = tiles[worker], (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        if dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top = (t % across) * TILE, (t // across) * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        clear_tile(tile, columns, rows)
        _walk_tile(layers, dynamic, t, tile, left, top, max_alpha, min_transmittance)
        store_tile(tile, columns, rows, left, top, image)


@inlined()
def _pass_layer(planes, steps, k, tile):
    """Take layer k off what is behind."""
    through, red, green, blue, depth = steps[k, 0], steps[k, 1], steps[k, 2], steps[k, 3], steps[k, 4]
    for y in range(TILE):
        row, own = tile[y], planes[k, y]
        for x in range(16):
            before = row[LIGHT + x]
            worth = (
                row[TO_R + x] * (red * F(own[R + x]))
                + row[TO_G + x] * (green * F(own[G + x]))
                + row[TO_B + x] * (blue * F(own[B + x]))
                + row[TO_Z + x] * (depth * F(own[Z + x]))
            )
            row[BEHIND + x] -= max(before, F(0)) * worth
            row[LIGHT + x] = before * (through * F(own[LIGHT + x])) if before > F(0) else before


@kernel()
def _walk_tile_backward(layers, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    depths, planes, steps = layers.depths, layers.planes, layers.steps
    k, k_end = layers.offsets[t], layers.offsets[t + 1]
    splats, entries, first, last = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    for j in range(first, last):
        i = entries[j]
        while k < k_end and depths[k] <= splats[i, DEPTH]:
            _pass_layer(planes, steps, k, tile)
            k += 1
        pass_dynamic(splats, i, tile, left, top, max_alpha, min_transmittance, sums, gradients)
        if (j - first) % CHECK_EVERY == CHECK_EVERY - 1 and not any_light(tile):
            return


def blend_layered_backward(
    layers: Layers,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32: the result of blend_layered
    to_image: np.ndarray,  # [5, h, w] float32: its gradient
    gradients: np.ndarray,  # [workers, m, 10] float32, added to
) -> None:
    """As `blend_backward`, for an image of `blend_layered`."""
    count = len(gradients)
    scratch = aligned(count, TILE, GRADIENT_ROW), aligned(count, SUMS)
    numbers = width, height, max_alpha, min_transmittance
    share_out(_blend_layered_backward, count, *scratch, layers, dynamic, *numbers, image, to_image, gradients)


@kernel()
def _blend_layered_backward(
    worker, workers, tiles, sums, layers, dynamic, width, height, max_alpha, min_transmittance, image, to_image, gradients
):
    tile, own_sums, own = tiles[worker], sums[worker], gradients[worker]
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        if dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top = (t % across) * TILE, (t // across) * TILE
        start_tile(tile, min(TILE, width - left), min(TILE, height - top), left, top, image, to_image)
        _walk_tile_backward(layers, dynamic, t, tile, left, top, max_alpha, min_transmittance, own_sums, own)
