"""Between particles and grid: affine particle-in-cell transfers (Jiang et al. 2015) of MLS-MPM (Hu et al. 2018).

Weights are quadratic B-splines. The stress enters as part of the affine momentum, 4 / dx^2 being the inverse of the spline's
second moment.
"""

import taichi as ti

from pgsd_nerfstudio.physics.mpm.blocks import BEGIN, COUNT, QUEUE
from pgsd_nerfstudio.physics.mpm.contact import pushed_out
from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    EDGE,
    MARGIN,
    MASS,
    REMOVED,
    STATE,
    TAU,
    Array1,
    Array2,
    C,
    V,
    X,
    axis_terms,
    base_node,
    read3,
    read33,
    write3,
    write33,
)


@ti.func
def spline(offset):
    """Weights of three nodes per axis, weights[axis, node], for a particle `offset` cells above the lowest."""
    weights = ti.Matrix.zero(float, 3, 3)
    for i in ti.static(range(3)):
        weights[i, 0] = 0.5 * (1.5 - offset[i]) ** 2
        weights[i, 1] = 0.75 - (offset[i] - 1.0) ** 2
        weights[i, 2] = 0.5 * (offset[i] - 0.5) ** 2
    return weights


@ti.func
def scatter_one(state: ti.template(), grid: ti.template(), p, dt, dx, inv_dx, by, bz, atomic: ti.template()):
    """Add a particle's mass and momentum to its nodes."""
    x, mass = read3(state, p, X), state[p, MASS]
    affine = mass * read33(state, p, C) - (4.0 * dt * inv_dx * inv_dx) * read33(state, p, TAU)
    base = base_node(x, inv_dx)
    offset = x * inv_dx - (base - MARGIN)
    weights, terms = spline(offset), axis_terms(base, by, bz)
    momentum = mass * read3(state, p, V) - affine @ (offset * dx)
    for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
        w = weights[0, i] * weights[1, j] * weights[2, k]
        node = terms[0, i] + terms[1, j] + terms[2, k]
        given = w * (momentum + affine @ (ti.Vector([i, j, k]) * dx))
        if ti.static(atomic):
            grid[node, 0] += w * mass
            for d in ti.static(range(3)):
                grid[node, 1 + d] += given[d]
        else:
            grid[node, 0] = grid[node, 0] + w * mass
            for d in ti.static(range(3)):
                grid[node, 1 + d] = grid[node, 1 + d] + given[d]


@ti.kernel
def scatter_colour(
    state: Array2,
    grid: Array2,
    order: Array1,
    table: Array2,
    lists: Array2,
    heads: Array1,
    colour: int,
    dt: float,
    dx: float,
    by: int,
    bz: int,
):
    """Particles of all blocks of one colour to the grid, without atomics."""
    ti.loop_config(block_dim=1)
    for q in range(heads[colour], heads[colour + 1]):
        block = lists[q, QUEUE]
        for a in range(table[block, BEGIN], table[block, BEGIN] + table[block, COUNT]):
            scatter_one(state, grid, order[a], dt, dx, 1.0 / dx, by, bz, False)


@ti.kernel
def scatter_atomic(
    state: Array2, tags: Array2, grid: Array2, order: Array1, count: int, dt: float, dx: float, by: int, bz: int
):
    """All particles to the grid, with atomics."""
    for a in range(count):
        if tags[order[a], STATE] == ACTIVE:
            scatter_one(state, grid, order[a], dt, dx, 1.0 / dx, by, bz, True)


@ti.kernel
def gather(
    state: Array2,
    tags: Array2,
    grid: Array2,
    wall: Array2,
    order: Array1,
    count: int,
    parts: int,
    dt: float,
    dx: float,
    by: int,
    bz: int,
    top_x: float,
    top_y: float,
    top_z: float,
):
    """Velocities from the grid, then one step of travel; what leaves the domain (0..top) is removed."""
    top = ti.Vector([top_x, top_y, top_z])
    for a in range(count):
        p = order[a]
        if tags[p, STATE] == ACTIVE:
            inv_dx = 1.0 / dx
            x = read3(state, p, X)
            base = base_node(x, inv_dx)
            offset = x * inv_dx - (base - MARGIN)
            weights, terms = spline(offset), axis_terms(base, by, bz)
            velocity = ti.Vector.zero(float, 3)
            moment = ti.Matrix.zero(float, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                w = weights[0, i] * weights[1, j] * weights[2, k]
                v = w * read3(grid, terms[0, i] + terms[1, j] + terms[2, k], 1)
                velocity += v
                moment += v.outer_product(ti.Vector([i, j, k]) - offset)
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
            write33(state, p, C, moment * (4.0 * inv_dx))
            if inside == 0:
                tags[p, STATE] = REMOVED


def grid_shape(size: tuple[float, float, float], dx: float) -> tuple[int, int, int]:
    """Blocks per axis that cover a domain and its margin."""
    bx, by, bz = (-(-(round(length / dx + 0.499999) + 2 * MARGIN + 1) // EDGE) for length in size)
    return bx, by, bz
