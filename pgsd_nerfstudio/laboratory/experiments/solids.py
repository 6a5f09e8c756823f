"""Experiments with a known end, which judge the solver: conservation, elasticity, friction.

Each is a function of its resolution and returns what it measured beside what is known.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm.config import MpmConfig, Sleep
from pgsd_nerfstudio.physics.mpm.materials import Elastic, Sand, Snow, Water
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.runtime import Precision
from pgsd_nerfstudio.physics.mpm.solver import Mpm

G = 9.81
STICKY = math.inf


def lattice(lower: tuple[float, float, float], upper: tuple[float, float, float], spacing: float) -> tuple[Tensor, float]:
    """Points in the middles of cubes that fill a box, and the volume of each."""
    counts = [max(1, round((b - a) / spacing)) for a, b in zip(lower, upper, strict=True)]
    steps = [(b - a) / n for a, b, n in zip(lower, upper, counts, strict=True)]
    axes = [a + s * (torch.arange(n, dtype=torch.float64) + 0.5) for a, s, n in zip(lower, steps, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), math.prod(steps)


def ball(centre: tuple[float, float, float], radius: float, spacing: float) -> tuple[Tensor, float]:
    """Points of a lattice within a ball, and the volume of each."""
    x, y, z = centre
    low, high = (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)
    points, volume = lattice(low, high, spacing)
    return points[(points - points.new_tensor(centre)).norm(dim=1) <= radius], volume


def elastic_bar(cells: int = 20, precision: Precision = "f32") -> tuple[float, float]:
    """Frequency of a bar clamped at one end, in Hz: measured and (1 / 4 L) sqrt(E / rho), with a Poisson's ratio of 0."""
    length = 1.0
    dx = length / cells
    matter = Elastic(density=1000, youngs_modulus=1e5, poisson=0.0)
    clamp = Obstacle.plane((0, 0, 0), (1, 0, 0), STICKY)
    config = MpmConfig(dx=dx, gravity=(0, 0, 0), precision=precision)
    mpm = Mpm(config, Domain((-2 * dx, -4 * dx, -4 * dx), (length + 4 * dx, 4 * dx, 4 * dx)), clamp)
    points, volume = lattice((0, -dx, -dx), (length, dx, dx), dx / 2)
    velocity = torch.zeros_like(points)
    velocity[:, 0] = 0.05 * torch.sin(math.pi * points[:, 0] / (2 * length))
    mpm.emit(points, velocity, matter, volume)
    expected = math.sqrt(matter.youngs_modulus / matter.density) / (4 * length)
    step, times, shape = 0.01 / expected, [], velocity[:, 0] / 0.05
    amplitudes = []
    for k in range(260):
        amplitudes.append(float((mpm.velocities[:, 0].double() * shape).mean()))
        times.append(k * step)
        mpm.step(step)
    crossings = [times[k] + step * a / (a - b) for k, (a, b) in enumerate(pairwise(amplitudes)) if a > 0 >= b or a < 0 <= b]
    return 0.5 * (len(crossings) - 1) / (crossings[-1] - crossings[0]), expected


def hydrostatic_column(cells: int = 20, precision: Precision = "f32", poisson: float = 0.3) -> tuple[float, float]:
    """Settlement of the top of a confined elastic column under its weight, in m: mean over a period, and analytic."""
    height = 1.0
    dx = height / cells
    matter = Elastic(density=1000, youngs_modulus=1e6, poisson=poisson)
    _, _, mu, lam, *_ = matter.row()
    modulus = lam + 2 * mu
    well = Obstacle.room((-dx, -dx, 0), (dx, dx, 2 * height), 0.0)
    config = MpmConfig(dx=dx, precision=precision)
    mpm = Mpm(config, Domain((-2 * dx, -2 * dx, -2 * dx), (2 * dx, 2 * dx, 1.5 * height)), well)
    points, volume = lattice((-dx, -dx, 0), (dx, dx, height), dx / 2)
    mpm.emit(points, torch.zeros_like(points), matter, volume)
    period = 4 * height / math.sqrt(modulus / matter.density)
    sums = torch.zeros(len(points), dtype=torch.float64)
    steps = 100
    for _ in range(steps):
        mpm.step(period / steps)
        sums += mpm.positions[:, 2].double()
    settled = points[:, 2] - sums / steps
    y = points[:, 2]
    analytic = matter.density * G / modulus * (height * y - y * y / 2)
    top = y > height - 0.3 * dx
    return float(settled[top].mean()), float(analytic[top].mean())


