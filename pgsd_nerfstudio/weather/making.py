"""Makes the weather of a scene: surface, motion prior, the scene's answer and the initial look, computed once and cached."""

from __future__ import annotations

from pathlib import Path

import torch
from rich.console import Console

from pgsd_nerfstudio.effects import Effect
from pgsd_nerfstudio.effects import effect as effect_named
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.physics.motion_prior import Profile, motion_prior
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.prepare import answer_of, edits_of
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of
from pgsd_nerfstudio.weather.adapting import adapted
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.weather import Weather

console = Console(stderr=True, highlight=False)


def simulate(
    scene: Scene,
    effect: Effect | EffectOptions | str = "snowfall",
    *,
    seconds: float = 10.0,
    fps: float = 25.0,
    seed: int = 0,
    max_particles: int | None = None,
    physics: Profile = "metric",
    everything: bool = False,
    collisions: bool = True,
    edited_images: str | Path | None = None,
    device: torch.device | str | None = None,
    progress: bool = True,
) -> Weather:
    """The weather of a scene, simulated and not trained. What was made before with the same arguments comes from the cache.

    >>> import pgsd_nerfstudio                                                                         # doctest: +SKIP
    >>> scene = pgsd_nerfstudio.load_scene("garden.ply", data="garden")                               # doctest: +SKIP
    >>> weather = pgsd_nerfstudio.simulate(scene, pgsd_nerfstudio.effect("snowfall", intensity=2.0))  # doctest: +SKIP
    >>> weather.render(scene.cameras[0], second=3.0).save("snow.png")                                 # doctest: +SKIP

    Args:
        scene: as `load_scene` returns it.
        effect: the weather; or options of one, such as EffectOptions(weather="purple snow"); or the name of a built-in one:
            snowfall, rainfall, fog or sandstorm.
        seconds: length of the weather in seconds.
        fps: frames per second of the simulation.
        seed: another seed gives another weather of the same kind.
        max_particles: most particles that cameras see at once, a bound for machines: where it is reached, fewer are told apart
            far away. By default 100,000, with CUDA 1,000,000.
        physics: `metric` is right in SI units, `paper` is the publication's solver and numbers.
        everything: simulate also the air that no camera of the scene sees.
        collisions: whether particles meet the scene's surface.
        edited_images: folder of training views as an image editor shows them under this weather; the scene's look is fitted to
            them (1000 iterations, cached).
        device: cpu or cuda; by default cuda where there is one.
        progress: show bars and one line about the result on stderr.

    Raises:
        ValueError: an argument is out of its range, or the scene cannot hold this weather.
        OSError: the cache cannot be written.
    """
    options = SimulationOptions(
        seconds=seconds,
        fps=fps,
        seed=seed,
        max_particles=max_particles,
        physics=physics,
        everything=everything,
        collisions=collisions,
    )
    options.check()
    if isinstance(effect, EffectOptions):
        effect, remarks = effect.resolve()
        for remark in remarks if progress else ():
            console.print(remark, style="dim", markup=False)
    chosen = effect_named(effect) if isinstance(effect, str) else effect
    folder = None if edited_images is None else Path(edited_images)
    return make_weather(prepare_scene(scene, device), chosen, options, edited_images=folder, progress=progress)


def make_weather(
    prepared: PreparedScene,
    effect: Effect,
    options: SimulationOptions,
    *,
    path: Cameras | None = None,
    edited_images: Path | None = None,
    progress: bool = True,
) -> Weather:
    """As `simulate`, from a prepared scene and the options of a command.

    Args:
        prepared: the scene on a device.
        effect: the weather.
        options: how its motion is simulated.
        path: cameras in scene units that alone will see it; None: all cameras of the scene.
        edited_images: as for `simulate`.
        progress: as for `simulate`.

    Raises:
        ValueError: the scene cannot hold this weather, or an edited picture cannot be used.
        OSError: the cache cannot be written.
    """
    effect, said = adapted(effect, prepared)
    for remark in said if progress else ():
        console.print(remark, style="dim", markup=False)
    surface = surface_of(prepared.scene, prepared.rasterizer, progress=progress)
    history = motion_of(prepared, surface, effect, options, path=path, progress=progress).to(prepared.device)
    answer = answer_to(prepared, surface, effect, options, edited_images=edited_images).struck_by(history)
    return Weather(prepared, effect, options, history, answer.beside(history.about.get("sharpness")))


def motion_of(
    prepared: PreparedScene,
    surface: SurfaceMesh,
    effect: Effect,
    options: SimulationOptions,
    *,
    path: Cameras | None = None,
    progress: bool = True,
) -> ParticleHistory:
    """The motion prior of a weather, from the cache where it was simulated before.

    Args:
        prepared: the scene on a device.
        surface: of that scene, in metres.
        effect: the weather.
        options: how its motion is simulated.
        path: as for `make_weather`.
        progress: show a bar and one line about the result on stderr.

    Returns:
        The motion of all particles in metres, on the CPU.

    Raises:
        ValueError: the scene cannot hold this weather.
    """
    return motion_prior(
        prepared.scene,
        surface if options.collisions else SurfaceMesh.empty(),
        effect,
        options.clock,
        seed=options.seed,
        max_particles=options.particles,
        profile=options.physics,
        everything=options.everything,
        path=path,
        progress=progress,
    )


def answer_to(
    prepared: PreparedScene,
    surface: SurfaceMesh,
    effect: Effect,
    options: SimulationOptions,
    *,
    edited_images: Path | None = None,
) -> Answer:
    """How the frozen scene answers the weather, on the scene's device.

    Args:
        prepared: the scene on a device.
        surface: of that scene, in metres.
        effect: the weather.
        options: its length and seed are used.
        edited_images: as for `simulate`.

    Raises:
        ValueError: an edited picture cannot be used.
        OSError: the cache cannot be written.
    """
    scene, device, seed = prepared.scene, prepared.device, options.seed
    edits = None if edited_images is None else edits_of(scene, edited_images, device, seed=seed)
    return answer_of(scene, surface, effect, seconds=options.seconds, seed=seed, edits=edits).to(device)
