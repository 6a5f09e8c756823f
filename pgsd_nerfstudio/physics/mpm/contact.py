"""Contact with obstacles and with resting matter, on the nodes of the grid and for each particle by itself.

Nodes have Coulomb friction on the relative velocity and separate freely. A particle that still ends inside an obstacle is put
back onto the surface, so that no particle passes a plate, however fast.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    BLOCK,
    MARGIN,
    MASS,
    QUIET,
    RESTING,
    STATE,
    STICKS,
    VOLUME,
    WALL,
    Array1,
    Array2,
    Rows,
    Tags,
    V,
    X,
    axis_terms,
    base_node,
    block_of,
    read3,
)

HELD = 0.5  # resting share of a node's volume from which the node counts as solid
FELT = 0.05  # share from which a particle counts as touching resting matter


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
def cell_at(position, inv_dx, by, bz):
    """Place of a position in its cell of nodes, 0-1 on each axis, and the terms of the rows of the cell's corners."""
    at = position * inv_dx
    cell = ti.cast(ti.floor(at), ti.i32)
    return at - cell, axis_terms(cell + MARGIN, by, bz)


@ti.func
def corner(part, terms, q):
    """Trilinear weight and row of corner q of eight."""
    i, j, k = q // 4, (q // 2) % 2, q % 2
    w = ti.abs(1.0 - i - part[0]) * ti.abs(1.0 - j - part[1]) * ti.abs(1.0 - k - part[2])
    return w, terms[0, i] + terms[1, j] + terms[2, k]


@ti.func
def trilinear(rows: ti.template(), position, column, inv_dx, by, bz):
    """Value of a column of the nodes at a position."""
    part, terms = cell_at(position, inv_dx, by, bz)
    total = 0.0
    for q in range(8):
        w, node = corner(part, terms, q)
        total += w * rows[node, column]
    return total


@ti.func
def wall_at(wall: ti.template(), first, position, inv_dx, by, bz):
    """Distance, normal (of any length) and friction of a part of the obstacle, between nodes."""
    part, terms = cell_at(position, inv_dx, by, bz)
    told = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
    for q in range(8):
        w, node = corner(part, terms, q)
        for c in ti.static(range(5)):
            told[c] += w * wall[node, first + c]
    return told[0], ti.Vector([told[1], told[2], told[3]]), told[4]


@ti.func
def pushed_out(wall: ti.template(), parts, position, velocity, inv_dx, by, bz, top):
    """Position and velocity of a particle that may not be inside an obstacle; one that leaves the domain 0..top stays out."""
    x, v = position, velocity
    for part in range(parts):
        first = part * WALL
        if x.min() >= 0.0 and (top - x).min() >= 0.0:
            terms = axis_terms(ti.cast(ti.floor(x * inv_dx), ti.i32) + MARGIN, by, bz)
            if wall[terms[0, 0] + terms[1, 0] + terms[2, 0], first + 5] < 0.0:
                distance, normal, friction = wall_at(wall, first, x, inv_dx, by, bz)
                size = normal.norm()
                if distance < 0.0 and size > 1e-3:
                    v = slid(v, normal / size, friction)
                    x -= normal * (distance / size)
    return x, v


@ti.func
def nearest(wall: ti.template(), parts, position, inv_dx, by, bz):
    """Distance to the nearest part at a position."""
    least = 1e30
    for part in range(parts):
        least = ti.min(least, trilinear(wall, position, part * WALL, inv_dx, by, bz))
    return least


@ti.func
def moved(row, wall: ti.template(), rest: ti.template(), node, parts, resting, wake_speed, dt, gravity):
    """Velocity of a node from its [mass, momentum], after gravity, obstacles and resting matter; and whether that must wake."""
    mass, wakes = row[0], 0
    v = ti.Vector([row[1], row[2], row[3]]) / mass + dt * gravity
    for part in range(parts):
        first = part * WALL
        if wall[node, first] <= 0.0:
            normal = ti.Vector([wall[node, first + 1], wall[node, first + 2], wall[node, first + 3]])
            v = slid(v, normal, wall[node, first + 4])
    if resting == 1 and rest[node, 0] >= HELD:
        # The common speed of both if they stayed together. Waking matter takes part with its momentum and is not held.
        if mass * v.norm() > wake_speed * (mass + rest[node, 1]):
            wakes = 1
        else:
            v = ti.Vector.zero(float, 3)
    return v, wakes


@ti.kernel
def fall_asleep(
    state: Rows,
    tags: Tags,
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
    """Count the frames during which a particle was slow and touched a wall or resting matter; after enough of them it rests."""
    for a in range(count):
        p = listed[a]
        if tags[p][STATE] == ACTIVE:
            x = read3(state, p, X)
            touches = 0
            if nearest(wall, parts, x, 1.0 / dx, by, bz) < dx:
                touches = 1
            if resting == 1 and trilinear(rest, x, 0, 1.0 / dx, by, bz) > FELT:
                touches = 1
            if touches == 1 and read3(state, p, V).norm() < slow:
                tags[p][QUIET] += 1
                if tags[p][QUIET] >= frames:
                    tags[p][STATE] = RESTING
                    tags[p][BLOCK] = block_of(base_node(x, 1.0 / dx), by, bz)
            else:
                tags[p][QUIET] = 0


@ti.kernel
def deposit(state: Rows, rest: Array2, which: Array1, count: int, sign: float, inv_dx: float, by: int, bz: int):
    """Add the volume of particles to the nodes, as a share of a cell, and their mass; or take them away (sign -1).

    One thread, so that sums are repeatable.
    """
    ti.loop_config(serialize=True)
    for a in range(count):
        p = which[a]
        x = read3(state, p, X)
        base = base_node(x, inv_dx)
        offset = x * inv_dx - (base - MARGIN)
        terms = axis_terms(base, by, bz)
        share = state[p][VOLUME] * inv_dx * inv_dx * inv_dx
        for q in range(27):
            i, j, k = q // 9, (q // 3) % 3, q % 3
            w = sign * bump(offset[0] - i) * bump(offset[1] - j) * bump(offset[2] - k)
            node = terms[0, i] + terms[1, j] + terms[2, k]
            rest[node, 0] += w * share
            rest[node, 1] += w * state[p][MASS]


@ti.func
def bump(s):
    """Quadratic B-spline at a distance of s nodes."""
    r = ti.abs(s)
    value = 0.75 - r * r
    if r > 0.5:
        value = 0.5 * (1.5 - r) ** 2
    return value
