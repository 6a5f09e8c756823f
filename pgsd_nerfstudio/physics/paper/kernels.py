"""Kernels of the paper's solver: MLS-MPM (Hu et al. 2018) on a dense grid of a unit cube.

The slow parts of the original are kept, since its cost is measured here: every substep clears and visits every node, particles,
also stationary ones, are scattered with atomics in the order of their birth, and F is decomposed with `ti.svd`. Snow follows
Stomakhin et al. (2013), sand Klar et al. (2016) with a volume correction; stress is Kirchhoff's.
"""

# Taichi compiles this code with other types than those that a type checker sees.
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportOptionalCall=false, reportGeneralTypeIssues=false

import taichi as ti

from pgsd_nerfstudio.physics.mpm.layout import Array1, Array2, C, F, V, X, read3, read33, write3, write33
from pgsd_nerfstudio.physics.mpm.transfer import spline

J = 24  # column after F; snow: plastic volume ratio, water: volume ratio, sand: logarithm of the volume gained
WIDTH = 25
NODE = 4  # columns of a node: mass, then momentum (after scattering) or velocity (after `move`)
SNOW, WATER, SAND = 0, 1, 2
HARDENING = 10.0  # xi in exp(xi (1 - Jp))
COMPRESSION, STRETCH = 1 - 2.5e-2, 1 + 4.5e-3  # bounds of principal stretches, beyond which snow yields
FRICTION_DEGREES = 45.0  # of sand


@ti.func
def lowest_node(x, inv_dx):
    """Lowest of the 3 x 3 x 3 nodes around a position; node (i, j, k) is at (i, j, k) * dx.

    Args:
        x: [3] position, boxes.
        inv_dx: 1 / dx, nodes per box.
    """
    return ti.cast(ti.floor(x * inv_dx - 0.5), ti.i32)


@ti.func
def row_of(node, cells):
    """Row of a node in the grid.

    Args:
        node: [3] indices of the node.
        cells: nodes per axis.
    """
    return (node[0] * cells + node[1]) * cells + node[2]


@ti.kernel
def clear(grid: Array2):
    """Empty every node."""
    for node in range(grid.shape[0]):
        for i in ti.static(range(NODE)):
            grid[node, i] = 0.0


@ti.kernel
def scatter_stationary(points: Array2, grid: Array2, count: int, mass: float, cells: int):
    """Add the mass of stationary particles to the grid; they have no momentum and are never deformed.

    Args:
        points: [s, 25] rows of the particles; columns 0-2 are positions in boxes.
        grid: [nodes, 4]; column 0 grows.
        count: number of particles.
        mass: of each, kg.
        cells: nodes per axis.
    """
    inv_dx = ti.cast(cells, float)
    for p in range(count):
        x = read3(points, p, X)
        base = lowest_node(x, inv_dx)
        weights = spline(x * inv_dx - base)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            w = weights[0, i] * weights[1, j] * weights[2, k]
            grid[row_of(base + ti.Vector([i, j, k]), cells), 0] += w * mass


@ti.func
def sand_projection(values, gained, slope, highest):
    """Project singular values onto the Drucker-Prager cone (Klar et al. 2016).

    Args:
        values: [3] singular values of F.
        gained: logarithm of the volume gained so far.
        slope: (3 lambda + 2 mu) / (2 mu) times the opening of the cone.
        highest: upper bound of the result's second part.

    Returns:
        Singular values on or inside the cone, and the new logarithm of the volume gained.
    """
    strain = ti.Vector.zero(float, 3)
    for i in ti.static(range(3)):
        strain[i] = ti.log(ti.max(ti.abs(values[i]), 1e-4))
    trace = strain.sum() + gained
    back = ti.Vector.one(float, 3)  # no stress where the sand is pulled apart
    left = ti.min(trace, highest)
    if trace < 0.0:
        left = 0.0
        deviator = strain - trace / 3.0
        size = deviator.norm() + 1e-20
        beyond = ti.max(size + slope * trace, 0.0)
        back = ti.exp(strain - deviator * (beyond / size))
    return back, left


