"""How matter answers a deformation: stress, plastic flow, stored energy and stiffness of every particle.

The singular values of F come from Jacobi rotations of F^T F, which is ten times faster here than Taichi's own SVD. The stress
is Kirchhoff's (tau = P F^T), diagonal in the left singular vectors.
"""

# What Taichi compiles is not what Python would run, which is all that a type checker can see.
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

from pgsd_nerfstudio.physics.mpm import nearly_rigid as nr
from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    ENERGY,
    MATERIAL,
    STATE,
    TAU,
    VOLUME,
    Array1,
    Array2,
    C,
    F,
    J,
    Rows,
    Tags,
    V,
    read3,
    read33,
    write33,
)
from pgsd_nerfstudio.physics.mpm.materials import (
    COMPRESSION,
    DENSITY,
    FRICTION,
    HARDENING,
    HIGH,
    KIND,
    LAMBDA,
    LOW,
    MU,
    SAND,
    SNOW,
    STRETCH,
    WATER,
)

GAMMA = 7.0  # exponent of Tait's equation


@ti.func
def eigenvectors(matrix):
    """Eigenvectors of a symmetric 3 x 3 matrix, as columns; cyclic Jacobi, which doubles its digits with every sweep."""
    a = matrix
    vectors = ti.Matrix.identity(float, 3)
    enough = 1e-14 * a.trace() ** 2
    for _ in range(6):
        if a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2 > enough:
            for p, q, r in ti.static(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
                # What is smaller than this no longer counts, and its square would vanish in single precision.
                if ti.abs(a[p, q]) > 1e-9 * ti.sqrt(enough):
                    # Tangent of the smaller angle that makes a[p, q] vanish.
                    half = 0.5 * (a[q, q] - a[p, p])
                    t = a[p, q] / (ti.abs(half) + ti.sqrt(half * half + a[p, q] * a[p, q]))
                    if half < 0:
                        t = -t
                    c = 1.0 / ti.sqrt(t * t + 1.0)
                    s = t * c
                    a[p, p] -= t * a[p, q]
                    a[q, q] += t * a[p, q]
                    a[p, q] = 0.0
                    a[q, p] = 0.0
                    rp, rq = a[r, p], a[r, q]
                    a[r, p] = c * rp - s * rq
                    a[r, q] = s * rp + c * rq
                    a[p, r] = a[r, p]
                    a[q, r] = a[r, q]
                    for k in ti.static(range(3)):
                        kp, kq = vectors[k, p], vectors[k, q]
                        vectors[k, p] = c * kp - s * kq
                        vectors[k, q] = s * kp + c * kq
    return vectors


@ti.func
def singular_values(f):
    """U, the three values and V with F = U diag(values) V^T; of a mirrored F the smallest value is negative (Irving 2004)."""
    v = eigenvectors(f.transpose() @ f)
    u = f @ v
    values = ti.Vector.zero(float, 3)
    for i in ti.static(range(3)):
        values[i] = ti.max(ti.sqrt(u[0, i] ** 2 + u[1, i] ** 2 + u[2, i] ** 2), 1e-6)
    if f.determinant() < 0:
        least = values.min()
        for i in ti.static(range(3)):
            if values[i] == least:
                values[i] = -least
                least = -1.0  # only one
    for i, j in ti.static(ti.ndrange(3, 3)):
        u[i, j] /= values[j]
    return u, values, v


@ti.func
def assembled(u, values, v):
    """U diag(values) V^T."""
    scaled = u
    for i, j in ti.static(ti.ndrange(3, 3)):
        scaled[i, j] *= values[j]
    return scaled @ v.transpose()


@ti.func
def stiffening(stretch):
    """Growth of the tangent modulus of s (s - 1) per logarithmic strain, at least 1."""
    s = ti.max(stretch, 1.0)
    return s * (2.0 * s - 1.0)


@ti.func
def corotated(values, mu, lam):
    """Principal Kirchhoff stress, energy density and tangent stiffness, in Pa."""
    volume = values[0] * values[1] * values[2]
    stress = 2.0 * mu * (values - 1.0) * values + lam * (volume - 1.0) * volume
    energy = mu * (values - 1.0).norm_sqr() + 0.5 * lam * (volume - 1.0) ** 2
    stiffness = 2.0 * mu * stiffening(values.max()) + 3.0 * lam * stiffening(volume)
    return stress, energy, stiffness


@ti.func
def water_answer(ratio, bulk):
    """Kirchhoff stress (isotropic), energy density and tangent stiffness at a volume ratio, in Pa."""
    stress, energy, stiffness = 0.0, 0.0, 3.0 * bulk
    if ratio < 1.0:
        power = ratio ** (1.0 - GAMMA)
        stress = bulk / GAMMA * (ratio - power)
        energy = bulk / GAMMA * ((power - 1.0) / (GAMMA - 1.0) + ratio - 1.0)
        stiffness = 3.0 * bulk / GAMMA * ((GAMMA - 1.0) * power + ratio)
    return stress, energy, stiffness


@ti.func
def beyond_cone(trace, size, mu, lam, friction):
    """By how much a deviatoric Hencky strain of norm `size` exceeds what the Drucker-Prager cone allows."""
    return size + (3.0 * lam + 2.0 * mu) / (2.0 * mu) * trace * friction


@ti.func
def sand_return(strain, correction, mu, lam, friction, most):
    """Principal Hencky strains brought back onto the Drucker-Prager cone, and the volume correction that is left."""
    shifted = strain + correction / 3.0
    trace = shifted.sum()
    left = 0.0
    back = ti.Vector.zero(float, 3)
    if trace >= 0.0:  # pulled apart: no stress, and the gained volume is owed
        left = ti.min(trace, most)
    else:
        deviator = shifted - trace / 3.0
        size = deviator.norm()
        beyond = beyond_cone(trace, size, mu, lam, friction)
        back = shifted
        if beyond > 0.0:
            back = shifted - deviator * (beyond / size)
    return back, left


@ti.func
def sand_nearly_rigid(extra, f, correction, mu, lam, friction, most):
    """`sand_return` without principal axes: stress, energy density, F and the volume correction that is left."""
    strain = nr.logarithm(extra)
    change = -strain
    trace = nr.trace(strain) + correction
    left = 0.0
    stress, energy = change * 0.0, 0.0
    if trace >= 0.0:
        left = ti.min(trace, most)
    else:
        change *= 0.0
        for d in ti.static(nr.DIAGONAL):
            change[d] = correction / 3.0
        deviator = strain
        for d in ti.static(nr.DIAGONAL):
            deviator[d] -= nr.trace(strain) / 3.0
        size = ti.sqrt(nr.norm_sqr(deviator))
        beyond = beyond_cone(trace, size, mu, lam, friction)
        if beyond > 0.0:
            change -= deviator * (beyond / size)
        strain += change
        stress = 2.0 * mu * strain
        for d in ti.static(nr.DIAGONAL):
            stress[d] += lam * trace
        energy = mu * nr.norm_sqr(strain) + 0.5 * lam * trace**2
    return stress, energy, nr.applied(nr.exponential(change), f), left


@ti.func
def corotated_nearly_rigid(extra, high, volume, mu, lam):
    """`corotated` without principal axes, of matter that does not yield: stress, energy density and tangent stiffness."""
    strain = nr.root(extra)
    stress = 2.0 * mu * (extra - strain)
    for d in ti.static(nr.DIAGONAL):
        stress[d] += lam * (volume - 1.0) * volume
    energy = mu * nr.norm_sqr(strain) + 0.5 * lam * (volume - 1.0) ** 2
    return stress, energy, 2.0 * mu * stiffening(ti.sqrt(1.0 + high)) + 3.0 * lam * stiffening(volume)


@ti.func
def is_nearly_rigid(table: ti.template(), m, kind, extra, f, ratio):
    """Whether the series hold, and snow certainly does not yield."""
    low, high = nr.discs(extra)
    least, most = -nr.SMALL, nr.SMALL
    if kind == SNOW:
        least = ti.max(least, table[m, COMPRESSION] ** 2 - 1.0)
        most = ti.min(most, table[m, STRETCH] ** 2 - 1.0)
    elif kind == SAND and ratio > 3.0 * nr.SMALL:
        most = -1.0
    return f.determinant() > 0.0 and low >= least and high <= most


@ti.func
def answer_nearly_rigid(table: ti.template(), m, kind, extra, f_, ratio_):
    """Stress (six numbers), energy density, tangent stiffness, and F and ratio that are left; without principal axes."""
    mu, lam, f, ratio = table[m, MU], table[m, LAMBDA], f_, ratio_
    tau, energy, stiffness = extra * 0.0, 0.0, 2.0 * mu + 3.0 * lam
    if kind == SAND:
        a, b, c, d = sand_nearly_rigid(extra, f, ratio, mu, lam, table[m, FRICTION], table[m, HIGH])
        tau, energy, f, ratio = a, b, c, d
    else:
        harder = 1.0
        if kind == SNOW:
            harder = ti.exp(table[m, HARDENING] * (1.0 - ratio))
        _, high = nr.discs(extra)
        a, b, c = corotated_nearly_rigid(extra, high, f.determinant(), harder * mu, harder * lam)
        tau, energy, stiffness = a, b, c
    return tau, energy, stiffness, f, ratio


@ti.func
def answer_in_general(table: ti.template(), m, kind, f_, ratio_):
    """The same of any deformation, by its principal axes."""
    mu, lam, f, ratio = table[m, MU], table[m, LAMBDA], f_, ratio_
    u, values, v = singular_values(f)
    stress, energy, stiffness = ti.Vector.zero(float, 3), 0.0, 2.0 * mu + 3.0 * lam
    if kind == SAND:
        strain = ti.log(ti.max(ti.abs(values), 1e-4))
        strain, ratio = sand_return(strain, ratio, mu, lam, table[m, FRICTION], table[m, HIGH])
        f = assembled(u, ti.exp(strain), v)
        stress = 2.0 * mu * strain + lam * strain.sum()
        energy = mu * strain.norm_sqr() + 0.5 * lam * strain.sum() ** 2
    else:
        harder = 1.0
        if kind == SNOW:
            kept = ti.min(ti.max(values, table[m, COMPRESSION]), table[m, STRETCH])
            flow = ti.abs(values[0] * values[1] * values[2]) / (kept[0] * kept[1] * kept[2])
            ratio = ti.min(ti.max(ratio * flow, table[m, LOW]), table[m, HIGH])
            harder = ti.exp(table[m, HARDENING] * (1.0 - ratio))
            values = kept
            f = assembled(u, values, v)
        a, b, c = corotated(values, harder * mu, harder * lam)
        stress, energy, stiffness = a, b, c
    tau = assembled(u, stress, u)
    return nr.six(tau), energy, stiffness, f, ratio


@ti.func
def deform(state: ti.template(), signal: ti.template(), table: ti.template(), p, m, gradient, dt):
    """Deform a particle of material m by a velocity gradient; writes F, J, stress, energy and the speed of signals in m/s."""
    kind = ti.cast(table[m, KIND], ti.i32)
    volume, ratio = state[p][VOLUME], state[p][J]
    stiffness, energy = 0.0, 0.0
    tau = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    if kind == WATER:
        ratio = ti.min(ti.max(ratio * ti.exp(dt * gradient.trace()), table[m, LOW]), table[m, HIGH])
        pressure, a, b = water_answer(ratio, table[m, LAMBDA])
        energy, stiffness = a, b
        for d in ti.static(nr.DIAGONAL):
            tau[d] = pressure
    else:
        f = read33(state, p, F)
        f += dt * gradient @ f
        extra = nr.excess(f)
        if is_nearly_rigid(table, m, kind, extra, f, ratio):
            a, b, c, d, e = answer_nearly_rigid(table, m, kind, extra, f, ratio)
            tau, energy, stiffness, f, ratio = a, b, c, d, e
        else:
            a, b, c, d, e = answer_in_general(table, m, kind, f, ratio)
            tau, energy, stiffness, f, ratio = a, b, c, d, e
        write33(state, p, F, f)
    for k in ti.static(range(6)):
        state[p][TAU + k] = tau[k] * volume
    state[p][J] = ratio
    state[p][ENERGY] = energy * volume
    signal[p] = ti.sqrt(stiffness / table[m, DENSITY]) + read3(state, p, V).norm()


@ti.kernel
def respond(state: Rows, tags: Tags, signal: Array1, table: Array2, which: Array1, count: int, dt: float):
    """Stress, energy and signals of particles after they were deformed for dt seconds."""
    for a in range(count):
        p = which[a]
        if tags[p][STATE] == ACTIVE:
            deform(state, signal, table, p, tags[p][MATERIAL], read33(state, p, C), dt)
        else:
            signal[p] = 0.0
