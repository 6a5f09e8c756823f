"""Experiments with sand: columns that collapse (Lube et al. 2004) and heaps that were piled too steeply."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pgsd_nerfstudio.laboratory.experiments.solids import STICKY, G, lattice
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm.config import MpmConfig
from pgsd_nerfstudio.physics.mpm.materials import Sand
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.runtime import Precision
from pgsd_nerfstudio.physics.mpm.solver import Mpm


def sand_column(
    aspect: float,
    cells: int = 8,
    *,
    precision: Precision = "f32",
    friction: float = 0.577,
    young: float = 1e5,
    degrees: float = 30.0,
    calm: bool = True,
) -> tuple[Mpm, float]:
    """A quarter of a cylinder of sand that has collapsed on a floor, and its first radius: 0.1 m, aspect x 0.1 m high.

    `calm`: start with the stresses of sand that lies, not without stress.
    """
    radius = 0.1
    dx, height = radius / cells, aspect * 0.1
    reach = (1 + 1.24 * aspect + 1.0) * radius
    config = MpmConfig(dx=dx, precision=precision)
    domain = Domain((-2 * dx, -2 * dx, -2 * dx), (reach, reach, height + 4 * dx))
    floor = Obstacle.plane((0, 0, 0), (0, 0, 1), friction)
    mirrors = Obstacle.plane((0, 0, 0), (1, 0, 0), 0.0) | Obstacle.plane((0, 0, 0), (0, 1, 0), 0.0)
    mpm = Mpm(config, domain, mirrors | floor)
    points, volume = lattice((0, 0, 0), (radius, radius, height), dx / 2)
    points = points[points[:, :2].norm(dim=1) <= radius]
    volume *= math.pi / 4 * radius**2 * height / (volume * len(points))
    sand = Sand(youngs_modulus=young, friction_degrees=degrees)
    mpm.emit(points, torch.zeros_like(points), sand, volume, packed(points, sand, height) if calm else None)
    for _ in range(40):
        mpm.step(6 * math.sqrt(height / G) / 40)
    return mpm, radius


def packed(points: Tensor, sand: Sand, height: float) -> Tensor:
    """Deformation gradients of sand that lies under its own weight and has not spread sideways."""
    _, _, mu, lam, *_ = sand.row()
    f = torch.eye(3, dtype=torch.float64).repeat(len(points), 1, 1)
    f[:, 2, 2] = torch.exp(-sand.density * G * (height - points[:, 2]) / (lam + 2 * mu))
    return f


def profile(mpm: Mpm, width: float) -> tuple[Tensor, Tensor]:
    """Radii in m of rings of a `width`, and the height of the deposit there, from the volume in each ring."""
    r = mpm.positions[:, :2].double().norm(dim=1)
    volume = mpm.report().mass / Sand().density / len(mpm)
    count = torch.bincount((r / width).long())
    inner = width * torch.arange(len(count), dtype=torch.float64)
    return inner + width / 2, count * volume / (math.pi / 4 * ((inner + width) ** 2 - inner**2))


def heap_slope(degrees: float = 30.0, cells: int = 8, start_degrees: float = 40.0, precision: Precision = "f32") -> float:
    """Slope in degrees of a cone of sand that was piled too steeply and has come to rest on a rough floor."""
    radius = 0.2
    dx, height = radius / cells, 0.2 * math.tan(math.radians(start_degrees))
    floor = Obstacle.plane((0, 0, 0), (0, 0, 1), STICKY)
    mirrors = Obstacle.plane((0, 0, 0), (1, 0, 0), 0.0) | Obstacle.plane((0, 0, 0), (0, 1, 0), 0.0)
    config = MpmConfig(dx=dx, precision=precision)
    mpm = Mpm(config, Domain((-2 * dx, -2 * dx, -2 * dx), (2 * radius, 2 * radius, height + 4 * dx)), mirrors | floor)
    points, volume = lattice((0, 0, 0), (radius, radius, height), dx / 2)
    points = points[points[:, :2].norm(dim=1) / radius + points[:, 2] / height <= 1]
    mpm.emit(points, torch.zeros_like(points), Sand(friction_degrees=degrees, youngs_modulus=1e5), volume)
    for _ in range(40):
        mpm.step(0.02)
    r, h = profile(mpm, dx)
    flank = (h > 0.2 * float(h[:3].mean())) & (h < 0.7 * float(h[:3].mean()))
    a = torch.stack([r[flank], torch.ones_like(r[flank])], 1)
    slope = torch.linalg.lstsq(a, h[flank, None]).solution[0, 0]
    return math.degrees(math.atan(-float(slope)))


def run_out(aspect: float, cells: int) -> tuple[float, float]:
    """Run-out of a column of sand over its radius, measured and as Lube et al. (2004) found it.

    The deposit ends where it is one particle thin: 0.1 % of the sand lies beyond.
    """
    mpm, radius = sand_column(aspect, cells)
    far = float(mpm.positions[:, :2].double().norm(dim=1).quantile(0.999))
    return far / radius - 1, 1.24 * aspect if aspect < 1.7 else 1.6 * math.sqrt(aspect)