def sliding_block(
    degrees: float = 30.0, friction: float = 0.3, cells: int = 4, precision: Precision = "f32"
) -> tuple[float, float]:
    """Acceleration of a block down an incline, in m/s^2: measured over 0.4 s after it settled, and g (sin - friction cos)."""
    edge = 0.2
    dx, angle = edge / cells, math.radians(degrees)
    along, normal = (math.cos(angle), 0.0, -math.sin(angle)), (math.sin(angle), 0.0, math.cos(angle))
    turn = torch.tensor([along, (0.0, 1.0, 0.0), normal], dtype=torch.float64)
    points, volume = lattice((-edge / 2, -edge / 2, 0), (edge / 2, edge / 2, edge), dx / 2)
    config = MpmConfig(dx=dx, precision=precision)
    mpm = Mpm(config, Domain((-0.4, -0.4, -1.2), (1.6, 0.4, 0.5)), Obstacle.plane((0, 0, 0), normal, friction))
    mpm.emit(points @ turn, torch.zeros_like(points), Elastic(density=1000, youngs_modulus=1e6), volume)
    mpm.step(0.1)
    before = float((mpm.velocities.double() @ turn[0]).mean())
    mpm.step(0.4)
    after = float((mpm.velocities.double() @ turn[0]).mean())
    return (after - before) / 0.4, G * (math.sin(angle) - friction * math.cos(angle))


