"""Dynamic splats blended into a frozen scene tile by tile, and the backward pass.

The frozen scene is given as splats (binning.py) or as layers (layers.py). The frozen and the dynamic part of a tile are walked
together by depth; with frozen splats this is exactly the picture of one common list. Only tiles with dynamic splats are
visited, and the backward pass ends at the last dynamic splat of a tile.

Kernels are compiled once for each kind of frozen part: `_walk` and `_walk_backward` stand in them for the walk that numba
chooses by the type of `frozen`. The loops over splats and over layers stay apart: with one loop that chooses at each entry,
the backward part of the row "forward+backward, exact, 512x512, 80k frozen, 20k dynamic" of `pgsd bench rasterizer --quick` took
3 to 7 % longer.
"""

from __future__ import annotations

import numpy as np
from numba.extending import overload

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import ROW, THROUGH, WITH_THROUGH, blend_counted_splat, blend_splat, store_tile
from pgsd_nerfstudio.rendering.blending_gradient import GRADIENT_ROW, SUMS, pass_dynamic, pass_frozen, start_tile
from pgsd_nerfstudio.rendering.compilation import aligned, kernel, share_out, workers
from pgsd_nerfstudio.rendering.layers import Layers, blend_layer, pass_layer
from pgsd_nerfstudio.rendering.projection import DEPTH
from pgsd_nerfstudio.rendering.rasterizer import TILE
from pgsd_nerfstudio.rendering.tile import CHECK_EVERY, F, any_light, clear, pixels_of, tiles_of


@kernel()
def _walk_splats(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through):
    """Blend both lists of splats of tile t by depth; at equal depth the frozen splat comes first.

    With `through`, the tile also keeps the light that the frozen splats alone let through.
    """
    frozen_splats, frozen_entries, i, i_end = frozen.splats, frozen.entries, frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, j, j_end = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while i < i_end or j < j_end:
        if j == j_end or (i < i_end and frozen_splats[frozen_entries[i], DEPTH] <= splats[entries[j], DEPTH]):
            if through:
                blend_counted_splat(frozen_splats, frozen_entries[i], tile, left, top, max_alpha, min_transmittance)
            else:
                blend_splat(frozen_splats, frozen_entries[i], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            blend_splat(splats, entries[j], tile, left, top, max_alpha, min_transmittance)
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile):
            break


@kernel()
def _walk_layers(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through):
    """Blend the layers and the dynamic splats of tile t by depth; at equal depth the layer comes first.

    Layers are pressed from a scene that was blended alone, so `through` is never asked of them.
    """
    depths, planes, steps = frozen.depths, frozen.planes, frozen.steps
    k, k_end = frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, first, last = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    for j in range(first, last):
        i = entries[j]
        while k < k_end and depths[k] <= splats[i, DEPTH]:
            blend_layer(planes, steps, k, tile)
            k += 1
        blend_splat(splats, i, tile, left, top, max_alpha, min_transmittance)
        if (j - first) % CHECK_EVERY == CHECK_EVERY - 1 and not any_light(tile):
            return
    while k < k_end:
        blend_layer(planes, steps, k, tile)
        k += 1


