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
from pgsd_nerfstudio.weather.making import make_weather
from pgsd_nerfstudio.weather.options import SceneOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.stored import StoredWeatherError
from pgsd_nerfstudio.weather.weather import Weather

console = Console(stderr=True, highlight=False)


def open_scene(options: RunOptions, device: torch.device | str) -> PreparedScene:
    """The scene of a run; pipeline, data manager and datasets share it.

    Args:
        options: of the run.
        device: where it is rendered.

    Raises:
        SceneError: the scene cannot be used.
    """
    return _opened(options.scene, options.guidance.scene_description, str(device), options.clips.layers)


@lru_cache(maxsize=2)
def _opened(scene: SceneOptions, description: str | None, device: str, layers: int | None) -> PreparedScene:
    loaded = scene.open(description)
    for remark in loaded.remarks:
        console.print(remark, style="dim", markup=False)
    return prepare_scene(loaded, device, layers)


def prepare_weather(prepared: PreparedScene, options: RunOptions, run_folder: Path | None) -> Weather:
    """Make the weather of a run, with a copy beside the run's config.yml so that the run stands alone.

    Args:
        prepared: the scene.
        options: of the run.
        run_folder: where the copy goes; None: nowhere.

    Raises:
        RunError: the scene cannot hold this weather, or the disk is full.
    """
    try:
        effect, simulation = options.chosen_effect(), options.simulation
        weather = make_weather(prepared, effect, simulation, edited_images=options.answer.edited_images)
        if options.motion.motion == "deformation":
            weather = _without_simulation(weather)
        if run_folder is not None:
            weather.save(run_folder)
    except (OSError, ValueError) as error:
        raise RunError(f"the motion prior could not be made: {error}") from error
    return weather


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


def _without_simulation(weather: Weather) -> Weather:
    """As many particles as are active in the first frame, scattered over the domain; sizes as those of the simulation."""
    history = weather.history
    domain = torch.tensor(history.about["domain"]).reshape(2, 3)
    count = int(((history.births <= 0) & (history.ends > 0)).sum()) or len(history)
    spread = replace(scattered(domain, history, count, seed=weather.options.seed), about=history.about)
    return replace(weather, history=spread)
