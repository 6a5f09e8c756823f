"""Between particles and grid: affine particle-in-cell transfers (Jiang et al. 2015) of MLS-MPM (Hu et al. 2018).

Weights are quadratic B-splines. The stress enters as part of the affine momentum, 4 / dx^2 being the inverse of the spline's
second moment. Mass and momentum of a node are one vector of four, and are added as one.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

from pgsd_nerfstudio.physics.mpm.blocks import BEGIN, COUNT, SLOT
from pgsd_nerfstudio.physics.mpm.layout import (
    CELLS,
    EDGE,
    HALO,
    MARGIN,
    MASS,
    REACH,
    TAU,
    C,
    V,
    X,
    axis_terms,
    base_node,
    block_at,
    read3,
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
def scattered(state: ti.template(), p, offset, dt, dx):
    """What a particle gives to its lowest node, [mass, momentum] but for the weight, and how much more a node further along."""
    mass, stress = state[p][MASS], 4.0 * dt / dx
    c, tau = C, TAU
    along_x = ti.Vector([0.0, 0.0, 0.0, 0.0])
    along_y = ti.Vector([0.0, 0.0, 0.0, 0.0])
    along_z = ti.Vector([0.0, 0.0, 0.0, 0.0])
    rows = ti.static(((0, 1, 2), (1, 3, 4), (2, 4, 5)))  # of the symmetric stress
    for i in ti.static(range(3)):
        along_x[i + 1] = mass * dx * state[p][c + 3 * i] - stress * state[p][tau + rows[i][0]]
        along_y[i + 1] = mass * dx * state[p][c + 3 * i + 1] - stress * state[p][tau + rows[i][1]]
        along_z[i + 1] = mass * dx * state[p][c + 3 * i + 2] - stress * state[p][tau + rows[i][2]]
    first = mass * ti.Vector([1.0, state[p][V], state[p][V + 1], state[p][V + 2]])
    return first - offset[0] * along_x - offset[1] * along_y - offset[2] * along_z, along_x, along_y, along_z


@ti.func
def scatter_block(state: ti.template(), halo: ti.template(), order: ti.template(), table: ti.template(), block, dt, dx, by, bz):
    """Mass and momentum of a block's particles, into its halo."""
    slot, corner, inv_dx = table[block, SLOT], block_at(block, by, bz) * EDGE, 1.0 / dx
    for n in range(HALO):
        halo[slot * HALO + n] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for a in range(table[block, BEGIN], table[block, BEGIN] + table[block, COUNT]):
        p = order[a]
        x = read3(state, p, X)
        # Should another rounding of the same formula put it into the next block, then the spline continues smoothly.
        local = ti.min(ti.max(base_node(x, inv_dx) - corner, 0), EDGE - 1)
        offset = x * inv_dx - (local + corner - MARGIN)
        weights = spline(offset)
        given, along_x, along_y, along_z = scattered(state, p, offset, dt, dx)
        first = slot * HALO + (local[0] * REACH + local[1]) * REACH + local[2]
        for i, j in ti.static(ti.ndrange(3, 3)):
            here = given + i * along_x + j * along_y
            for k in ti.static(range(3)):
                node = first + (i * REACH + j) * REACH + k
                halo[node] = halo[node] + weights[0, i] * weights[1, j] * weights[2, k] * here
                here += along_z


@ti.func
def collect_block(grid: ti.template(), halo: ti.template(), table: ti.template(), block, by, bz):
    """Sums of all halos over the nodes of a block, always in the same order."""
    at = block_at(block, by, bz)
    for n in range(CELLS):
        grid[block * CELLS + n] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for q in range(8):
        back = ti.Vector([q // 4, (q // 2) % 2, q % 2])
        owner = at - back
        if owner.min() >= 0:
            near = (owner[0] * by + owner[1]) * bz + owner[2]
            if table[near, COUNT] > 0:
                last = EDGE - 2 * back  # the halo reaches two nodes beyond its own block
                first = table[near, SLOT] * HALO + (back[0] * REACH + back[1]) * REACH * EDGE + back[2] * EDGE
                for i in range(last[0]):
                    for j in range(last[1]):
                        for k in range(last[2]):
                            node = block * CELLS + (i * EDGE + j) * EDGE + k
                            grid[node] = grid[node] + halo[first + (i * REACH + j) * REACH + k]


@ti.func
def scatter_atomic(state: ti.template(), grid: ti.template(), p, dt, dx, by, bz):
    """Mass and momentum of a particle, onto the grid with atomics."""
    x, inv_dx = read3(state, p, X), 1.0 / dx
    base = base_node(x, inv_dx)
    offset = x * inv_dx - (base - MARGIN)
    weights, terms = spline(offset), axis_terms(base, by, bz)
    given, along_x, along_y, along_z = scattered(state, p, offset, dt, dx)
    for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
        here = weights[0, i] * weights[1, j] * weights[2, k] * (given + i * along_x + j * along_y + k * along_z)
        for d in ti.static(range(4)):
            grid[terms[0, i] + terms[1, j] + terms[2, k]][d] += here[d]


@ti.func
def gathered(grid: ti.template(), x, inv_dx, by, bz):
    """Velocity at a position and its gradient in 1/s."""
    base = base_node(x, inv_dx)
    offset = x * inv_dx - (base - MARGIN)
    weights, terms = spline(offset), axis_terms(base, by, bz)
    arms = weights  # weight times distance to the node, in cells
    for d, i in ti.static(ti.ndrange(3, 3)):
        arms[d, i] = weights[d, i] * (i - offset[d])
    zero = ti.Vector([0.0, 0.0, 0.0, 0.0])
    mean, along_x, along_y, along_z = zero, zero, zero, zero
    for i in ti.static(range(3)):
        mean_i, along_y_i, along_z_i = zero, zero, zero
        for j in ti.static(range(3)):
            mean_ij, along_z_ij = zero, zero
            for k in ti.static(range(3)):
                node = grid[terms[0, i] + terms[1, j] + terms[2, k]]
                mean_ij += weights[2, k] * node
                along_z_ij += arms[2, k] * node
            mean_i += weights[1, j] * mean_ij
            along_y_i += arms[1, j] * mean_ij
            along_z_i += weights[1, j] * along_z_ij
        mean += weights[0, i] * mean_i
        along_x += arms[0, i] * mean_i
        along_y += weights[0, i] * along_y_i
        along_z += weights[0, i] * along_z_i
    velocity = ti.Vector([mean[1], mean[2], mean[3]])
    gradient = ti.Matrix.zero(float, 3, 3)
    for d in ti.static(range(3)):
        gradient[d, 0] = 4.0 * inv_dx * along_x[d + 1]
        gradient[d, 1] = 4.0 * inv_dx * along_y[d + 1]
        gradient[d, 2] = 4.0 * inv_dx * along_z[d + 1]
    return velocity, gradient


def grid_shape(size: tuple[float, float, float], dx: float) -> tuple[int, int, int]:
    """Blocks per axis that cover a domain and its margin."""
    bx, by, bz = (-(-(round(length / dx + 0.499999) + 2 * MARGIN + 1) // EDGE) for length in size)
    return bx, by, bz
