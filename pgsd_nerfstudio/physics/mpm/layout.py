"""Layout in memory: one row per particle, one row per grid node, nodes in blocks of 4 x 4 x 4.

A particle's row is read and written as a whole, so it is one piece of memory. Positions are relative to the lower corner of
the domain, where single precision is finest. Node (i, j, k) lies at ((i, j, k) - MARGIN) * dx from that corner; its row
number is a sum of one term per axis (`axis_terms`), so that a stencil of 27 nodes needs 9 terms.

Rows whose width is known when a kernel is compiled are vectors to Taichi: only then does the compiler see that their numbers
lie side by side, and works on four at once.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

# Columns of a particle.
X, V = 0, 3  # position, velocity
C = 6  # affine velocity, 1/s (row by row)
F = 15  # elastic deformation gradient
TAU = 24  # Kirchhoff stress times volume, J: xx, xy, xz, yy, yz, zz
J = 30  # water: volume ratio; snow: plastic volume ratio; sand: volume correction
VOLUME, MASS = 31, 32
ENERGY = 33  # elastic, J
WIDTH = 34

# Columns of a particle's whole numbers.
MATERIAL, STATE, QUIET, BLOCK = 0, 1, 2, 3
TAGS = 4
ACTIVE, RESTING, REMOVED = 1, 2, 3

# Columns of a grid node: mass, then momentum (after `scatter`) or velocity (after `move_nodes`).
NODE = 4
REST = 2  # columns of a node for matter at rest: share of the node's volume, mass
WALL = 6  # columns of each part of an obstacle at a node: distance, outward normal, friction, least distance in the cell above
STICKS = 1e6  # friction from which matter cannot leave either
EDGE = 4  # nodes along a block
CELLS = EDGE**3
REACH = EDGE + 2  # nodes along what the particles of a block touch
HALO = REACH**3
MARGIN = 2  # nodes outside the domain on each side: the stencil of a particle at the very edge

# The numbers' precision is that of the tensors, whatever `float` says here.
Rows = ti.types.ndarray(dtype=ti.types.vector(WIDTH, float), ndim=1)
Nodes = ti.types.ndarray(dtype=ti.types.vector(NODE, float), ndim=1)
Tags = ti.types.ndarray(dtype=ti.types.vector(TAGS, int), ndim=1)
Array1 = ti.types.ndarray(ndim=1)
Array2 = ti.types.ndarray(ndim=2)


@ti.func
def read3(rows: ti.template(), p, column: ti.template()):
    """A vector from a particle's or node's row, whether rows are vectors or lines of an array."""
    value = ti.Vector.zero(float, 3)
    for i in ti.static(range(3)):
        if ti.static(len(rows.shape) == 1):
            value[i] = rows[p][column + i]
        else:
            value[i] = rows[p, column + i]
    return value


@ti.func
def write3(rows: ti.template(), p, column: ti.template(), value):
    for i in ti.static(range(3)):
        if ti.static(len(rows.shape) == 1):
            rows[p][column + i] = value[i]
        else:
            rows[p, column + i] = value[i]


@ti.func
def read33(rows: ti.template(), p, column: ti.template()):
    """A matrix from a particle's row."""
    value = ti.Matrix.zero(float, 3, 3)
    for i in ti.static(range(3)):
        row = read3(rows, p, column + 3 * i)
        for j in ti.static(range(3)):
            value[i, j] = row[j]
    return value


@ti.func
def write33(rows: ti.template(), p, column: ti.template(), value):
    for i in ti.static(range(3)):
        write3(rows, p, column + 3 * i, ti.Vector([value[i, 0], value[i, 1], value[i, 2]]))


@ti.func
def base_node(position, inv_dx):
    """Lowest of the 3 x 3 x 3 nodes around a position."""
    return ti.cast(ti.floor(position * inv_dx - 0.5), ti.i32) + MARGIN


@ti.func
def block_of(base, by, bz):
    return ((base[0] >> 2) * by + (base[1] >> 2)) * bz + (base[2] >> 2)


@ti.func
def block_at(block, by, bz):
    """Place of a block, counted in blocks."""
    return ti.Vector([block // (by * bz), (block // bz) % by, block % bz])


@ti.func
def axis_terms(base, by, bz):
    """Terms whose sum over the axes is the row of a node: terms[axis, offset]."""
    terms = ti.Matrix.zero(ti.i32, 3, 3)
    for o in ti.static(range(3)):
        i, j, k = base[0] + o, base[1] + o, base[2] + o
        terms[0, o] = (i >> 2) * by * bz * CELLS + (i & 3) * 16
        terms[1, o] = (j >> 2) * bz * CELLS + (j & 3) * 4
        terms[2, o] = (k >> 2) * CELLS + (k & 3)
    return terms
