"""Figures of the room physics: laws of the simulated particles, and the cost of a particle per frame."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from pgsd_nerfstudio.effects import SNOWFALL
from pgsd_nerfstudio.effects.snowfall import fall_speed, mass
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import air_cases as rows_air_cases
from pgsd_nerfstudio.laboratory.rows import regimes as rows_regimes
from pgsd_nerfstudio.laboratory.surfaces import floor_and_table
from pgsd_nerfstudio.laboratory.timing import best
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, WindField, simulate_metric
from pgsd_nerfstudio.physics.air.airborne import Flutter, advance
from pgsd_nerfstudio.physics.bodies import GRAVITY
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-3.0, -3.0, -0.2), (3.0, 3.0, 4.0))


def verify(quick: bool) -> list[Record]:
    """Laws with known answers; `quick` takes fewer particles and leaves out dense matter."""
    run = simulate_metric(floor_and_table(), SNOWFALL, Clock(frames=100), DOMAIN, max_particles=2000, progress=False)
    ended = sum(run.about[kind] for kind in ("landed", "absorbed", "left", "unseen", "in_air"))
    return [
        Record.judged("free fall against analytic, float64", _fall_error(np.float64), "m", "<= 1e-9", source=_DRAG),
        Record.judged("free fall against analytic, float32", _fall_error(np.float32), "m", "<= 1e-5", source=_DRAG),
        Record.judged("two half steps against one, float64", _half_step_error(), "m", "<= 1e-12", source="the step is exact"),
        Record.judged(
            "wind in the kernel against its plain form", _wind_error(), "m/s", "<= 1e-6", source="WindField.velocity"
        ),
        Record.judged("divergence of the wind over its gradient", _divergence(), "", "<= 1e-6", source="u = curl A"),
        Record.judged("fall speed of flakes, worst of 2-10 mm", _fall_speed_error(), "%", "<= 0.1", source=_SPEED),
        Record.judged(
            "water through a plane against the asked-for rate", _water_error(quick), "%", "<= 3", source="mm/h asked for"
        ),
        Record.judged(
            "particles lost",
            abs(run.about["emitted"] - ended),
            "",
            "<= 0",
            source="emitted = landed + absorbed + left + unseen + in the air",
        ),
        Record.judged(
            "landed particles off the surface", _off_surface(run), "m", "<= 1e-4", source="height of the yard's planes"
        ),
        *rows_air_cases.cases(quick),
        *rows_regimes.cases(quick),
        *_dense(quick, "cases"),
    ]


def bench(quick: bool) -> list[Record]:
    """Costs beside errors; `quick` takes fewer frames and leaves out dense matter."""
    count = 20_000
    error = rows_air_cases.integration_error(_WIND, *_particles(200, np.float32))
    kernel = 1e9 * best(_kernel_step(count), 10 if quick else 50) / count
    frames = 50 if quick else 250
    simulate_metric(floor_and_table(), SNOWFALL, Clock(frames=3), DOMAIN, progress=False)
    began = time.perf_counter()
    run = simulate_metric(floor_and_table(), SNOWFALL, Clock(frames=frames), DOMAIN, progress=False)
    seconds = time.perf_counter() - began
    rows = run.positions.shape[0]
    against = "a step of 1/64 of a frame, mean over 200 flakes after 1 s of gusty wind"
    return [
        Record("flight of one particle for one frame", kernel, "ns", error, "m", source=f"error against {against}"),
        Record(
            f"motion prior of {frames} frames, per particle and frame", 1e9 * seconds / rows, "ns", error, "m", source=against
        ),
        Record(f"motion prior of {frames} frames, {len(run):,} particles", seconds, "s", source="flat yard with a table"),
        *rows_air_cases.costs(quick),
        *rows_regimes.costs(quick),
        *_dense(quick, "costs"),
    ]


def _dense(quick: bool, kind: Literal["cases", "costs"]) -> list[Record]:
    """Rows of the material point method. `quick` has none, since compiling its kernels takes longer than all other rows."""
    if quick:
        return []
    from pgsd_nerfstudio.laboratory.rows import mpm_cases as rows_mpm_cases  # starts Taichi
    from pgsd_nerfstudio.laboratory.rows import mpm_costs as rows_mpm_costs  # starts Taichi
    from pgsd_nerfstudio.laboratory.rows import paper as rows_paper  # starts Taichi

    return rows_mpm_cases.cases(False) if kind == "cases" else [*rows_mpm_costs.costs(False), *rows_paper.costs(False)]


_DRAG = "v = v_t + (v_0 - v_t) exp(-t g / v_t)"
_SPEED = "Locatelli & Hobbs 1974, aggregates of unrimed dendrites: 0.8 D^0.16"
_WIND = WindField.draw(SNOWFALL.wind, 7)


def _particles(count: int, dtype: type) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    position = rng.uniform([-3, -3, 1], [3, 3, 4], (count, 3)).astype(dtype)
    return position, rng.normal(size=(count, 3)).astype(dtype), rng.uniform(0.8, 1.2, count).astype(dtype)


def _fall_error(dtype: type) -> float:
    position, velocity, speed = _particles(200, dtype)
    x, v, s = (value.astype(np.float64) for value in (position, velocity, speed))
    for k in range(25):
        advance(position, velocity, speed, Flutter.none(200, dtype), _WIND.still(), 0.04 * k, 0.04)
    settled, tau = np.stack([0 * s, 0 * s, -s], 1), s[:, None] / GRAVITY
    return float(np.abs(position - (x + settled + (v - settled) * tau * (1 - np.exp(-1.0 / tau)))).max())


def _half_step_error() -> float:
    ends = []
    for parts in (1, 2):
        position, velocity, speed = _particles(200, np.float64)
        for k in range(parts):
            advance(position, velocity, speed, Flutter.none(200, np.float64), _WIND.still(), 0.08 * k / parts, 0.08 / parts)
        ends.append(position)
    return float(np.abs(ends[0] - ends[1]).max())


def _wind_error() -> float:
    position, _, _ = _particles(500, np.float64)
    velocity, at = np.zeros_like(position), position.copy()
    advance(position, velocity, np.full(500, 1e-9), Flutter.none(500, np.float64), _WIND, 0.98, 0.04)
    return float(np.abs(velocity - _WIND.velocity(at, 1.0)).max())


def _divergence() -> float:
    points, _, _ = _particles(500, np.float64)
    points[:200, 2] -= 0.9  # these points are in the air that the ground calms
    h = 1e-4
    slopes = np.stack([(_WIND.velocity(points + d, 1.0) - _WIND.velocity(points - d, 1.0)) / (2 * h) for d in h * np.eye(3)])
    return float(np.abs(np.einsum("ana->n", slopes)).max() / np.sqrt((slopes**2).sum((0, 2)).mean()))


def _fall_speed_error() -> float:
    diameter = np.linspace(0.002, 0.010, 9)
    speed = fall_speed(diameter)
    position = np.column_stack([0 * diameter, 0 * diameter, 50 + 0 * diameter])
    velocity = np.zeros_like(position)
    for k in range(50):
        advance(position, velocity, speed, Flutter.none(9, np.float64), _WIND.still(), 0.04 * k, 0.04)
    return float(100 * np.abs(-velocity[:, 2] / (0.8 * (1e3 * diameter) ** 0.16) - 1).max())


def _water_error(quick: bool) -> float:
    """Error in % of the water flux through a plane at 1.5 m: the larger one of still air and windy air."""
    clock, errors = Clock(frames=125), []
    for effect in (replace(SNOWFALL, wind=replace(SNOWFALL.wind, speed=0.0, turbulence=0.0)), SNOWFALL):
        most = 4000 if quick else 20_000
        run = simulate_metric(SurfaceMesh.empty(), effect, clock, DOMAIN, max_particles=most, progress=False)
        window = run.window(0, clock.frames)
        above = window.positions[:, :, 2] > 1.5
        both = window.active[:, 1:] & window.active[:, :-1]
        crossed = (((above[:, :-1] & ~above[:, 1:]).float() - (~above[:, :-1] & above[:, 1:]).float()) * both).sum(1)
        weight = torch.from_numpy(mass(run.diameters[window.ids].double().numpy())) * run.represents[window.ids]
        rate = 3600 * float((crossed * weight).sum()) / DOMAIN.area / ((clock.frames - 1) / clock.fps)
        errors.append(100 * abs(rate / effect.emission.intensity - 1))
    return max(errors)


def _off_surface(run: ParticleHistory) -> float:
    height = run.rest_positions[run.collided][:, 2] - run.rest_covers[run.collided] - SNOWFALL.surface.settle
    return float(torch.minimum(height.abs(), (height - 0.75).abs()).max())


def _kernel_step(count: int):
    position, velocity, speed = _particles(count, np.float32)
    flutter = Flutter(np.full(count, 0.1, np.float32), np.full(count, 1.5, np.float32), speed)
    return lambda: advance(position, velocity, speed, flutter, _WIND, 0.3, 0.04)
