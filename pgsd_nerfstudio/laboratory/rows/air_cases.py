"""Figures of particles in the air: terminal speeds and rain against published values, the balance of wetness, and the costs of
flight, distance grid and wetness beside their errors."""

from __future__ import annotations

import math
import time

import numpy as np
import torch

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.effects.snowfall import fall_speed
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.surfaces import damaged_ball, floor_and_table
from pgsd_nerfstudio.laboratory.timing import best
from pgsd_nerfstudio.physics.air.airborne import Flutter, advance
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid, Wetting
from pgsd_nerfstudio.physics.laws.fall_speeds import (
    AIR_DENSITY,
    AIR_VISCOSITY,
    QUARTZ_DENSITY,
    STANDARD_GRAVITY,
    fog_fall_speed,
    rain_fall_speed,
    sand_fall_speed,
)
from pgsd_nerfstudio.physics.laws.size_distributions import (
    advection_fog,
    blown_sand,
    marshall_palmer,
    rain_rate,
    visibility,
    with_rain_rate,
)
from pgsd_nerfstudio.surface.distance import DistanceGrid

GUNN_KINZER_1949 = {0.5: 2.06, 1.0: 4.03, 2.0: 6.49, 3.0: 8.06, 4.0: 8.83, 5.0: 9.09}  # mm: m/s
_GUNN_KINZER = "Gunn & Kinzer 1949, table 2, as PySDM and CloudMicrophysics.jl reprint it; law: Beard 1976"
_DOMAIN = Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 2.0))


def cases(quick: bool) -> list[Record]:
    """Published values and laws with known answers; `quick` simulates fewer frames."""
    return [
        *(_rain(mm, speed) for mm, speed in GUNN_KINZER_1949.items()),
        _drizzle(),
        _fog(),
        *(_sand(micrometres) for micrometres in (63, 100, 200, 500, 1000)),
        *(_rain_rate(rate) for rate in (1.0, 5.0, 25.0)),
        _rescaled(),
        _visibility(),
        _balance(20 if quick else 200),
        _spread(),
    ]


def costs(quick: bool) -> list[Record]:
    """Costs beside errors; `quick` times fewer calls on a coarser grid."""
    return [*_flight(quick), *_distance(quick), *_wetting(quick)]


def _percent(found: float, truth: float) -> float:
    return 100 * abs(found / truth - 1)


def _one(speed, diameter: float) -> float:
    return float(speed(np.array([diameter]))[0])


def _rain(mm: float, truth: float) -> Record:
    found = _one(rain_fall_speed, 1e-3 * mm)
    source = f"{found:.4g} m/s; {_GUNN_KINZER}"
    return Record.judged(f"rain of {mm:g} mm against {truth:g} m/s", _percent(found, truth), "%", "<= 3", source=source)


def _drizzle() -> Record:
    worst = max(_percent(_one(rain_fall_speed, 1e-3 * mm), speed) for mm, speed in ((0.1, 0.27), (0.2, 0.72)))
    why = (
        "not judged: at 0.1 mm their table lies 9 % above a rigid sphere's speed (Schiller & Naumann), which Beard's law meets"
    )
    return Record("drizzle of 0.1 and 0.2 mm against Gunn & Kinzer, worse", worst, "%", source=why)


def _fog() -> Record:
    found = _one(fog_fall_speed, 20e-6)
    source = f"{found:.4g} m/s; Stokes: (rho_w - rho_a) g d^2 / (18 mu), 20 °C"
    return Record.judged("fog of 20 um against 0.012 m/s", _percent(found, 0.012), "%", "<= 1", source=source)


def _sand(micrometres: float) -> Record:
    diameter, viscosity = 1e-6 * micrometres, AIR_VISCOSITY / AIR_DENSITY
    grain = diameter * (STANDARD_GRAVITY * (QUARTZ_DENSITY / AIR_DENSITY - 1) / viscosity**2) ** (1 / 3)
    soulsby = viscosity / diameter * (math.sqrt(10.36**2 + 1.049 * grain**3) - 10.36)
    found = _one(sand_fall_speed, diameter)
    source = f"{found:.3g} m/s; Soulsby 1997, eq. 102, by grain number; no measurement of sand in air could be confirmed"
    name = f"sand of {micrometres:g} um against {soulsby:.3g} m/s"
    return Record.judged(name, _percent(found, soulsby), "%", "<= 12", source=source)