@kernel()
def _walk_splats_backward(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """The backward pass of `_walk_splats`, up to the last dynamic splat of tile t."""
    frozen_splats, frozen_entries, i, i_end = frozen.splats, frozen.entries, frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, j, j_end = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    seen = 0
    while j < j_end:
        if i < i_end and frozen_splats[frozen_entries[i], DEPTH] <= splats[entries[j], DEPTH]:
            pass_frozen(frozen_splats, frozen_entries[i], tile, left, top, max_alpha, min_transmittance)
            i += 1
        else:
            pass_dynamic(splats, entries[j], tile, left, top, max_alpha, min_transmittance, sums, gradients)
            j += 1
        seen += 1
        if seen % CHECK_EVERY == 0 and not any_light(tile):
            break


@kernel()
def _walk_layers_backward(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """The backward pass of `_walk_layers`, up to the last dynamic splat of tile t."""
    depths, planes, steps = frozen.depths, frozen.planes, frozen.steps
    k, k_end = frozen.offsets[t], frozen.offsets[t + 1]
    splats, entries, first, last = dynamic.splats, dynamic.entries, dynamic.offsets[t], dynamic.offsets[t + 1]
    for j in range(first, last):
        i = entries[j]
        while k < k_end and depths[k] <= splats[i, DEPTH]:
            pass_layer(planes, steps, k, tile)
            k += 1
        pass_dynamic(splats, i, tile, left, top, max_alpha, min_transmittance, sums, gradients)
        if (j - first) % CHECK_EVERY == CHECK_EVERY - 1 and not any_light(tile):
            return


def _walk(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through):
    """The walk over tile t for the type of `frozen`, in kernels."""


def _walk_backward(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    """The backward pass of the walk over tile t for the type of `frozen`, in kernels."""


@overload(_walk, inline="always")
def _walk_of(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through):
    walk = _walk_layers if frozen.instance_class is Layers else _walk_splats
    return lambda frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through: walk(
        frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through
    )


@overload(_walk_backward, inline="always")
def _walk_backward_of(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients):
    walk = _walk_layers_backward if frozen.instance_class is Layers else _walk_splats_backward
    return lambda frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients: walk(
        frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, sums, gradients
    )


def blend_merged(
    frozen: Binned | Layers,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, changed
) -> None:
    """Blend the tiles that have dynamic splats again, in an image as `blend_frozen` left it."""
    limits = width, height, max_alpha, min_transmittance
    none = np.empty((0, 0), np.float32)
    share_out(_blend_merged, workers(), aligned(workers(), TILE, ROW), frozen, dynamic, False, *limits, image, none)


def blend_at_once(
    frozen: Binned,
    dynamic: Binned,
    width: int,
    height: int,
    max_alpha: np.float32,
    min_transmittance: np.float32,
    image: np.ndarray,  # [5, h, w] float32, written
    light: np.ndarray,  # [h, w] float32, written, or [0, 0]
) -> None:
    """Blend all tiles: the image of `blend_frozen` and `blend_merged`, to the bit, in one walk that prepares nothing.

    `light` is what the frozen splats alone let through; in pixels that are finished, those up to there.
    """
    limits = width, height, max_alpha, min_transmittance
    tiles = aligned(workers(), TILE, WITH_THROUGH if light.size else ROW)
    share_out(_blend_merged, workers(), tiles, frozen, dynamic, True, *limits, image, light)


@kernel()
def _blend_merged(
    worker, workers, tiles, frozen, dynamic, everywhere, width, height, max_alpha, min_transmittance, image, light
):
    tile, through = tiles[worker], light.size > 0
    for t in range(worker, tiles_of(width, height), workers):
        if not everywhere and dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top, columns, rows = pixels_of(t, width, height)
        clear(tile, ROW, columns, rows)
        if through:
            tile[:, THROUGH:] = F(1)
        _walk(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, through)
        store_tile(tile, columns, rows, left, top, image)
        if through:
            light[top : top + rows, left : left + columns] = tile[:rows, THROUGH : THROUGH + columns]


def blend_backward(
    frozen: Binned | Layers,
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

    Each worker has its own sums, so no two write to one place and the order of summation never changes.
    """
    count = len(gradients)
    scratch = aligned(count, TILE, GRADIENT_ROW), aligned(count, SUMS)
    numbers = width, height, max_alpha, min_transmittance
    share_out(_blend_backward, count, *scratch, frozen, dynamic, *numbers, image, to_image, gradients)


@kernel()
def _blend_backward(
    worker, workers, tiles, sums, frozen, dynamic, width, height, max_alpha, min_transmittance, image, to_image, gradients
):
    tile, own_sums, own = tiles[worker], sums[worker], gradients[worker]
    for t in range(worker, tiles_of(width, height), workers):
        if dynamic.offsets[t] == dynamic.offsets[t + 1]:
            continue
        left, top, columns, rows = pixels_of(t, width, height)
        start_tile(tile, columns, rows, left, top, image, to_image)
        _walk_backward(frozen, dynamic, t, tile, left, top, max_alpha, min_transmittance, own_sums, own)
