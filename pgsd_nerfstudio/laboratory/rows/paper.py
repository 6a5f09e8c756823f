"""Figures of the paper's solver: the cost of a particle when every substep visits all nodes and all scene Gaussians."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.yard import HALF, TOP, yard
from pgsd_nerfstudio.physics import Domain
from pgsd_nerfstudio.physics.paper import Box, PaperConfig, PaperSolver, paper_config

Stationary = Literal["mass", "particles"]
DYNAMIC = 20_000
DOMAIN = Domain((-HALF, -HALF, -0.2), (HALF, HALF, TOP))


def costs(quick: bool) -> list[Record]:
    """CPU time over all threads, with static Gaussians, beside the error of single precision; `quick` takes fewer tries."""
    error, rows = _single_precision_error(500 if quick else 2000), []
    cases: list[tuple[int, Stationary]] = [(0, "mass"), (20_000, "mass"), (100_000, "mass"), (100_000, "particles")]
    for static, stationary in cases:
        tries = 2 if quick else 5
        per_frame = min(baseline_cpu_seconds(DYNAMIC, static, 1, stationary=stationary) for _ in range(tries))
        substeps = _solver(paper_config("snowfall"), DYNAMIC, static).step()
        as_what = " (as whole particles)" if stationary == "particles" else ""
        what = f"paper's solver, {DYNAMIC:,} snow, {static:,} static{as_what}"
        about = {"error": error, "error_unit": "boxes", "source": _SOURCE}
        rows += [
            Record(f"{what}: per dynamic particle and substep", 1e6 * per_frame / DYNAMIC / substeps, "us CPU", **about),
            Record(f"{what}: per dynamic particle and frame of 4 ms", 1e6 * per_frame / DYNAMIC, "us CPU", **about),
        ]
    return rows


def baseline_cpu_seconds(dynamic: int, static: int, frames: int, *, stationary: Stationary = "mass") -> float:
    """CPU seconds of the paper's solver over all threads, without compilation.

    Args:
        dynamic: number of snow particles in the air of a walled yard, with the published numbers and initial velocities.
        static: number of Gaussians of its floor and walls.
        frames: number of frames of 4 ms.
        stationary: how static Gaussians are put onto the grid, see `PaperConfig.stationary`; "mass" is cheaper.
    """
    config = replace(paper_config("snowfall"), stationary=stationary)
    _solver(config, 1, static).step()  # compiles
    solver = _solver(config, dynamic, static)
    began = time.process_time()
    for _ in range(frames):
        solver.step()
    return time.process_time() - began


_SOURCE = (
    "13 substeps a frame, the least of several; statics only add mass, or are whole particles as in the original; error: f32 "
    "against f64 after 10 frames, mean"
)


def _solver(config: PaperConfig, dynamic: int, static: int) -> PaperSolver:
    """A solver with `dynamic` particles in the air of a yard of `static` Gaussians."""
    box = Box.of(DOMAIN)
    means: Float[ndarray, "s 3"] = yard(static).means.numpy().astype(np.float64) if static else np.zeros((0, 3))
    solver = PaperSolver(config, box, box.to_box(means))
    rng = np.random.default_rng(0)
    slowest, fastest = np.array(config.velocity).T
    # Particles start a little above the ground, so that none leaves within the measured frames.
    low = box.bounds[0] + np.array([0.02, 0.02, 0.1])
    solver.emit(rng.uniform(low, box.bounds[1] - 0.02, (dynamic, 3)), rng.uniform(slowest, fastest, (dynamic, 3)))
    return solver


def _single_precision_error(count: int) -> float:
    """Mean distance in boxes between single and double precision after 10 frames."""
    ends = []
    for precision in ("f64", "f32"):  # single precision last, since later rows run in it
        solver = _solver(replace(paper_config("snowfall"), precision=precision), count, 0)
        for _ in range(10):
            solver.step()
        ends.append(solver.positions)
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).mean())
