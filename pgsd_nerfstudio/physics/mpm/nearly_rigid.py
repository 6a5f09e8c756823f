"""Functions of small stretches as power series, without eigenvectors.

Lying snow and flowing sand are strained by a few percent at most. Then root, logarithm and exponential of a symmetric matrix
are a handful of products of matrices, which costs a fifth of finding its principal axes; if only a bound of the principal
values matters, Gershgorin's discs answer. Strains beyond `SMALL` take the general way.

Symmetric matrices are vectors of six: xx, xy, xz, yy, yz, zz.
"""

import taichi as ti

SMALL = 0.06  # largest row sum of a matrix in a series of seven terms: the first that is left out is below 1e-10
TERMS = 7
DIAGONAL = (0, 3, 5)


@ti.func
def six(matrix):
    """A symmetric matrix as a vector."""
    return ti.Vector([matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2]])


@ti.func
def excess(f):
    """F F^T - 1: twice the strain in spatial axes."""
    return six(f @ f.transpose() - ti.Matrix.identity(float, 3))


@ti.func
def discs(a):
    """Bounds of the eigenvalues (Gershgorin)."""
    xy, xz, yz = ti.abs(a[1]), ti.abs(a[2]), ti.abs(a[4])
    low = ti.min(a[0] - xy - xz, a[3] - xy - yz, a[5] - xz - yz)
    return low, ti.max(a[0] + xy + xz, a[3] + xy + yz, a[5] + xz + yz)


@ti.func
def product(a, b):
    """Product of two matrices that commute."""
    return ti.Vector(
        [
            a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
            a[0] * b[1] + a[1] * b[3] + a[2] * b[4],
            a[0] * b[2] + a[1] * b[4] + a[2] * b[5],
            a[1] * b[1] + a[3] * b[3] + a[4] * b[4],
            a[1] * b[2] + a[3] * b[4] + a[4] * b[5],
            a[2] * b[2] + a[4] * b[4] + a[5] * b[5],
        ]
    )


@ti.func
def times_one_plus(a, b):
    """a (1 + b)."""
    return a + product(a, b)


@ti.func
def root(a):
    """sqrt(1 + a) - 1."""
    total = a * 0.0
    for m in range(TERMS):  # Horner's way: the quotients of neighbouring coefficients
        total = (1.5 / (TERMS - m) - 1.0) * times_one_plus(a, total)
    return total


@ti.func
def logarithm(a):
    """log(1 + a) / 2."""
    total = a * 0.0
    for m in range(TERMS - 1):
        total = (1.0 / (TERMS - m) - 1.0) * times_one_plus(a, total)
    return 0.5 * times_one_plus(a, total)


@ti.func
def exponential(a):
    """exp(a) - 1."""
    total = a * 0.0
    for m in range(TERMS):
        total = 1.0 / (TERMS - m) * times_one_plus(a, total)
    return total


@ti.func
def trace(a):
    return a[0] + a[3] + a[5]


@ti.func
def norm_sqr(a):
    """Sum of the squares of the nine entries."""
    return a[0] ** 2 + a[3] ** 2 + a[5] ** 2 + 2.0 * (a[1] ** 2 + a[2] ** 2 + a[4] ** 2)


@ti.func
def applied(a, f):
    """(1 + a) f."""
    full = ti.Matrix([[a[0], a[1], a[2]], [a[1], a[3], a[4]], [a[2], a[4], a[5]]])
    return f + full @ f
