"""The motion prior of the paper: MPM throughout, in a unit cube around the scene.

    run = simulate_paper(surface, gaussians_in_metres, paper_config("snowfall"), domain)

500 frames of 4 ms are 2 s of simulation. They are shown at 25 fps, so the history lasts 20 s and shows the motion ten times
slower. The artefacts of the published numbers are kept. A single emission falls freely as a whole, but its particles soon move
as one, since they share cells. In steady snow, new flakes slow down earlier ones to 0.7-0.8 of the speed of free fall; floating
Gaussians slow them down further. A particle that moves less than 0.25 boxes/s is taken to have collided, in mid-air too
(`about["hanging"]`): each flake has the volume of a cell, so flakes pile up before they reach the ground.
"""

from __future__ import annotations

import time
from dataclasses import fields

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from rich.console import Console
from rich.progress import track

from pgsd_nerfstudio.physics.bodies import ANY_DISTANCE, NO_END, Bodies
from pgsd_nerfstudio.physics.clock import Clock, Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.paper.config import PaperConfig
from pgsd_nerfstudio.physics.paper.run_record import RunRecord
from pgsd_nerfstudio.physics.paper.solver import Box, PaperSolver
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SIXTH = 1 / 6  # share of the domain in which particles start: 0.80-0.95 of a cube that spans 0.05-0.95


def simulate_paper(
    surface: SurfaceMesh,
    static_points: Float[ndarray, "s 3"],
    config: PaperConfig,
    domain: Domain,
    *,
    frames: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> ParticleHistory:
    """Simulate an effect with the published numbers.

    Args:
        surface: the mesh that particles land on, in metres. On an empty one they collide only by moving slowly.
        static_points: means of the scene's Gaussians in metres, the obstacles of the paper; they add mass and nothing else.
        config: the numbers of the effect.
        domain: the air that is mapped into the unit cube, see `Box`.
        frames: number of frames of 4 ms, with the first emission in frame 0.
        seed: of all random numbers.
        progress: show a bar.

    Returns:
        A history in metres at the shown rate, `config.fps`. `about` counts the particles emitted, landed (of which `hanging`
        stopped away from the mesh), left and in_air, the substeps and the most in a frame, seconds and cpu_seconds.

    Raises:
        ValueError: a frame would need too many substeps, or a quantity became NaN or infinite; the message names the frame.
    """
    clock, box = Clock(config.fps, frames), Box.of(domain)
    began, cpu = time.perf_counter(), time.process_time()
    solver = PaperSolver(config, box, box.to_box(static_points))
    record = RunRecord(Ground.of(surface, config.surface, domain), config.near * config.dx * box.metres, config.diameter)
    ids, most = np.zeros(0, np.int32), 0
    console = Console(stderr=True, highlight=False)
    shown = {"description": f"simulating {config.effect} (paper)", "console": console, "transient": True}
    for frame in track(range(frames), disable=not progress, **shown):
        rng = np.random.default_rng([seed, frame, 0x9A9E])
        if frame > 0:
            before = solver.positions
            most = max(most, solver.step())
            ids = _end(solver, record, ids, before, frame, rng)
        if _emits(config, frame):
            solver.emit(*_drawn(config, box, rng))
            ids = np.concatenate([ids, record.birth(frame, config.emit)])
        record.at(frame, ids, box.to_metres(solver.positions))
    about = {
        "profile": "paper",
        "effect": config.effect,
        "seed": seed,
        "domain": [*domain.lower, *domain.upper],
        "metres_per_box": box.metres,
        "stationary": len(solver.stationary),
        "substeps": solver.substeps,
        "most_substeps": most,
        "simulated_seconds": (frames - 1) * config.frame_seconds,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
    }
    history = record.history(clock, _in_air(solver, ids, box, config), seed, about)
    history.check_finite()
    return history


def _emits(config: PaperConfig, frame: int) -> bool:
    return frame == 0 if config.emit_every == 0 else frame % config.emit_every == 0


def _drawn(config: PaperConfig, box: Box, rng: np.random.Generator) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"]]:
    """Positions in boxes and velocities in boxes/s of one emission."""
    low, high = box.bounds[0].copy(), box.bounds[1].copy()
    if config.region == "above":
        low[2] = high[2] - SIXTH * (high[2] - low[2])
    elif config.region == "side":
        high[0] = low[0] + SIXTH * (high[0] - low[0])
    slowest, fastest = np.array(config.velocity).T
    return rng.uniform(low, high, (config.emit, 3)), rng.uniform(slowest, fastest, (config.emit, 3))


def _end(
    solver: PaperSolver,
    record: RunRecord,
    ids: Int[ndarray, " n"],
    before: Float[ndarray, "n 3"],
    frame: int,
    rng: np.random.Generator,
) -> Int[ndarray, " m"]:
    """End particles that made contact, left or hardly moved since the frame before; returns the ids that stay active."""
    box, now = solver.box, solver.positions
    where = box.to_metres(now)
    contacts = record.ground.meet(box.to_metres(before), where)
    contact = np.zeros(len(ids), bool)
    contact[contacts.which] = True
    where[contacts.which] = contacts.points
    left = ~solver.inside & ~contact
    slow = np.linalg.norm(now - before, axis=1) < solver.config.threshold
    stops = contact | (slow & ~left)
    record.left(frame, ids[left])
    # Particles that stay active get their row of this frame together with the new ones.
    record.at(frame, ids[stops], where[stops])
    record.stopped(frame, ids[stops], where[stops], rng.uniform(size=int(stops.sum())))
    active = ~(left | stops)
    solver.keep(active)
    return ids[active]


def _in_air(solver: PaperSolver, ids: Int[ndarray, " n"], box: Box, config: PaperConfig) -> Bodies:
    """The active particles, without terminal speeds and flutter."""
    zeros = np.zeros(len(ids), np.float32)
    known = {
        "ids": ids,
        "positions": box.to_metres(solver.positions).astype(np.float32),
        "velocities": (box.metres * solver.velocities).astype(np.float32),
        "diameters": np.full(len(ids), config.diameter, np.float32),
        "represents": np.ones(len(ids), np.float32),
        "reaches": np.full(len(ids), ANY_DISTANCE),
        "since": np.zeros(len(ids), np.int32),
        "until": np.full(len(ids), NO_END, np.int32),
        "kinds": np.zeros(len(ids), np.uint8),
    }
    return Bodies(*(known.get(f.name, zeros) for f in fields(Bodies)))
