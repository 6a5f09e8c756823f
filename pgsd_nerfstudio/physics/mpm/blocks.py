"""Which blocks of the grid exist now, and which particles lie in which.

A block owns the particles whose lowest node lies in it; their stencils reach into the next block on each axis at most. So
blocks of one colour (parity on three axes: eight colours) never write to the same node, and a pass per colour needs no
atomics. On the CPU particles are counted into blocks by one thread, stably: the same input gives the same sums, bit for bit.
"""

from dataclasses import dataclass

import taichi as ti
import torch
from torch import Tensor

from pgsd_nerfstudio.physics.mpm.layout import ACTIVE, BLOCK, CELLS, NODE, STATE, Array1, Array2, X, base_node, block_of, read3

COUNT, BEGIN, MARK = 0, 1, 2  # columns per block: particles, where they begin in the order, whether it is touched
OCCUPIED, QUEUE, TOUCHED = 0, 1, 2  # columns of the lists: blocks with particles, the same by colour, blocks within reach
COLOURS = 8
N_TOUCHED, N_OCCUPIED, N_PARTICLES = 9, 10, 11  # in heads, after the beginnings of the colours in the queue
HEADS = 12


@dataclass(frozen=True)
class Blocks:
    """Tables of the blocks of a grid of bx x by x bz blocks."""

    shape: tuple[int, int, int]
    table: Tensor  # int32 [blocks, 3]
    lists: Tensor  # int32 [blocks, 3]
    heads: Tensor  # int32 [HEADS]

    @staticmethod
    def of(shape: tuple[int, int, int], device: str) -> "Blocks":
        count = shape[0] * shape[1] * shape[2]
        ints = {"dtype": torch.int32, "device": device}
        return Blocks(shape, torch.zeros(count, 3, **ints), torch.zeros(count, 3, **ints), torch.zeros(HEADS, **ints))


@ti.func
def colour_of(block, by, bz):
    return ((block // (by * bz)) & 1) * 4 + (((block // bz) % by) & 1) * 2 + ((block % bz) & 1)


@ti.kernel
def clear(grid: Array2, table: Array2, lists: Array2, heads: Array1):
    """Empty what was touched before."""
    for t in range(heads[N_TOUCHED] * CELLS):
        block = lists[t // CELLS, TOUCHED]
        for i in ti.static(range(NODE)):
            grid[block * CELLS + t % CELLS, i] = 0.0
        if t % CELLS == 0:
            table[block, COUNT] = 0
            table[block, MARK] = 0


@ti.kernel
def sort(
    state: Array2,
    tags: Array2,
    listed: Array1,
    order: Array1,
    table: Array2,
    lists: Array2,
    heads: Array1,
    count: int,
    inv_dx: float,
    bx: int,
    by: int,
    bz: int,
):
    """Order the listed particles by block and colour, and list the touched blocks; one thread."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        occupied = 0
        for h in range(COLOURS + 1):
            heads[h] = 0
        for a in range(count):
            p = listed[a]
            if tags[p, STATE] == ACTIVE:
                block = block_of(base_node(read3(state, p, X), inv_dx), by, bz)
                tags[p, BLOCK] = block
                if table[block, COUNT] == 0:
                    lists[occupied, OCCUPIED] = block
                    heads[colour_of(block, by, bz) + 1] += 1
                    occupied += 1
                table[block, COUNT] += 1
        for h in range(COLOURS):
            heads[h + 1] += heads[h]
        # Place blocks by colour; heads[colour] runs to the end of its colour and is set back afterwards.
        for o in range(occupied):
            block = lists[o, OCCUPIED]
            colour = colour_of(block, by, bz)
            lists[heads[colour], QUEUE] = block
            heads[colour] += 1
        for h in range(COLOURS):
            heads[COLOURS - h] = heads[COLOURS - h - 1]
        heads[0] = 0
        begin, touched = 0, 0
        for o in range(occupied):
            block = lists[o, QUEUE]
            table[block, BEGIN] = begin
            begin += table[block, COUNT]
            table[block, COUNT] = 0
            for q in range(8):
                i, j, k = block // (by * bz) + q // 4, (block // bz) % by + (q // 2) % 2, block % bz + q % 2
                if i < bx and j < by and k < bz:
                    near = (i * by + j) * bz + k
                    if table[near, MARK] == 0:
                        table[near, MARK] = 1
                        lists[touched, TOUCHED] = near
                        touched += 1
        for a in range(count):
            p = listed[a]
            if tags[p, STATE] == ACTIVE:
                block = tags[p, BLOCK]
                order[table[block, BEGIN] + table[block, COUNT]] = p
                table[block, COUNT] += 1
        heads[N_TOUCHED] = touched
        heads[N_OCCUPIED] = occupied
        heads[N_PARTICLES] = begin


@ti.kernel
def touch(
    state: Array2,
    tags: Array2,
    listed: Array1,
    order: Array1,
    table: Array2,
    lists: Array2,
    heads: Array1,
    count: int,
    inv_dx: float,
    by: int,
    bz: int,
):
    """List the touched blocks, in parallel and without an order: for the GPU, whose scattering is atomic."""
    for _ in range(1):
        heads[N_TOUCHED] = 0
        heads[N_PARTICLES] = count
    for a in range(count):
        p = listed[a]
        order[a] = p
        if tags[p, STATE] == ACTIVE:
            base = base_node(read3(state, p, X), inv_dx)
            for q in range(8):
                corner = base + 2 * ti.Vector([q // 4, (q // 2) % 2, q % 2])
                near = block_of(corner, by, bz)
                if ti.atomic_max(table[near, MARK], 1) == 0:
                    lists[ti.atomic_add(heads[N_TOUCHED], 1), TOUCHED] = near
