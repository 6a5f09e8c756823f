"""The motion prior of a scene. It is simulated once and then read from the cache."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.clock import Clock, Domain, domain_of
from pgsd_nerfstudio.physics.ground.lowest import down_to_ground
from pgsd_nerfstudio.physics.metric import MAX_PARTICLES, console, simulate_metric
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.storage import cache_dir, content_key

if TYPE_CHECKING:
    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.scene.scene import Scene
    from pgsd_nerfstudio.surface.mesh import SurfaceMesh

Profile = Literal["metric", "paper"]
_REVISION = 9  # of the computation; a stored history of another revision is not used


def motion_prior(
    scene: Scene,
    surface: SurfaceMesh,
    effect: Effect,
    clock: Clock,
    *,
    seed: int = 0,
    max_particles: int | None = None,
    profile: Profile = "metric",
    everything: bool = False,
    path: Cameras | None = None,
    cache: bool = True,
    progress: bool = True,
) -> ParticleHistory:
    """The simulated motion of an effect in a scene. It is simulated once and then read from the cache.

    An interrupted simulation goes on where it stopped, except that of the paper. A damaged file is replaced.

    Args:
        scene: its cameras bound the simulated air.
        surface: the mesh that particles land on, in metres.
        effect: the weather.
        clock: frame rate and number of frames.
        seed: of all random numbers.
        max_particles: most particles that the cameras see at once. None: MAX_PARTICLES.
        profile: `metric`, or `paper` for MPM throughout with the published numbers. The paper's simulation lasts 500 frames, of
            which the clock takes the first.
        everything: also simulate particles that no camera can see.
        path: cameras in scene units that alone will see the weather; None: all cameras of the scene.
        cache: read and write the cache.
        progress: show a bar, then print one line about the result.

    Raises:
        ValueError: see `simulate_metric` and `paper.simulate_paper`.
    """
    domain = domain_of(scene)
    if profile == "metric":
        domain = down_to_ground(domain, surface)
    max_particles = MAX_PARTICLES if max_particles is None else max_particles
    cameras = None if everything else scene.frame.cameras_to_metric(scene.cameras if path is None else path)
    parts = (effect.emission, effect.material, effect.wind, effect.timeline, effect.surface, effect.dense)
    parts = (*parts, effect.appearance.area_factor)
    what = (surface.vertices, surface.triangles, effect.name, *parts, clock, domain, seed, max_particles, cameras)
    key = content_key("motion prior", _REVISION, profile, *what)
    stored, folder = cache_dir() / "motion" / f"{key}.safetensors", cache_dir() / "motion" / key
    history = ParticleHistory.load(stored) if cache else None
    found = history is not None
    if history is None:
        if profile == "paper":
            history = _paper(scene, surface, effect, clock, domain, seed, progress)
        else:
            history = simulate_metric(
                surface,
                effect,
                clock,
                domain,
                seed=seed,
                max_particles=max_particles,
                cameras=cameras,
                progress=progress,
                resume=folder if cache else None,
            )
        scale = {"metres_per_unit": scene.frame.metres_per_unit, "scale_source": scene.frame.source}
        history = replace(history, about={**history.about, **scale})
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
    """One line about a history: numbers of particles in all and at once, how they ended, what each represents, and the time."""
    births, ends = history.births.numpy(force=True), history.ends.numpy(force=True)
    change = np.bincount(births, minlength=history.frames + 1) - np.bincount(ends, minlength=history.frames + 1)
    active = np.cumsum(change)[: history.frames]
    about = history.about
    landed, stands_for = int(history.collided.sum()), float(history.represents.mean()) if len(history) else 0.0
    whom = f"each stands for {stands_for:.3g} real ones" if stands_for > 1.005 else "each is a real one"
    ways = {
        "slid": "slid",
        "dense": "were dense matter",
        "splashed": "were droplets of splashes",
        "absorbed": "were absorbed",
    }
    regimes = "".join(f", {about[name]:,} {verb}" for name, verb in ways.items() if about.get(name))
    return (
        f"{about.get('effect', 'motion prior')}: {len(history):,} particles over {history.frames} frames, "
        f"{active.mean():,.0f} on their way on average (at most {active.max():,}), {landed:,} landed{regimes}; "
        f"{whom}, {about.get('air_simulated', 1.0):.0%} of the air "
        f"simulated, {about.get('seconds', 0.0):.1f} s"
    )


def _paper(
    scene: Scene, surface: SurfaceMesh, effect: Effect, clock: Clock, domain: Domain, seed: int, progress: bool
) -> ParticleHistory:
    """The paper's simulation of the effect with that name. The scene's Gaussians within the domain are its obstacles."""
    from pgsd_nerfstudio.physics.paper import paper_config, simulate_paper  # starts Taichi

    means = scene.frame.to_metric(scene.gaussians.means.float()).cpu().numpy().astype(np.float64)
    inside = domain.contains(means)
    config = replace(paper_config(effect.name), fps=clock.fps)
    return simulate_paper(surface, means[inside], config, domain, frames=clock.frames, seed=seed, progress=progress)
