"""The way of every active particle to the grid and back, as one kernel; `constitutive.respond` completes the substep.

The CPU makes three passes, each over all threads: particles of a block to its halo, halos to nodes, nodes to particles. On the
GPU particles add to the nodes with atomics instead.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

from pgsd_nerfstudio.physics.mpm.blocks import (
    MARK,
    N_OCCUPIED,
    N_PARTICLES,
    N_TOUCHED,
    N_WAKING,
    OCCUPIED,
    TOUCHED,
    WAKES,
    first_cell,
    touch,
)
from pgsd_nerfstudio.physics.mpm.contact import moved, pushed_out
from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    CELLS,
    EDGE,
    REMOVED,
    STATE,
    Array1,
    Array2,
    C,
    Nodes,
    Rows,
    Tags,
    V,
    X,
    base_node,
    block_at,
    block_of,
    read3,
    write3,
    write33,
)
from pgsd_nerfstudio.physics.mpm.transfer import collect_block, gathered, scatter_atomic, scatter_block


@ti.func
def move_node(
    grid: ti.template(),
    wall: ti.template(),
    rest: ti.template(),
    table: ti.template(),
    heads: ti.template(),
    node,
    parts,
    resting,
    wake_speed,
    dt,
    gravity,
    by,
    bz,
):
    """Momentum to velocity; matter that must wake is marked in all blocks whose particles share the node."""
    row = grid[node]
    if row[0] > 0.0:
        v, wakes = moved(row, wall, rest, node, parts, resting, wake_speed, dt, gravity)
        write3(grid, node, 1, v)
        if wakes == 1:
            heads[N_WAKING] = 1
            block, cell = node // CELLS, node % CELLS
            place = ti.Vector([cell // EDGE**2, (cell // EDGE) % EDGE, cell % EDGE])
            for q in range(8):
                back = ti.Vector([q // 4, (q // 2) % 2, q % 2])
                owner = block_at(block, by, bz) - back
                if owner.min() >= 0 and (place + EDGE * back).max() < EDGE + 2:
                    table[(owner[0] * by + owner[1]) * bz + owner[2], WAKES] = 1


@ti.func
def move_particle(
    state: ti.template(),
    tags: ti.template(),
    grid: ti.template(),
    wall: ti.template(),
    p,
    parts,
    dt,
    dx,
    by,
    bz,
    top,
):
    """Velocity from the grid and one step of travel; a particle that leaves the domain (0..top) is removed."""
    inv_dx = 1.0 / dx
    x = read3(state, p, X)
    velocity, gradient = gathered(grid, x, inv_dx, by, bz)
    # The time step keeps travel below a cell; where a force made more of it, the rest waits for the next step.
    travel = dt * velocity
    longest = ti.max(ti.abs(travel[0]), ti.abs(travel[1]), ti.abs(travel[2]))
    if longest > dx:
        travel *= dx / longest
    x += travel
    inside = 1
    for d in ti.static(range(3)):
        # Whole numbers: a position that is not a number fails the test instead of passing it.
        cell = ti.cast(ti.floor(x[d] * inv_dx), ti.i32)
        if cell < 0 or cell > ti.cast(top[d] * inv_dx, ti.i32) + 1 or x[d] > top[d]:
            inside = 0
    if inside == 1 and parts > 0:
        x, velocity = pushed_out(wall, parts, x, velocity, inv_dx, by, bz, top)
        for d in ti.static(range(3)):
            if x[d] < 0.0 or x[d] > top[d]:
                inside = 0
    write3(state, p, X, x)
    write3(state, p, V, velocity)
    write33(state, p, C, gradient)
    if inside == 0:
        tags[p][STATE] = REMOVED


@ti.kernel
def advance(
    state: Rows,
    tags: Tags,
    order: Array1,
    table: Array2,
    lists: Array2,
    heads: Array1,
    halo: Nodes,
    grid: Nodes,
    wall: Array2,
    rest: Array2,
    parts: int,
    resting: int,
    wake_speed: float,
    dt: float,
    dx: float,
    by: int,
    bz: int,
    gx: float,
    gy: float,
    gz: float,
    top_x: float,
    top_y: float,
    top_z: float,
):
    """One substep without atomics, after `blocks.sort`; its sums repeat to the bit."""
    gravity, top = ti.Vector([gx, gy, gz]), ti.Vector([top_x, top_y, top_z])
    for t in range(heads[N_OCCUPIED] * CELLS):
        if first_cell(t):
            scatter_block(state, halo, order, table, lists[t // CELLS, OCCUPIED], dt, dx, by, bz)
    for t in range(heads[N_TOUCHED] * CELLS):
        if first_cell(t):
            block = lists[t // CELLS, TOUCHED]
            collect_block(grid, halo, table, block, by, bz)
            for n in range(block * CELLS, (block + 1) * CELLS):
                move_node(grid, wall, rest, table, heads, n, parts, resting, wake_speed, dt, gravity, by, bz)
    for a in range(heads[N_PARTICLES]):
        move_particle(state, tags, grid, wall, order[a], parts, dt, dx, by, bz, top)


# A kernel of its own, although one with a static flag gives the same bits: that has an argument more, which every launch pays.
# Substeps of 300 particles took 3 to 6 % more CPU time (0.56 to 0.59 ms; one thread, time.process_time around 60 steps
# Mpm.step(0.004) of thrown snow, in turns with two kernels); with 20,000 particles there was no difference.
@ti.kernel
def advance_atomic(
    state: Rows,
    tags: Tags,
    listed: Array1,
    table: Array2,
    lists: Array2,
    heads: Array1,
    grid: Nodes,
    wall: Array2,
    rest: Array2,
    count: int,
    parts: int,
    resting: int,
    wake_speed: float,
    dt: float,
    dx: float,
    by: int,
    bz: int,
    gx: float,
    gy: float,
    gz: float,
    top_x: float,
    top_y: float,
    top_z: float,
):
    """One substep with atomics, for the GPU; the order of its sums does not repeat."""
    gravity, top = ti.Vector([gx, gy, gz]), ti.Vector([top_x, top_y, top_z])
    for t in range(heads[N_TOUCHED] * CELLS):
        block = lists[t // CELLS, TOUCHED]
        grid[block * CELLS + t % CELLS] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        if t % CELLS == 0:
            table[block, MARK] = 0
    for _ in range(1):
        heads[N_TOUCHED] = 0
    for a in range(count):
        p = listed[a]
        if tags[p][STATE] == ACTIVE:
            base = base_node(read3(state, p, X), 1.0 / dx)
            for q in range(8):
                touch(block_of(base + 2 * ti.Vector([q // 4, (q // 2) % 2, q % 2]), by, bz), table, lists, heads)
            scatter_atomic(state, grid, p, dt, dx, by, bz)
    for t in range(heads[N_TOUCHED] * CELLS):
        node = lists[t // CELLS, TOUCHED] * CELLS + t % CELLS
        move_node(grid, wall, rest, table, heads, node, parts, resting, wake_speed, dt, gravity, by, bz)
    for a in range(count):
        if tags[listed[a]][STATE] == ACTIVE:
            move_particle(state, tags, grid, wall, listed[a], parts, dt, dx, by, bz, top)
