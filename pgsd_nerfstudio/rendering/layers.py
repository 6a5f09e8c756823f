"""The frozen part of every tile pressed into a few layers, so that a frame costs little more than what moves.

A layer is what some consecutive frozen splats of a tile do together to each of its pixels: a premultiplied colour, a weighted
depth and the light they let through. Composited one after the other the layers are the frozen picture again, whatever their
number (Porter & Duff, "Compositing digital images", 1984: "over" is associative). What is lost is only the order against
dynamic splats that fly inside a layer: those are drawn wholly before or wholly behind it. Layers hold equal shares of the
blended weight of their tile, so they are thin where much is seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import LIGHT, ROW, B, G, R, Z, blend_splat, clear_tile
from pgsd_nerfstudio.rendering.compilation import aligned, inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import DEPTH
from pgsd_nerfstudio.rendering.rasterizer import TILE

F = np.float32


class Layers(NamedTuple):
    """The frozen splats of one camera as layers of its tiles."""

    offsets: np.ndarray
    """[tiles + 1] int32: the layers of tile t are offsets[t]:offsets[t + 1], nearest first."""
    depths: np.ndarray
    """[n] float32, scene units: half of the layer's weight lies nearer; dynamic splats from here on are behind it."""
    planes: np.ndarray
    """[n, 16, 80] uint16, rows as in blending.py: light let through, premultiplied colour, and depth weighted alike; in steps
    of `steps`. Half the bytes of float32, which is what walking layers costs most; the rounding is far below their error."""
    steps: np.ndarray
    """[n, 5] float32: what one step of each plane is worth; of light 2^-15, so that one is exact."""

    @property
    def nbytes(self) -> int:
        return self.offsets.nbytes + self.depths.nbytes + self.planes.nbytes + self.steps.nbytes


@inlined()
def _light_left(tile):
    """Sum over a tile of what is left of the light; of finished pixels too."""
    total = F(0)
    for y in range(TILE):
        row = tile[y]
        for x in range(16):
            total += abs(row[LIGHT + x])
    return total


@kernel()
def _split(frozen, t, tile, left, top, max_alpha, min_transmittance, count, ends, depths):
    """Where the layers of tile t end (entries, exclusive) and their depths; returns how many there are, at most `count`."""
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
        # The layer is full: its depth is where half of its weight is reached.
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
    """Numbers [tiles], ends [tiles, count] and depths [tiles, count] of the layers."""
    tile, across, down = tiles[worker], (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        left, top = (t % across) * TILE, (t // across) * TILE
        clear_tile(tile, min(TILE, width - left), min(TILE, height - top))
        numbers[t] = _split(frozen, t, tile, left, top, max_alpha, min_transmittance, count, ends[t], depths[t])


@kernel()
def _fill(worker, workers, tiles, frozen, width, height, max_alpha, min_transmittance, offsets, ends, planes, steps):
    """Planes of all layers: what changed in the tile from one end to the next, relative to the light that came in.

    The differences cancel where little light is left, and just there they count for as little: no dynamic splat adds light.
    """
    tile, before, layer = tiles[worker, 0], tiles[worker, 1], tiles[worker, 2]
    splats, entries = frozen.splats, frozen.entries
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for t in range(worker, across * down, workers):
        left, top = (t % across) * TILE, (t // across) * TILE
        clear_tile(tile, min(TILE, width - left), min(TILE, height - top))
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
    """A layer [16, 80] as whole numbers of steps [5]."""
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
    """At most `count` layers for each tile."""
    tiles, threads = len(frozen.offsets) - 1, workers()
    numbers, ends = np.zeros(tiles, np.int32), np.zeros((tiles, count), np.int32)
    depths = np.zeros((tiles, count), np.float32)
    scene = frozen, width, height, max_alpha, min_transmittance
    share_out(_split_all, threads, aligned(threads, TILE, ROW), *scene, count, numbers, ends, depths)
    offsets = np.concatenate([[0], np.cumsum(numbers)]).astype(np.int32)
    planes, steps = np.empty((offsets[-1], TILE, ROW), np.uint16), np.empty((offsets[-1], 5), np.float32)
    share_out(_fill, threads, aligned(threads, 3, TILE, ROW), *scene, offsets, ends, planes, steps)
    return Layers(offsets, depths[np.arange(count) < numbers[:, None]], planes, steps)
