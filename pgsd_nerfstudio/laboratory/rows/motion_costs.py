"""Costs of the motion prior in the demo at different counts, beside steps that went through the surface.

`scripts/compare_motion.py` runs the same cases in another build.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from pgsd_nerfstudio.effects.effect import Effect, effect
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, domain_of, simulate_metric
from pgsd_nerfstudio.physics.bodies import DENSE, SLID
from pgsd_nerfstudio.physics.ground.lowest import down_to_ground
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of

CASES = (("snowfall", 20_000), ("snowfall", 200_000), ("rainfall", 200_000))
SECONDS = 4.0
ALL = 10**7
STEPS = 500_000  # whose ways are tried against the surface
AT_SURFACE = 2e-3  # m; what stays or slides lies so close to it


def costs(quick: bool) -> Iterator[Record]:
    """CPU time of a particle per frame, setup included, without dense matter, which has rows of its own.

    Args:
        quick: one second and the smallest count only.
    """
    scene = demo_scene()
    surface = surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), progress=False)
    domain = down_to_ground(domain_of(scene), surface)
    clock = Clock(frames=25 if quick else round(25 * SECONDS))
    for name, count in CASES[:1] if quick else CASES:
        light = replace(effect(name), dense=None)
        simulated(light, 300, Clock(frames=3), surface, domain, None)  # compiles
        for what, cameras in (("", None), (" that its cameras see", scene.frame.cameras_to_metric(scene.cameras))):
            spent, run = min(
                (simulated(light, count, clock, surface, domain, cameras) for _ in range(1 if quick else 2)),
                key=lambda pair: pair[0],
            )
            rows = run.positions.shape[0]
            yield Record(
                f"motion prior, {name}, {count:,} in the air{what}",
                1e9 * spent / rows,
                "ns CPU per particle and frame",
                error=steps_through(run, surface),
                error_unit=f"of {min(rows, STEPS):,} steps go through the surface",
                source=f"demo, {clock.seconds:g} s, {rows:,} rows, {spent:.1f} s",
            )
    yield _of_what_is_seen(scene, surface, domain, clock)


def _of_what_is_seen(scene: Scene, surface: SurfaceMesh, domain: Domain, clock: Clock) -> Record:
    """Cost of what one narrow view sees, against that of all flakes in the air."""
    view = scene.frame.cameras_to_metric(scene.cameras[25])
    narrow = replace(view, Ks=view.Ks * torch.tensor([[2.5, 1, 1], [1, 2.5, 1], [1, 1, 1]]).to(view.Ks))
    light, found = replace(effect("snowfall"), dense=None), {}
    for what, cameras in (("all", None), ("seen", narrow)):
        simulated(light, 300, Clock(frames=3), surface, domain, cameras)  # compiles
        spent, run = simulated(light, ALL, clock, surface, domain, cameras)
        found[what] = spent, run.positions.shape[0]
    return Record(
        "motion prior, snowfall: CPU time of what a narrow view sees, against all flakes",
        found["seen"][0] / found["all"][0],
        "",
        error=found["seen"][1] / found["all"][1],
        error_unit="of the particle-frames",
        source=f"demo, {clock.seconds:g} s, {found['all'][1]:,} and {found['seen'][1]:,} rows, {found['all'][0]:.1f} and "
        f"{found['seen'][0]:.1f} s; every flake of 1.5 mm/h, setup included",
    )


def simulated(
    light: Effect, count: int, clock: Clock, surface: SurfaceMesh, domain: Domain, cameras: Cameras | None
) -> tuple[float, ParticleHistory]:
    """Seconds of CPU time of a simulation whose maps are made anew, and the history."""
    fresh = SurfaceMesh(surface.vertices, surface.triangles)
    began = time.process_time()
    run = simulate_metric(fresh, light, clock, domain, max_particles=count, cameras=cameras, progress=False)
    return time.process_time() - began, run


def steps_through(run: ParticleHistory, surface: SurfaceMesh) -> int:
    """Number of steps from frame to frame, of at most STEPS, that pass through the surface, found by a ray for each.

    Steps that begin or end at the surface do not count, nor do those of sliders.
    """
    follows = torch.ones(run.positions.shape[0], dtype=torch.bool)
    follows[run.offsets[:-1]] = False
    follows &= (run.kinds & (SLID | DENSE) == 0).repeat_interleave(run.offsets.diff())  # those follow the surface
    ends = follows.nonzero()[:, 0].numpy()
    ends = np.random.default_rng(0).permutation(ends)[:STEPS]
    start, stop = run.positions[ends - 1].numpy(), run.positions[ends].numpy()
    length = np.linalg.norm(stop - start, axis=1)
    moves = length > 0
    start, stop, length = start[moves], stop[moves], length[moves]
    distance = surface.first_hits(start, (stop - start) / length[:, None]).distance
    through = (distance > AT_SURFACE) & (distance < length - AT_SURFACE)
    beside = surface.closest(stop[through]).distance.numpy() > AT_SURFACE
    return int(beside.sum())
