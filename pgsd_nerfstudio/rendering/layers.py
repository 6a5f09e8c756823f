"""The frozen splats of every tile pressed into a few layers, so that a frame costs little more than its dynamic splats.

A layer is what some consecutive frozen splats of a tile do together to each of its pixels: a premultiplied colour, a weighted
depth and the light they let through. The layers composited one after the other are the frozen picture again, whatever their
number (Porter & Duff, "Compositing digital images", 1984: "over" is associative). Only the order against dynamic splats
inside a layer is lost: these are drawn wholly in front of it or wholly behind it. Each layer holds an equal share of the
blended weight of its tile, so layers are thin where much is seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import ROW, B, G, R, Z, blend_splat
from pgsd_nerfstudio.rendering.blending_gradient import BEHIND, TO_B, TO_G, TO_R, TO_Z
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import DEPTH
from pgsd_nerfstudio.rendering.rasterizer import TILE
from pgsd_nerfstudio.rendering.tile import LIGHT, F, clear, pixels_of, tiles_of


class Layers(NamedTuple):
    """The frozen splats of one camera as layers of its tiles."""

    offsets: np.ndarray
    """[tiles + 1] int32: the layers of tile t are offsets[t]:offsets[t + 1], nearest first."""
    depths: np.ndarray
    """[n] float32, scene units: half of the layer's weight is nearer than this; dynamic splats nearer than this are drawn in
    front of the layer, others behind it."""
    planes: np.ndarray
    """[n, 16, 80] uint16, rows as in blending.py: light let through, premultiplied colour, and depth weighted like the colour,
    in units of `steps`. They take half the bytes of float32, and reading them is the largest cost of a layer; the rounding is
    far below the error of layers."""
    steps: np.ndarray
    """[n, 5] float32: the unit of each plane; that of light is 2^-15, so that the light 1 is exact."""

    @property
    def nbytes(self) -> int:
        return self.offsets.nbytes + self.depths.nbytes + self.planes.nbytes + self.steps.nbytes


@inlined()
def _light_left(tile):
    """Sum of the light left in the pixels of a tile, finished pixels included."""
    total = F(0)
    for y in range(TILE):
        row = tile[y]
        for x in range(16):
            total += abs(row[LIGHT + x])
    return total


@kernel()
def _split(frozen, t, tile, left, top, max_alpha, min_transmittance, count, ends, depths):
    """Find where the layers of tile t end (entries, exclusive) and their depths; returns their number, at most `count`."""
    splats, entries, first, last = frozen.splats, frozen.entries, frozen.offsets[t], frozen.offsets[t + 1]
    weights = np.zeros(last - first, np.float32)
    before = _light_left(tile)
    total = F(0)
    for k in range(last - first):
        blend_splat(splats, entries[first + k], tile, left, top, max_alpha, min_transmittance)
        after = _light_left(tile)
        weights[k] = max(before - after, F(0))
        total += weights[k]
        before = after
    layers, begin, behind = 0, 0, F(0)
    inside = F(0)
    for k in range(last - first):
        inside += weights[k]
        if behind + inside < total * F(layers + 1) / F(count) and k + 1 < last - first:
            continue
        # The layer is full; its depth is that of the splat at which half of its weight is reached.
        half, middle = F(0.5) * inside, begin
        while middle < k and half > weights[middle]:
            half -= weights[middle]
            middle += 1
        ends[layers] = first + k + 1
        depths[layers] = splats[entries[first + middle], DEPTH]
        behind += inside
        inside = F(0)
        begin = k + 1
        layers += 1
        if layers == count and k + 1 < last - first:  # the rest weighs nothing
            ends[layers - 1] = last
            break
    return layers


@kernel()
def _split_all(worker, workers, tiles, frozen, width, height, max_alpha, min_transmittance, count, numbers, ends, depths):
    """Fill the numbers [tiles], ends [tiles, count] and depths [tiles, count] of the layers."""
    tile = tiles[worker]
    for t in range(worker, tiles_of(width, height), workers):
        left, top, columns, rows = pixels_of(t, width, height)
        clear(tile, ROW, columns, rows)
        numbers[t] = _split(frozen, t, tile, left, top, max_alpha, min_transmittance, count, ends[t], depths[t])


@kernel()
def _fill(worker, workers, tiles, frozen, width, height, max_alpha, min_transmittance, offsets, ends, planes, steps):
    """Fill the planes of all layers: the change of the tile from one end to the next, relative to the light that came in.

    The differences lose digits where little light is left, and there they count as little: no dynamic splat adds light.
    """
    tile, before, layer = tiles[worker, 0], tiles[worker, 1], tiles[worker, 2]
    splats, entries = frozen.splats, frozen.entries
    for t in range(worker, tiles_of(width, height), workers):
        left, top, columns, rows = pixels_of(t, width, height)
        clear(tile, ROW, columns, rows)
        k = frozen.offsets[t]
        for n in range(offsets[t], offsets[t + 1]):
            for y in range(TILE):
                for x in range(ROW):
                    before[y, x] = tile[y, x]
            while k < ends[t, n - offsets[t]]:
                blend_splat(splats, entries[k], tile, left, top, max_alpha, min_transmittance)
                k += 1
            for y in range(TILE):
                for x in range(TILE):
                    came = abs(before[y, LIGHT + x])
                    layer[y, LIGHT + x] = abs(tile[y, LIGHT + x]) / came
                    for plane in (R, G, B, Z):
                        layer[y, plane + x] = (tile[y, plane + x] - before[y, plane + x]) / came
            _quantise(layer, planes[n], steps[n])


@kernel()
def _quantise(layer, planes, steps):
    """Write a layer [16, 80] as whole numbers of its steps [5]."""
    for plane in range(5):
        place, largest = 16 * plane, F(1e-12)
        for y in range(TILE):
            for x in range(16):
                largest = max(largest, layer[y, place + x])
        steps[plane] = F(2.0**-15) if place == LIGHT else largest / F(65535)
        for y in range(TILE):
            for x in range(16):
                planes[y, place + x] = np.uint16(max(layer[y, place + x], F(0)) / steps[plane] + F(0.5))


def press(frozen: Binned, width: int, height: int, max_alpha: np.float32, min_transmittance: np.float32, count: int) -> Layers:
    """Press the frozen splats of each tile into layers.

    Args:
        frozen: tile lists of the frozen splats.
        width: of the image in pixels.
        height: of the image in pixels.
        max_alpha: as in `RasterConfig`.
        min_transmittance: as in `RasterConfig`.
        count: number of layers of a tile, at most.
    """
    tiles, threads = len(frozen.offsets) - 1, workers()
    numbers, ends = np.zeros(tiles, np.int32), np.zeros((tiles, count), np.int32)
    depths = np.zeros((tiles, count), np.float32)
    scene = frozen, width, height, max_alpha, min_transmittance
    share_out(_split_all, threads, aligned(threads, TILE, ROW), *scene, count, numbers, ends, depths)
    offsets = np.concatenate([[0], np.cumsum(numbers)]).astype(np.int32)
    planes, steps = np.empty((offsets[-1], TILE, ROW), np.uint16), np.empty((offsets[-1], 5), np.float32)
    share_out(_fill, threads, aligned(threads, 3, TILE, ROW), *scene, offsets, ends, planes, steps)
    return Layers(offsets, depths[np.arange(count) < numbers[:, None]], planes, steps)


@inlined()
def _dimmed(before, through):
    """Light of a pixel behind a layer that lets the share `through` of it through; a finished pixel stays as it is."""
    return before * through if before > F(0) else before


@inlined()
def blend_layer(planes, steps, k, tile):
    """Blend layer k into a tile [16, 80] behind what the tile holds."""
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
            row[LIGHT + x] = _dimmed(before, through * F(own[LIGHT + x]))


@inlined()
def pass_layer(planes, steps, k, tile):
    """Subtract layer k from the part behind in a tile [16, 96] of the backward pass."""
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
            row[LIGHT + x] = _dimmed(before, through * F(own[LIGHT + x]))
