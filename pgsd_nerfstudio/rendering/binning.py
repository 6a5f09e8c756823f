"""Tile lists: which splats each tile of the image must look at, nearest first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pgsd_nerfstudio.rendering.compilation import kernel
from pgsd_nerfstudio.rendering.projection import BOTTOM, DEPTH, LEFT, RIGHT, TOP
from pgsd_nerfstudio.rendering.rasterizer import TILE


class Binned(NamedTuple):
    """Splats of one camera in order of depth, and for each tile the list of those that enter it."""

    splats: np.ndarray
    """[m, 16] float32, columns as in projection.py; the splats that touch the image, nearest first."""
    offsets: np.ndarray
    """[tiles + 1] int32: tile t has entries[offsets[t]:offsets[t + 1]]; tiles are numbered row by row."""
    entries: np.ndarray
    """[k] int32 rows of `splats`, ascending in each tile, so nearest first."""

    @property
    def nbytes(self) -> int:
        return self.splats.nbytes + self.offsets.nbytes + self.entries.nbytes


@kernel()
def visible_by_depth(splats):
    """Rows [m] int32 of the splats that touch the image, nearest first; splats of equal depth keep their order.

    This is a radix sort on the bits of the depths: positive floats order like their bits.
    """
    count = 0
    for i in range(splats.shape[0]):
        if splats[i, LEFT] < splats[i, RIGHT]:
            count += 1
    order, other = np.empty(count, np.int32), np.empty(count, np.int32)
    keys, other_keys = np.empty(count, np.float32), np.empty(count, np.uint32)
    count = 0
    for i in range(splats.shape[0]):
        if splats[i, LEFT] < splats[i, RIGHT]:
            order[count] = i
            keys[count] = splats[i, DEPTH]
            count += 1
    bits = keys.view(np.uint32)
    for shift in (0, 11, 22):
        place = np.zeros(2049, np.int64)
        for i in range(count):
            place[((bits[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            place[digit + 1] += place[digit]
        for i in range(count):
            digit = (bits[i] >> np.uint32(shift)) & np.uint32(2047)
            other[place[digit]] = order[i]
            other_keys[place[digit]] = bits[i]
            place[digit] += 1
        order, other = other, order
        bits, other_keys = other_keys, bits
    return order


@kernel()
def _tile_lists(splats, width, height):
    """Offsets and entries by a counting sort: one pass counts the splats of each tile, another fills the lists by depth."""
    across = (width + TILE - 1) // TILE
    down = (height + TILE - 1) // TILE
    offsets = np.zeros(across * down + 1, np.int32)
    for i in range(splats.shape[0]):
        for row in range(int(splats[i, TOP]) // TILE, (int(splats[i, BOTTOM]) - 1) // TILE + 1):
            for column in range(int(splats[i, LEFT]) // TILE, (int(splats[i, RIGHT]) - 1) // TILE + 1):
                offsets[row * across + column + 1] += 1
    for tile in range(across * down):
        offsets[tile + 1] += offsets[tile]
    entries = np.empty(offsets[across * down], np.int32)
    place = offsets.copy()
    for i in range(splats.shape[0]):
        for row in range(int(splats[i, TOP]) // TILE, (int(splats[i, BOTTOM]) - 1) // TILE + 1):
            for column in range(int(splats[i, LEFT]) // TILE, (int(splats[i, RIGHT]) - 1) // TILE + 1):
                tile = row * across + column
                entries[place[tile]] = i
                place[tile] += 1
    return offsets, entries


def bin_splats(splats: np.ndarray, width: int, height: int) -> Binned:
    """Tile lists of splats.

    Args:
        splats: [m, 16] float32 in order of depth, nearest first, columns as in projection.py.
        width: of the image in pixels.
        height: of the image in pixels.
    """
    return Binned(splats, *_tile_lists(splats, width, height))


def keep_entries(binned: Binned, needed: np.ndarray) -> Binned:
    """The tile lists without the entries that are not needed, and without splats that no list holds any more.

    Args:
        binned: the lists.
        needed: [k] bool, one for each entry.
    """
    before = np.concatenate([[0], np.cumsum(needed)])
    entries = binned.entries[needed]
    used = np.zeros(len(binned.splats), bool)
    used[entries] = True
    rank = np.cumsum(used) - 1
    return Binned(binned.splats[used], before[binned.offsets].astype(np.int32), rank[entries].astype(np.int32))
