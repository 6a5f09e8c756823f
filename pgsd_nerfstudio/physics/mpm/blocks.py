"""Which blocks of the grid exist now, and which particles lie in which.

A block owns the particles whose lowest node lies in it; their stencils reach two nodes into the next block on each axis. The
particles of a block add to a patch of 6 x 6 x 6 nodes of their own (its halo), and each node then takes its sum from the
patches that cover it: no atomics, and the same input gives the same sums, bit for bit, on any number of threads.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

from typing import Any

import taichi as ti
import torch

from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    BLOCK,
    CELLS,
    HALO,
    NODE,
    STATE,
    Array1,
    Array2,
    Rows,
    Tags,
    X,
    base_node,
    block_at,
    block_of,
    read3,
)

# Columns per block: number of particles, their first place in the order, number of its halo, whether it is touched, whether
# its particles must wake.
COUNT, BEGIN, SLOT, MARK, WAKES = 0, 1, 2, 3, 4
OCCUPIED, TOUCHED = 0, 1  # columns of the lists: blocks with particles, blocks within their reach
N_OCCUPIED, N_TOUCHED, N_PARTICLES, N_WAKING = 0, 1, 2, 3  # in heads; the last is 0 or 1
HEADS = 4


class Blocks:
    """Tables of the blocks of a grid of bx x by x bz blocks."""

    def __init__(self, shape: tuple[int, int, int], dtype: torch.dtype, device: str) -> None:
        count = shape[0] * shape[1] * shape[2]
        ints: dict[str, Any] = {"dtype": torch.int32, "device": device}
        self.shape = shape
        self.table = torch.zeros(count, 5, **ints)
        self.lists = torch.zeros(count, 2, **ints)
        self.heads = torch.zeros(HEADS, **ints)
        self.halo = torch.zeros(0, NODE, dtype=dtype, device=device)

    def make_room(self) -> None:
        """Halos for all occupied blocks."""
        needed = int(self.heads[N_OCCUPIED]) * HALO
        if needed > len(self.halo):
            self.halo = self.halo.new_zeros(needed + needed // 2, NODE)


@ti.kernel
def sort(
    state: Rows,
    tags: Tags,
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
    """Order the listed particles by block, stably, and list the blocks that they are in and the blocks that they touch."""
    for a in range(count):
        p = listed[a]
        block = -1
        if tags[p][STATE] == ACTIVE:
            block = block_of(base_node(read3(state, p, X), inv_dx), by, bz)
        tags[p][BLOCK] = block
    ti.loop_config(serialize=True)
    for _ in range(1):
        for t in range(heads[N_TOUCHED]):
            table[lists[t, TOUCHED], COUNT] = 0
            table[lists[t, TOUCHED], MARK] = 0
        occupied, touched, begin = 0, 0, 0
        for a in range(count):
            block = tags[listed[a]][BLOCK]
            if block >= 0:
                if table[block, COUNT] == 0:
                    lists[occupied, OCCUPIED] = block
                    table[block, SLOT] = occupied
                    occupied += 1
                table[block, COUNT] += 1
        for o in range(occupied):
            block = lists[o, OCCUPIED]
            table[block, BEGIN] = begin
            begin += table[block, COUNT]
            table[block, COUNT] = 0
            at = block_at(block, by, bz)
            for q in range(8):
                i, j, k = at[0] + q // 4, at[1] + (q // 2) % 2, at[2] + q % 2
                if i < bx and j < by and k < bz:
                    near = (i * by + j) * bz + k
                    if table[near, MARK] == 0:
                        table[near, MARK] = 1
                        lists[touched, TOUCHED] = near
                        touched += 1
        for a in range(count):
            block = tags[listed[a]][BLOCK]
            if block >= 0:
                order[table[block, BEGIN] + table[block, COUNT]] = listed[a]
                table[block, COUNT] += 1
        heads[N_OCCUPIED] = occupied
        heads[N_TOUCHED] = touched
        heads[N_PARTICLES] = begin


@ti.func
def touch(block, table: ti.template(), lists: ti.template(), heads: ti.template()):
    """List a block that particles reach, in parallel and without an order."""
    if ti.atomic_max(table[block, MARK], 1) == 0:
        lists[ti.atomic_add(heads[N_TOUCHED], 1), TOUCHED] = block


@ti.func
def first_cell(t):
    """Whether t is the first number of a block's CELLS.

    Taichi gives a thread 512 turns of a loop at least, so a loop over blocks counts cells and does a block at its first.
    """
    return t % CELLS == 0
