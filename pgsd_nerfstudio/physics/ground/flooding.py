"""Flood of a map of heights from its outlets upward, the hollows that it finds, and the way of the water to them.

Priority-flood: Barnes, Lehman & Mulla, "Priority-flood: An optimal depression-filling and watershed-labeling algorithm for
digital elevation models" (2014).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.ground.ground_map import patches

SMALLEST = 0.01  # m^2; smaller hollows hold no water that one would see as a puddle


def basins_of(
    water: ndarray, filled: Float[ndarray, "x y"], cell: float, order: Int[ndarray, " n"]
) -> tuple[Int[ndarray, "x y"], int]:
    """Number of the hollow of each cell, those reached by the flood last first, and how many there are.

    The flood goes upstream, so a hollow that it reaches later can only spill into one that it reached before.
    """
    if not water.any():
        return np.full(water.shape, -1), 0
    labels, _ = patches(water)
    # Neighbouring hollows of different level touch where one spills into the other.
    levels = np.unique(np.stack([labels[water], filled[water].view(np.int64)]), axis=1, return_inverse=True)
    separate = np.zeros(water.shape, int)
    separate[water] = np.ravel(levels[1]) + 1
    count = levels[0].shape[1]
    large = np.bincount(separate.ravel(), minlength=count + 1) * cell**2 >= SMALLEST
    large[0] = False
    reached = np.full(count + 1, -1)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    np.maximum.at(reached, separate.ravel(), rank)
    kept = np.flatnonzero(large)
    kept = kept[np.argsort(-reached[kept])]
    number = np.full(count + 1, -1)
    number[kept] = np.arange(len(kept))
    return number[separate], len(kept)


@kernel()
def flood(heights: ndarray, drains: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Flood a map from its border, from unknown cells (-inf) and from drains upward.

    Args:
        heights: [x, y] m.
        drains: [x, y] height above which a cell drains, m; -inf: it does not.

    Returns:
        The filled heights; the cell, as a flat index, from which the flood reached each cell, -1 for an outlet; and all cells
        in the order in which the flood left them.
    """
    nx, ny = heights.shape
    n = nx * ny
    filled = np.full(n, np.inf)
    parent = np.full(n, -1, np.int64)
    order = np.empty(n, np.int64)
    heap_height = np.empty(n + 1)
    heap_cell = np.empty(n + 1, np.int64)
    size = 0
    seen = np.zeros(n, np.bool_)
    for i in range(nx):
        for j in range(ny):
            at = i * ny + j
            edge = i == 0 or j == 0 or i == nx - 1 or j == ny - 1 or heights[i, j] == -np.inf
            if edge or drains[i, j] > -np.inf:
                filled[at] = heights[i, j] if edge else max(heights[i, j], drains[i, j])
                seen[at] = True
                size = _push(heap_height, heap_cell, size, filled[at], at)
    done = 0
    while size > 0:
        level, at = heap_height[0], heap_cell[0]
        size = _pop(heap_height, heap_cell, size)
        order[done] = at
        done += 1
        i, j = at // ny, at % ny
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if a < 0 or b < 0 or a >= nx or b >= ny:
                    continue
                other = a * ny + b
                if not seen[other]:
                    seen[other] = True
                    filled[other] = max(level, heights[a, b])
                    parent[other] = at
                    size = _push(heap_height, heap_cell, size, filled[other], other)
    return filled.reshape(nx, ny), parent, order


@kernel()
def _push(heights: ndarray, cells: ndarray, size: int, height: Any, cell: int) -> int:
    """Add to a binary heap; returns its size."""
    at = size
    while at > 0:
        up = (at - 1) // 2
        if heights[up] <= height:
            break
        heights[at], cells[at] = heights[up], cells[up]
        at = up
    heights[at], cells[at] = height, cell
    return size + 1


@kernel()
def _pop(heights: ndarray, cells: ndarray, size: int) -> int:
    """Remove the lowest of a binary heap; returns its size."""
    size -= 1
    height, cell = heights[size], cells[size]
    at = 0
    while True:
        down = 2 * at + 1
        if down >= size:
            break
        if down + 1 < size and heights[down + 1] < heights[down]:
            down += 1
        if heights[down] >= height:
            break
        heights[at], cells[at] = heights[down], cells[down]
        at = down
    heights[at], cells[at] = height, cell
    return size


@kernel()
def ways_of(basin: ndarray, parent: ndarray, order: ndarray, rained_on: ndarray, count: int) -> tuple[ndarray, ndarray]:
    """The hollow that each hollow spills into, and the number of cells whose water comes to each first."""
    n = len(order)
    first = np.full(n, -1, np.int64)  # hollow that a cell's water comes to first
    into = np.full(count, -1, np.int64)
    catchment = np.zeros(count)
    for k in range(n):  # downstream cells come first
        at = order[k]
        own, way = basin[at], parent[at]
        below = first[way] if way >= 0 else -1
        first[at] = own if own >= 0 else below
        if own >= 0 and below != own:
            into[own] = below
        if rained_on[at] and first[at] >= 0:
            catchment[first[at]] += 1.0
    return into, catchment