def colliding_balls(precision: Precision = "f32", cells: int = 8) -> tuple[float, float, float]:
    """Two elastic balls that meet (Sulsky, Chen & Schreyer 1994, with balls in place of discs).

    Returns the share of the kinetic energy that is kinetic again afterwards, the largest change of momentum relative to that of
    one ball, and the largest total energy relative to that at the start.
    """
    radius, speed = 0.2, 0.1
    dx = radius / cells
    config = MpmConfig(dx=dx, gravity=(0, 0, 0), precision=precision)
    mpm = Mpm(config, Domain((0, 0, 0), (1.2, 1.2, 1.2)))
    for side in (-1.0, 1.0):
        at = 0.6 + side * 0.18
        points, volume = ball((at, at, at), radius, dx / 2)
        mpm.emit(points, torch.full_like(points, -side * speed), Elastic(density=1000, youngs_modulus=1e3, poisson=0.3), volume)
    start = mpm.report()
    one = start.mass / 2 * speed
    drift, most = 0.0, 0.0
    for _ in range(30):
        mpm.step(0.1)
        now = mpm.report()
        drift = max(drift, max(abs(a - b) for a, b in zip(now.momentum, start.momentum, strict=True)) / one)
        most = max(most, now.energy / start.energy)
    centre = mpm.velocities.double()[: len(mpm) // 2].mean(0)
    assert float(centre[0]) < 0, "the balls have not parted"
    return now.kinetic / start.kinetic, drift, most


def free_cloud(precision: Precision = "f32", steps: int = 20) -> tuple[float, float, float]:
    """A cloud of snow, sand, water and elastic matter without gravity: relative changes of momentum, angular momentum, mass."""
    mpm = Mpm(MpmConfig(dx=0.05, gravity=(0, 0, 0), precision=precision), Domain((-1, -1, -1), (1, 1, 1)))
    draw = torch.Generator().manual_seed(0)
    for material in (Snow(), Sand(), Water(), Elastic()):
        points = 0.5 * torch.rand(500, 3, generator=draw, dtype=torch.float64) - 0.25
        velocity = torch.randn(500, 3, generator=draw, dtype=torch.float64) + torch.linalg.cross(
            torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(500, 3), points
        )
        mpm.emit(points, velocity, material, 0.5**3 / 2000)
    before = mpm.report()
    for _ in range(steps):
        mpm.step(0.002)
    after = mpm.report()
    rows = mpm.velocities.double().norm(dim=1).mean() * before.mass
    linear = math.dist(before.momentum, after.momentum) / float(rows)
    angular = math.dist(before.angular_momentum, after.angular_momentum) / math.hypot(*before.angular_momentum)
    return linear, angular, abs(after.mass - before.mass) / before.mass + after.removed


def spinning_ball(precision: Precision = "f32", turns: float = 1.0) -> tuple[float, float]:
    """An elastic ball that turns freely: relative change of angular momentum, and of kinetic energy."""
    mpm = Mpm(MpmConfig(dx=0.05, gravity=(0, 0, 0), precision=precision), Domain((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)))
    points, volume = ball((0, 0, 0), 0.25, 0.025)
    spin = torch.tensor([0.0, 0.0, 2 * math.pi], dtype=torch.float64).expand_as(points)
    mpm.emit(points, torch.linalg.cross(spin, points), Elastic(youngs_modulus=1e5), volume)
    before = mpm.report()
    for _ in range(round(20 * turns)):
        mpm.step(0.05)
    after = mpm.report()
    change = math.dist(before.angular_momentum, after.angular_momentum) / math.hypot(*before.angular_momentum)
    return change, after.energy / before.energy - 1


def dense_snow(
    count: int,
    precision: Precision = "f32",
    *,
    threads: int = 0,
    side: float = 1.0,
    thrown: float = 0.0,
    sleep: Sleep | None = None,
) -> Mpm:
    """A cube of snow of `count` particles, eight to a cell of 2 cm, that lies on a floor and leans against nothing.

    Args:
        side: half the width of the domain around it, in m.
        thrown: speed in m/s with which it slides and presses down; what is thrown breaks and flows.
    """
    dx = 0.02
    edge = (count / 8) ** (1 / 3) * dx
    config = MpmConfig(dx=dx, precision=precision, threads=threads, sleep=sleep)
    mpm = Mpm(config, Domain((-side, -side, 0), (side, side, 1.5)), Obstacle.plane((0, 0, 0.1), (0, 0, 1)))
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=draw, dtype=torch.float64) * edge + torch.tensor([-edge / 2, -edge / 2, 0.1])
    mpm.emit(points, thrown * torch.tensor([1.0, 0.0, -1.0]).expand(count, 3), Snow(), edge**3 / count)
    return mpm


def snow_layer(sleep: Sleep | None, edge: float = 1.0) -> Mpm:
    """A square of loose snow, 20 cm high and `edge` metres long, between walls; it has had 0.6 s to come to rest."""
    dx = 0.05
    room = Obstacle.room((0, 0, 0), (edge, edge, 2), 0.5)
    mpm = Mpm(MpmConfig(dx=dx, sleep=sleep), Domain((-dx, -dx, -dx), (edge + dx, edge + dx, 1)), room)
    points, volume = lattice((0, 0, 0), (edge, edge, 0.2), dx / 2)
    mpm.emit(points, torch.zeros_like(points), Snow(density=200), volume)
    for _ in range(15):
        mpm.step(0.04)
    return mpm


def throw_snowball(mpm: Mpm, speed: float = 5.0) -> None:
    """A ball of denser snow just above the middle of a `snow_layer`, falling at `speed` m/s."""
    x, y, _ = ((a + b) / 2 for a, b in zip(mpm.domain.lower, mpm.domain.upper, strict=True))
    top = float(mpm.positions[:, 2].max())
    points, volume = ball((x, y, top + 0.14), 0.12, mpm.config.dx / 2)
    mpm.emit(points, torch.tensor([0.0, 0.0, -speed]).expand(len(points), 3), Snow(density=400), volume)
