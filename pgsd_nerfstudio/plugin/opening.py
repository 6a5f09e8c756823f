"""A run's scene, opened once per process, and its weather: made under the Trainer, later read from the run's folder."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch
from rich.console import Console

from pgsd_nerfstudio.dynamics import scattered
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.plugin.places import found
from pgsd_nerfstudio.weather.making import make_weather
from pgsd_nerfstudio.weather.options import SceneOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.stored import MOTION_FILE, StoredWeatherError
from pgsd_nerfstudio.weather.weather import Weather

console = Console(stderr=True, highlight=False)


def open_scene(
    options: RunOptions, device: torch.device | str, run_folder: Path | None = None, made_in: Path | None = None
) -> PreparedScene:
    """The scene of a run; pipeline, data manager and datasets share it.

    Args:
        options: of the run.
        device: where it is rendered.
        run_folder: absolute; a scene that is no longer where it was is looked for from here.
        made_in: where that folder was when the run was made.

    Raises:
        SceneError: the scene cannot be used.
        RunError: it is nowhere to be found.
    """
    scene = options.scene if run_folder is None else located(options.scene, run_folder, made_in)
    return _opened(scene, options.guidance.scene_description, str(device), options.clips.layers)


def located(scene: SceneOptions, run_folder: Path, made_in: Path | None) -> SceneOptions:
    """The same scene with its files where they lie now; arguments as for `open_scene`.

    Raises:
        RunError: they are neither where they were nor below a folder above the run.
    """
    changes: dict[str, Path] = {}
    for name in ("load_scene", "data"):
        saved = getattr(scene, name)
        if saved is None or str(saved) == "demo":
            continue
        now = found(saved, run_folder, made_in)
        if now is None:
            what, tail = "scene" if name == "load_scene" else "data", Path(*saved.parts[-2:])
            raise RunError(
                f"the {what} of the run {run_folder} is no longer at {saved}, and no {tail} lies in the run's folder or in any "
                "folder above it: put it back to one of these places"
            )
        changes[name] = now
    return replace(scene, **changes)


@lru_cache(maxsize=2)
def _opened(scene: SceneOptions, description: str | None, device: str, layers: int | None) -> PreparedScene:
    loaded = scene.open(description)
    for remark in loaded.remarks:
        console.print(remark, style="dim", markup=False)
    return prepare_scene(loaded, device, layers)


def prepare_weather(prepared: PreparedScene, options: RunOptions) -> Weather:
    """Make the weather of a run, or take it from the cache.

    Args:
        prepared: the scene.
        options: of the run.

    Raises:
        RunError: the scene cannot hold this weather, or the disk is full.
    """
    try:
        effect, simulation = options.chosen_effect(), options.simulation.for_training
        weather = make_weather(prepared, effect, simulation, edited_images=options.answer.edited_images)
        return _without_simulation(weather) if options.motion.motion == "deformation" else weather
    except (OSError, ValueError) as error:
        raise RunError(f"the motion prior could not be made: {error}") from error


def keep_weather(weather: Weather, run_folder: Path) -> None:
    """Store a copy of the weather beside the run's config.yml, so that the run stands alone.

    Raises:
        RunError: it could not be written.
    """
    try:
        weather.save(run_folder)
    except OSError as error:
        raise RunError(f"the weather could not be stored with the run: {error}") from error


def stored_weather(prepared: PreparedScene, options: RunOptions, run_folder: Path | None) -> Weather:
    """The weather that a run was trained with, in the metric frame in which it was made; nothing is simulated.

    Args:
        prepared: the scene.
        options: of the run.
        run_folder: where the run keeps its weather.

    Raises:
        RunError: the run's copy is missing or damaged, or the scene is no longer the one for which it was made.
    """
    try:
        return Weather.open_prepared(run_folder or Path(), prepared)
    except StoredWeatherError as error:
        raise RunError(f"{error}; or make it again with: {options.command()}") from error


def resumed_weather(prepared: PreparedScene, options: RunOptions, resumed_folder: Path | None) -> Weather | None:
    """The weather of the run that training goes on from; None where it has to be prepared anew.

    Args:
        prepared: the scene.
        options: of the run.
        resumed_folder: of that run; None: it is not known.

    Raises:
        RunError: it was made for another scene, or its copy is damaged.
    """
    if resumed_folder is None or not (resumed_folder / MOTION_FILE).is_file():
        return None
    try:
        return Weather.open_prepared(resumed_folder, prepared)
    except StoredWeatherError as error:
        raise RunError(f"{error}; training cannot go on from there") from error


def _without_simulation(weather: Weather) -> Weather:
    """As many particles as are active in the first frame, scattered over the domain; sizes as those of the simulation."""
    history = weather.history
    domain = torch.tensor(history.about["domain"]).reshape(2, 3)
    count = int(((history.births <= 0) & (history.ends > 0)).sum()) or len(history)
    spread = replace(scattered(domain, history, count, seed=weather.options.seed), about=history.about)
    return replace(weather, history=spread)