def _rain_rate(rate: float) -> Record:
    found = rain_rate(marshall_palmer(rate))
    source = f"{found:.4g} mm/h; Marshall & Palmer 1948 with Beard's speeds; their spectrum and rate are separate fits"
    return Record.judged(f"rain of {rate:g} mm/h, flux of Marshall-Palmer", _percent(found, rate), "%", "<= 20", source=source)


def _rescaled() -> Record:
    drops = with_rain_rate(marshall_palmer(5.0), 5.0)
    diameter = drops.sample(200_000, np.random.default_rng(0))
    found = 3.6e6 * drops.moment(0) * float(np.mean(np.pi / 6 * diameter**3 * rain_fall_speed(diameter)))
    return Record.judged(
        "rescaled rain of 5 mm/h, flux of 200,000 drawn drops", _percent(found, 5.0), "%", "<= 3", source="the rate asked for"
    )


def _visibility() -> Record:
    source = "2 pi N <r^2> of Shettle & Fenn's gamma model of 20 per cm^3 (parameters not confirmed): 27.9 per km, 140 m"
    found = _percent(visibility(advection_fog(), contrast=0.02), 140.2)
    return Record.judged("visibility in advection fog against 140 m", found, "%", "<= 1", source=source)


def _balance(frames: int) -> Record:
    grid = WetnessGrid.of(floor_and_table(), _DOMAIN, Wetting(diffusivity=2e-4, drying_seconds=60.0))
    rng, given = np.random.default_rng(0), 0.0
    for _ in range(frames):
        points = np.column_stack([rng.uniform(-1.9, 1.9, (500, 2)), np.zeros(500)])
        water = rng.uniform(0, 1e-6, 500)
        given += float(water.sum())
        grid.deposit(points, water)
        grid.step(0.5)
    error = abs(grid.held + grid.evaporated - given) / given
    return Record.judged("wetness: water lost or made", error, "of all", "<= 1e-6", source="deposited = held + evaporated")


def _spread() -> Record:
    cells = 33
    wetting = Wetting(diffusivity=2e-4, drying_seconds=math.inf)
    grid = WetnessGrid(np.ones([cells + 2 * wetting.reach] * 3, bool), np.zeros(3), wetting)
    grid.deposit(np.full((1, 3), 0.8), np.array([1.0]))
    grid.step(20.0)
    variance = grid.water @ (grid.centres - 0.8) ** 2 / grid.held
    error = float(np.abs(variance / (2 * wetting.diffusivity * 20.0) - 1).max())
    return Record.judged("wetness: variance of a spread drop", error, "relative", "<= 1e-6", source="2 D t along each axis")


def _flight(quick: bool) -> list[Record]:
    """Throughput of 100,000 particles in gusty wind for each law of terminal speed, and errors of 200 of them after 1 s."""
    count, wind, rng = 100_000, WindField.draw(Wind(), 7), np.random.default_rng(0)
    kinds = {
        "snow": fall_speed(rng.uniform(0.0015, 0.012, count)),
        "rain": rain_fall_speed(marshall_palmer(5.0, smallest=5e-4).sample(count, rng)),
        "sand": sand_fall_speed(blown_sand(1e-3).sample(count, rng)),
        "fog": fog_fall_speed(advection_fog().sample(count, rng)),
    }
    rows = []
    for name, speeds in kinds.items():
        position = rng.uniform([-3, -3, 1], [3, 3, 8], (count, 3)).astype(np.float32)
        speed, flutter = speeds.astype(np.float32), Flutter.none(count)
        velocity = np.zeros_like(position)
        velocity[:, 2] = -speed
        few = position[:200].copy(), velocity[:200].copy(), speed[:200].copy()
        seconds = best(
            lambda p=position, v=velocity, s=speed, f=flutter: advance(p, v, s, f, wind, 0.3, 0.04), 3 if quick else 20
        )
        rows.append(
            Record(
                f"airborne {name}, {count:,} particles",
                count / seconds / 1e6,
                "million particle-frames/s",
                1e3 * integration_error(wind, *few),
                "mm",
                source="error against steps of 1/64 of a frame in float64, mean of 200 particles after 1 s of gusty wind",
            )
        )
    return rows


