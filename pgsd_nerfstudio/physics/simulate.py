"""The motion prior: weather simulated in the air around a scene, from full air at frame 0 to the last frame.

Frames are simulated in chunks. A chunk is a pure function of the state at its start, and the randomness of a frame comes from
the seed and the number of the frame alone; so an interrupted run goes on from its last stored chunk and ends with the same
bits.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from pgsd_nerfstudio.physics.chunks import Chunk, State, assemble, load_chunk, save_chunk
from pgsd_nerfstudio.physics.clock import Clock, Domain, domain_of
from pgsd_nerfstudio.physics.contact import Ground
from pgsd_nerfstudio.physics.emitters import Sizes
from pgsd_nerfstudio.physics.flight import Air, simulate_chunk
from pgsd_nerfstudio.physics.history import ParticleHistory
from pgsd_nerfstudio.physics.wind import WindField
from pgsd_nerfstudio.storage import cache_dir, content_key
from pgsd_nerfstudio.weather.effect import Effect

if TYPE_CHECKING:
    from pgsd_nerfstudio.scene.scene import Scene
    from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_PARTICLES = 20_000  # in the air at once: what a CPU renders and refines in reasonable time
CHUNK = 25  # frames that an interruption may cost
_REVISION = 1  # of what is computed; a stored history of another revision is not used

console = Console(stderr=True, highlight=False)


def simulate(
    surface: SurfaceMesh,
    effect: Effect,
    clock: Clock,
    domain: Domain,
    *,
    seed: int = 0,
    max_particles: int | None = None,
    progress: bool = True,
    resume: Path | None = None,
) -> ParticleHistory:
    """Simulate an effect in a box of air above a surface.

    Args:
        surface: what particles land on, in metres; may be empty, then nothing lands.
        max_particles: most particles in the air at once; each then represents several real ones. None: MAX_PARTICLES.
        progress: show a bar.
        resume: folder in which chunks are kept until the run is complete; None keeps nothing.

    Raises:
        ValueError: a quantity became NaN or infinite; the message names it and the frame.
    """
    max_particles = MAX_PARTICLES if max_particles is None else max_particles
    if max_particles < 1:
        raise ValueError(f"max_particles must be at least 1, got {max_particles}")
    began = time.perf_counter()
    starts = range(0, clock.frames, CHUNK)
    chunks: list[Chunk] = []
    state = State.empty()
    with _one_thread(), _bar(progress) as bar:
        air = Air(
            domain=domain,
            sizes=Sizes.of(effect, domain.volume, max_particles),
            wind=WindField.draw(effect.wind, seed),
            effect=effect,
            ground=Ground.of(surface, effect.surface, domain),
            step=clock.step,
            seed=seed,
        )
        task = bar.add_task(f"simulating {effect.name}", total=clock.frames)
        for index, start in enumerate(starts):
            frames = min(CHUNK, clock.frames - start)
            chunk = load_chunk(resume, index, start, frames) if resume is not None else None
            if chunk is None:
                chunk = simulate_chunk(air, state, start, frames)
                if resume is not None and not save_chunk(resume, index, chunk):
                    last = start + frames - 1
                    console.print(f"[yellow]could not store frames {start}-{last} in {resume}: going on[/]", soft_wrap=True)
                    resume = None
            chunks.append(chunk)
            state = chunk.state
            bar.update(task, completed=start + frames)
    about = {
        "effect": effect.name,
        "seed": seed,
        "intensity_mm_per_hour": effect.emission.intensity,
        "domain": [*domain.lower, *domain.upper],
        "seconds": time.perf_counter() - began,
    }
    history = assemble(chunks, clock, about)
    history.check_finite()
    return history


def motion_prior(
    scene: Scene,
    surface: SurfaceMesh,
    effect: Effect,
    clock: Clock,
    *,
    seed: int = 0,
    max_particles: int | None = None,
    cache: bool = True,
    progress: bool = True,
) -> ParticleHistory:
    """The simulated motion of an effect in a scene; simulated once and then read from the cache.

    An interrupted simulation goes on where it was; a damaged file is made again. Prints one line about the result.
    """
    domain = domain_of(scene)
    max_particles = MAX_PARTICLES if max_particles is None else max_particles
    parts = (effect.emission, effect.material, effect.wind, effect.surface)
    key = content_key(
        "motion prior", _REVISION, surface.vertices, surface.triangles, effect.name, *parts, clock, domain, seed, max_particles
    )
    stored, folder = cache_dir() / "motion" / f"{key}.safetensors", cache_dir() / "motion" / key
    history = ParticleHistory.load(stored) if cache else None
    found = history is not None
    if history is None:
        history = simulate(
            surface,
            effect,
            clock,
            domain,
            seed=seed,
            max_particles=max_particles,
            progress=progress,
            resume=folder if cache else None,
        )
        if cache:
            try:
                history.save(stored)
                shutil.rmtree(folder, ignore_errors=True)
            except OSError as error:
                console.print(f"[yellow]the motion prior is not kept: {error}[/]")
    if progress:
        console.print(summary(history) + (f" (from {stored})" if found else ""), soft_wrap=True)
    return history


def summary(history: ParticleHistory) -> str:
    """One line: how many particles, how many at once, how many landed, what each stands for, how long it took."""
    births, ends = history.births.numpy(force=True), history.ends.numpy(force=True)
    change = np.bincount(births, minlength=history.frames + 1) - np.bincount(ends, minlength=history.frames + 1)
    active = np.cumsum(change)[: history.frames]
    about = history.about
    return (
        f"{about.get('effect', 'motion prior')}: {len(history):,} particles over {history.frames} frames, "
        f"{active.mean():,.0f} in the air on average (at most {active.max():,}), {int(history.collided.sum()):,} landed, "
        f"each stands for {float(history.represents.mean()):.3g} real ones, {about.get('seconds', 0.0):.1f} s"
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch with one thread: arrays are so small here that several would wait for each other longer than they work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _bar(show: bool) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=not show, transient=True)
