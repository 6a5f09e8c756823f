"""Simulation of weather in the air around a scene in metric units.

Frames are simulated in chunks. A chunk is a pure function of the state at its start, and the randomness of a frame comes from
the seed and the number of the frame alone. An interrupted run therefore goes on from its last stored chunk and ends with the
same bits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.air.deflection import Deflection
from pgsd_nerfstudio.physics.air.emitters import Sizes
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import RunState
from pgsd_nerfstudio.physics.clock import SIGHT, Clock, Domain
from pgsd_nerfstudio.physics.frames import simulate_chunk
from pgsd_nerfstudio.physics.ground.deposits import Deposits
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.laws.populations import fall_speed
from pgsd_nerfstudio.physics.record.chunks import Chunk, assemble, load_chunk, save_chunk
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.scene.cameras import Cameras

if TYPE_CHECKING:
    from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_PARTICLES = 20_000  # seen at once; a CPU refines that many in reasonable time
CHUNK = 25  # frames; an interruption loses at most that many
LEAST_GUSTS = 0.35  # smallest gustiness that the region of sight allows for
WIDEST_PICTURE = 640  # pixels; in wider pictures even more could be told apart, and hardly anyone would see it
SMALLEST_SEEN = 0.28  # pixels; a flake so wide takes 2 % of the light of its pixel
SIGHT_MARGIN = 0.5  # m around views; the cameras of training clips stray no farther from the straight paths between cameras

console = Console(stderr=True, highlight=False)


def simulate_metric(
    surface: SurfaceMesh,
    effect: Effect,
    clock: Clock,
    domain: Domain,
    *,
    seed: int = 0,
    max_particles: int | None = None,
    cameras: Cameras | None = None,
    sharpness: float | None = None,
    progress: bool = True,
    resume: Path | None = None,
) -> ParticleHistory:
    """Simulate an effect in a domain above a surface.

    Args:
        surface: the mesh that particles land on, in metres. On an empty one nothing lands.
        effect: the weather.
        clock: frame rate and number of frames.
        domain: the simulated air, in metres.
        seed: of all random numbers.
        max_particles: most particles that the cameras see at once, or that are in the air without cameras. None: MAX_PARTICLES.
        cameras: in metres. Particles that cannot come into the view of any of them are left out. None: all are simulated.
        sharpness: distance up to which the cameras tell all particles of rain and snow apart, relative to their diameter; None:
            what their pictures show.
        progress: show a bar.
        resume: folder that keeps chunks until the run is complete. None keeps nothing.

    Returns:
        The trajectories in metres; `about` holds the settings, totals of the deposits and counts of how particles ended.

    Raises:
        ValueError: `max_particles` is less than 1, or a quantity became NaN or infinite; then the message names the quantity
            and the frame.
    """
    max_particles = MAX_PARTICLES if max_particles is None else max_particles
    if max_particles < 1:
        raise ValueError(f"max_particles must be at least 1, got {max_particles}")
    began = time.perf_counter()
    starts = range(0, clock.frames, CHUNK)
    chunks: list[Chunk] = []
    state = RunState.empty()
    with _one_thread(), _bar(progress) as bar:
        sight, most = _sight(effect, domain, cameras), min(max_particles, effect.emission.most or max_particles)
        air = Air(
            domain=domain,
            sizes=Sizes.of(effect, domain, most, sight, sharpness or _sharpness(effect, cameras)),
            wind=WindField.draw(effect.wind, seed, Deflection.of(surface, domain, effect.wind)),
            arrival=Arrival.of(effect.timeline, domain, effect.wind),
            effect=effect,
            ground=Ground.of(surface, effect.surface, domain),
            sight=sight,
            step=clock.step,
            seed=seed,
        )
        deposits = Deposits(effect, surface, domain)
        task = bar.add_task(f"simulating {effect.name}", total=clock.frames)
        for index, start in enumerate(starts):
            frames = min(CHUNK, clock.frames - start)
            chunk = load_chunk(resume, index, start, frames) if resume is not None else None
            if chunk is None:
                chunk = simulate_chunk(air, deposits, state, start, frames)
                if resume is not None and not save_chunk(resume, index, chunk):
                    last = start + frames - 1
                    console.print(f"[yellow]could not store frames {start}-{last} in {resume}: going on[/]", soft_wrap=True)
                    resume = None
            chunks.append(chunk)
            state = chunk.state
            bar.update(task, completed=start + frames)
        deposits.restore(state.deposits)  # the last chunk may have come from the disk
        about = {
            "profile": "metric",
            "effect": effect.name,
            "seed": seed,
            "intensity": effect.emission.intensity,
            "unit": effect.emission.unit,
            "domain": [*domain.lower, *domain.upper],
            "air_simulated": air.sight.share,
            "real_in_air": air.sizes.real_in_air,
            "sharpness": air.sizes.sharpness,
            **deposits.summary(),
            "seconds": time.perf_counter() - began,
        }
        history = assemble(chunks, clock, about)
        history.check_finite()
    return history


def _sight(effect: Effect, domain: Domain, cameras: Cameras | None) -> Sight:
    if cameras is None:
        return Sight.everything()
    # The region of sight does not know that obstacles deflect the wind; the allowance for gusts covers that.
    wind = replace(effect.wind, gustiness=max(effect.wind.gustiness, LEAST_GUSTS))
    ends = np.array([effect.emission.smallest, effect.emission.largest])
    slowest, fastest = (float(speed) for speed in np.sort(fall_speed(ends, effect.material)))
    return Sight.of(domain, cameras, distance=SIGHT, margin=SIGHT_MARGIN, slowest=slowest, fastest=fastest, wind=wind)


def _sharpness(effect: Effect, cameras: Cameras | None) -> float | None:
    """Distance up to which pictures tell particles apart, relative to their diameter; None where distance does not matter.

    A parcel of fog is no droplet, and is seen at any distance. A storm carries all of its sand past any camera within seconds,
    so that nothing is gained by knowing which grains come near.
    """
    if cameras is None or len(cameras) == 0 or not effect.emission.precipitates:
        return None
    focal = float(cameras.Ks[:, 0, 0].median()) * min(1.0, WIDEST_PICTURE / cameras.width)
    return math.sqrt(effect.appearance.area_factor) * focal / SMALLEST_SEEN


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch with one thread: the arrays here are so small that several threads would mostly wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _bar(show: bool) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=not show, transient=True)