@ti.kernel
def scatter(
    state: Array2,
    inside: Array1,
    grid: Array2,
    count: int,
    dt: float,
    cells: int,
    material: int,
    mu: float,
    lam: float,
    volume: float,
    mass: float,
    low: float,
    high: float,
    slope: float,
):
    """Deform particles by their velocity gradients, then add their mass, momentum and stress to the grid.

    Args:
        state: [n, 25] rows of the particles; F and the ratio J are changed in place.
        inside: [n] 1 for particles within the domain; others are skipped.
        grid: [nodes, 4]; mass and momentum grow.
        count: number of particles.
        dt: s.
        cells: nodes per axis.
        material: SNOW, WATER or SAND.
        mu: shear modulus, Pa.
        lam: first Lamé constant, Pa.
        volume: of a particle, boxes^3.
        mass: of a particle, kg.
        low: lower bound of the ratio J.
        high: upper bound of the ratio J.
        slope: see `sand_projection`.
    """
    inv_dx = ti.cast(cells, float)
    dx = 1.0 / inv_dx
    for p in range(count):
        if inside[p] == 1:
            gradient, ratio = read33(state, p, C), state[p, J]
            deformed = (ti.Matrix.identity(float, 3) + dt * gradient) @ read33(state, p, F)
            u, sigma, v = ti.svd(deformed)
            values = ti.Vector([sigma[0, 0], sigma[1, 1], sigma[2, 2]])
            stress = ti.Vector.zero(float, 3)  # principal, Pa
            if material == SAND:
                values, ratio = sand_projection(values, ratio, slope, high)
                logs = ti.log(values)
                stress = 2.0 * mu * logs + lam * logs.sum()
            elif material == SNOW:
                hardened = ti.exp(HARDENING * (1.0 - ratio))
                elastic = ti.min(ti.max(values, COMPRESSION), STRETCH)
                for i in ti.static(range(3)):
                    ratio *= values[i] / elastic[i]
                ratio = ti.min(ti.max(ratio, low), high)
                values = elastic
                whole = values[0] * values[1] * values[2]
                stress = hardened * (2.0 * mu * (values - 1.0) * values + lam * whole * (whole - 1.0))
            else:
                # Water has no shear stress, so F keeps the volume ratio in one entry.
                ratio = ti.min(ti.max(values[0] * values[1] * values[2], low), high)
                stress += lam * ratio * (ratio - 1.0)
            kept, tau = ti.Matrix.identity(float, 3), ti.Matrix.zero(float, 3, 3)
            if material == WATER:
                kept[0, 0] = ratio
                tau = stress[0] * ti.Matrix.identity(float, 3)
            else:
                left = u
                turned = u
                for i, j in ti.static(ti.ndrange(3, 3)):
                    left[i, j] *= values[j]
                    turned[i, j] *= stress[j]
                kept = left @ v.transpose()
                tau = turned @ u.transpose()
            write33(state, p, F, kept)
            state[p, J] = ratio
            affine = mass * gradient - (4.0 * dt * volume * inv_dx * inv_dx) * tau
            x = read3(state, p, X)
            base = lowest_node(x, inv_dx)
            offset = x * inv_dx - base
            weights = spline(offset)
            momentum = mass * read3(state, p, V) - affine @ (offset * dx)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                w = weights[0, i] * weights[1, j] * weights[2, k]
                node = row_of(base + ti.Vector([i, j, k]), cells)
                given = w * (momentum + affine @ (ti.Vector([i, j, k]) * dx))
                grid[node, 0] += w * mass
                for d in ti.static(range(3)):
                    grid[node, 1 + d] += given[d]


@ti.kernel
def move(grid: Array2, dt: float, gravity_x: float, gravity_y: float, gravity_z: float):
    """Turn momentum into velocity and add gravity at every node.

    Args:
        grid: [nodes, 4]; momentum becomes velocity.
        dt: s.
        gravity_x: boxes/s^2.
        gravity_y: boxes/s^2.
        gravity_z: boxes/s^2.
    """
    pull = dt * ti.Vector([gravity_x, gravity_y, gravity_z])
    for node in range(grid.shape[0]):
        if grid[node, 0] > 0.0:
            for d in ti.static(range(3)):
                grid[node, 1 + d] = grid[node, 1 + d] / grid[node, 0] + pull[d]


@ti.kernel
def gather(
    state: Array2,
    inside: Array1,
    signal: Array1,
    grid: Array2,
    bounds: Array2,
    count: int,
    dt: float,
    cells: int,
    material: int,
    stiffness: float,
    density: float,
):
    """Take velocities and their gradients from the grid, then move the particles.

    A particle that leaves the bounds stops at its first position outside and is marked.

    Args:
        state: [n, 25] rows of the particles, changed in place.
        inside: [n] becomes 0 for particles that leave.
        signal: [n] becomes the speed of sound plus the speed of the particle, boxes/s.
        grid: [nodes, 4] mass and velocity.
        bounds: [2, 3] lower and upper corner of the domain, boxes.
        count: number of particles.
        dt: s.
        cells: nodes per axis.
        material: SNOW, WATER or SAND.
        stiffness: lambda + 2 mu, Pa.
        density: kg/m^3.
    """
    inv_dx = ti.cast(cells, float)
    for p in range(count):
        if inside[p] == 1:
            x = read3(state, p, X)
            base = lowest_node(x, inv_dx)
            offset = x * inv_dx - base
            weights = spline(offset)
            velocity = ti.Vector.zero(float, 3)
            moment = ti.Matrix.zero(float, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                w = weights[0, i] * weights[1, j] * weights[2, k]
                v = w * read3(grid, row_of(base + ti.Vector([i, j, k]), cells), 1)
                velocity += v
                moment += v.outer_product(ti.Vector([i, j, k]) - offset)
            x += dt * velocity
            for d in ti.static(range(3)):
                # The test uses whole numbers, since NaN fails it then instead of passing it.
                cell = ti.cast(ti.floor(x[d] * inv_dx), ti.i32)
                if cell < 1 or cell > cells - 2 or x[d] < bounds[0, d] or x[d] > bounds[1, d]:
                    inside[p] = 0
            write3(state, p, X, x)
            write3(state, p, V, velocity)
            write33(state, p, C, moment * (4.0 * inv_dx))
            ratio, harder = state[p, J], ti.cast(1.0, float)
            if material == SNOW:
                harder = ti.exp(HARDENING * (1.0 - ratio))
            elif material == WATER:
                harder = ti.max(ratio * (2.0 * ratio - 1.0), 1.0)
            signal[p] = ti.sqrt(stiffness * harder / density) + velocity.norm()
