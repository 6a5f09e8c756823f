"""What happens at obstacles and at matter that rests: on the nodes of the grid, and for each particle by itself.

Nodes: Coulomb friction on the relative velocity, separation is free. Particles: one that still ends inside is put back onto
the surface, so that nothing passes a plate, however fast.
"""

import taichi as ti

from pgsd_nerfstudio.physics.mpm.blocks import N_TOUCHED, TOUCHED
from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    CELLS,
    MARGIN,
    QUIET,
    RESTING,
    STATE,
    STICKS,
    VOLUME,
    WALL,
    Array1,
    Array2,
    V,
    X,
    axis_terms,
    base_node,
    read3,
    write3,
)

HELD = 0.5  # share of a node's volume that rests, from which the node counts as solid
FELT = 0.05  # share from which a particle counts as lying on resting matter


@ti.func
def slid(velocity, normal, friction):
    """Velocity after an inelastic contact with Coulomb friction; unchanged where it leaves a surface that does not stick."""
    result = velocity
    into = velocity.dot(normal)
    if friction >= STICKS:
        result = ti.Vector.zero(float, 3)
    elif into < 0.0:
        along = velocity - into * normal
        speed = along.norm()
        result = ti.Vector.zero(float, 3)
        if speed > -friction * into:
            result = along * (1.0 + friction * into / speed)
    return result


@ti.func
def trilinear(rows: ti.template(), position, column, inv_dx, by, bz):
    """What a column of the nodes says at a position."""
    at = position * inv_dx
    cell = ti.cast(ti.floor(at), ti.i32)
    part = at - cell
    terms = axis_terms(cell + MARGIN, by, bz)
    total = 0.0
    for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
        w = (part[0] if ti.static(i == 1) else 1.0 - part[0]) * (part[1] if ti.static(j == 1) else 1.0 - part[1])
        w *= part[2] if ti.static(k == 1) else 1.0 - part[2]
        total += w * rows[terms[0, i] + terms[1, j] + terms[2, k], column]
    return total


@ti.func
def pushed_out(wall: ti.template(), parts, position, velocity, inv_dx, by, bz, top):
    """Position and velocity of a particle that may not be inside an obstacle; one that leaves the domain 0..top stays out."""
    x, v = position, velocity
    for part in range(parts):
        first = part * WALL
        distance = 0.0
        if x.min() >= 0.0 and (top - x).min() >= 0.0:
            distance = trilinear(wall, x, first, inv_dx, by, bz)
        if distance < 0.0:
            normal = ti.Vector.zero(float, 3)
            for d in ti.static(range(3)):
                normal[d] = trilinear(wall, x, first + 1 + d, inv_dx, by, bz)
            size = normal.norm()
            if size > 1e-3:
                normal /= size
                v = slid(v, normal, trilinear(wall, x, first + 4, inv_dx, by, bz))
                x -= distance * normal
    return x, v


@ti.func
def nearest(wall: ti.template(), parts, position, inv_dx, by, bz):
    """Distance to the nearest part at a position."""
    least = 1e30
    for part in range(parts):
        least = ti.min(least, trilinear(wall, position, part * WALL, inv_dx, by, bz))
    return least


@ti.kernel
def move_nodes(
    grid: Array2,
    wall: Array2,
    rest: Array2,
    lists: Array2,
    heads: Array1,
    parts: int,
    resting: int,
    dt: float,
    gx: float,
    gy: float,
    gz: float,
):
    """Momentum to velocity, gravity, obstacles, resting matter."""
    for t in range(heads[N_TOUCHED] * CELLS):
        node = lists[t // CELLS, TOUCHED] * CELLS + t % CELLS
        mass = grid[node, 0]
        if mass > 0.0:
            v = read3(grid, node, 1) / mass + dt * ti.Vector([gx, gy, gz])
            for part in range(parts):
                first = part * WALL
                if wall[node, first] <= 0.0:
                    normal = ti.Vector([wall[node, first + 1], wall[node, first + 2], wall[node, first + 3]])
                    v = slid(v, normal, wall[node, first + 4])
            if resting == 1 and rest[node, 0] >= HELD:
                v = ti.Vector.zero(float, 3)
            write3(grid, node, 1, v)


@ti.kernel
def fall_asleep(
    state: Array2,
    tags: Array2,
    wall: Array2,
    rest: Array2,
    listed: Array1,
    count: int,
    parts: int,
    resting: int,
    slow: float,
    frames: int,
    dx: float,
    by: int,
    bz: int,
):
    """Count the frames during which a particle was slow and lay on something; after enough of them it rests."""
    for a in range(count):
        p = listed[a]
        if tags[p, STATE] == ACTIVE:
            x = read3(state, p, X)
            lies = 0
            if nearest(wall, parts, x, 1.0 / dx, by, bz) < dx:
                lies = 1
            if resting == 1 and trilinear(rest, x, 0, 1.0 / dx, by, bz) > FELT:
                lies = 1
            if lies == 1 and read3(state, p, V).norm() < slow:
                tags[p, QUIET] += 1
                if tags[p, QUIET] >= frames:
                    tags[p, STATE] = RESTING
            else:
                tags[p, QUIET] = 0


@ti.kernel
def deposit(state: Array2, rest: Array2, which: Array1, count: int, inv_dx: float, by: int, bz: int):
    """Add the volume of resting particles to the nodes, as a share of a cell; one thread, so that sums are repeatable."""
    ti.loop_config(serialize=True)
    for a in range(count):
        p = which[a]
        x = read3(state, p, X)
        base = base_node(x, inv_dx)
        offset = x * inv_dx - (base - MARGIN)
        terms = axis_terms(base, by, bz)
        share = state[p, VOLUME] * inv_dx * inv_dx * inv_dx
        for q in range(27):
            i, j, k = q // 9, (q // 3) % 3, q % 3
            w = share * bump(offset[0] - i) * bump(offset[1] - j) * bump(offset[2] - k)
            rest[terms[0, i] + terms[1, j] + terms[2, k], 0] += w


@ti.func
def bump(s):
    """Quadratic B-spline at a distance of s nodes."""
    r = ti.abs(s)
    value = 0.75 - r * r
    if r > 0.5:
        value = 0.5 * (1.5 - r) ** 2
    return value