def integration_error(wind: WindField, *start: np.ndarray) -> float:
    """Mean error in metres after 1 s of steps of a frame in float32, against steps of 1/64 of a frame in float64.

    Args:
        wind: the moving air.
        start: positions (m), velocities (m/s) and terminal speeds (m/s).
    """
    ends = []
    for parts, dtype in ((1, np.float32), (64, np.float64)):
        position, velocity, speed = (value.astype(dtype) for value in start)
        for k in range(25 * parts):
            advance(position, velocity, speed, Flutter.none(len(speed), dtype), wind, 0.04 * k / parts, 0.04 / parts)
        ends.append(position)
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).mean())


def _distance(quick: bool) -> list[Record]:
    """Distance grid of a ball of radius 0.5 m with 5 % of its triangles missing and 30 % flipped."""
    cell, center = 0.05 if quick else 0.025, np.array([0.03, -0.01, 0.7])
    mesh = damaged_ball(center, 0.5)
    mesh.closest(torch.zeros(1, 3))  # build the tree before the clock starts
    began = time.perf_counter()
    grid = DistanceGrid.of(mesh, np.array([-1.0, -1.0, -0.2]), np.array([1.0, 1.0, 1.6]), cell)
    seconds = time.perf_counter() - began
    at = grid.lower + cell * np.stack(np.meshgrid(*map(np.arange, grid.values.shape), indexing="ij"), -1)
    truth = np.linalg.norm(at - center, axis=-1) - 0.5
    error = float(np.abs(grid.values - truth.clip(-grid.band, grid.band)).mean())
    wrong = float((np.sign(grid.values) != np.sign(truth))[np.abs(truth) > cell].mean())
    size = f"{len(mesh.triangles):,} triangles of a ball, 5 % missing and 30 % flipped, {grid.asked:,} of its points asked"
    points = np.random.default_rng(0).uniform([-0.9, -0.9, -0.2], [0.9, 0.9, 1.6], (100_000, 3))
    sampling = best(lambda: grid.sample(points), 3)
    off = np.linalg.norm(points - center, axis=1) - 0.5
    in_band = np.abs(off) < grid.band - 2 * cell
    paid = float(np.median(np.abs(grid.sample(points)[0] - off)[in_band]))
    return [
        Record(f"distance grid of {grid.values.size:,} points", seconds, "s", 1e3 * error, "mm", source=size),
        Record.judged("distance grid: wrong sides beyond a cell", 100 * wrong, "%", "<= 0.1", source=size),
        Record("distance and gradient at a point", 1e9 * sampling / len(points), "ns", 1e3 * paid, "mm", source=size),
    ]


def _wetting(quick: bool) -> list[Record]:
    grid, rng = WetnessGrid.of(floor_and_table(), _DOMAIN), np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.9, 1.9, (400, 2)), np.zeros(400)])
    water = np.full(400, 1e-6)
    grid.deposit(points, water)
    grid.step(0.04)
    times = 3 if quick else 20
    depositing, stepping = best(lambda: grid.deposit(points, water), times), best(lambda: grid.step(0.04), times)
    error = abs(grid.held + grid.evaporated - grid.deposited) / grid.deposited
    size = f"{len(grid):,} cells of 5 cm around a yard of 16 m^2 with a table, {grid.bytes / len(grid):.0f} bytes a cell"
    return [
        Record("wetness for one frame, 400 drops", 1e3 * (depositing + stepping), "ms", error, "of the water", source=size),
        Record("wetness: memory", grid.bytes / 2**20, "MiB", source=size),
    ]
