"""The motion prior of a run: prepared once under the Trainer, kept with the run, only ever read afterwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pgsd_nerfstudio.physics.history import ParticleHistory
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import WeatherOptions
from pgsd_nerfstudio.plugin.stage import Stage

FILE = "motion_prior.safetensors"


def prepare_motion(stage: Stage, options: WeatherOptions, run_folder: Path | None) -> ParticleHistory:
    """Surface and motion prior (both cached by content), with a copy beside the run's config.yml so that it stands alone.

    Raises:
        RunError: the scene cannot hold this weather, or the disk is full.
    """
    from pgsd_nerfstudio.physics.simulate import Clock, motion_prior
    from pgsd_nerfstudio.surface.mesh import surface_of

    try:
        surface = surface_of(stage.scene, stage.rasterizer)
        history = motion_prior(
            stage.scene,
            surface,
            options.chosen_effect(),
            Clock(fps=options.fps, frames=options.frames),
            seed=options.weather_seed,
            max_particles=options.max_particles,
        )
        history = replace(history, about={**history.about, "scene": stage.scene.content_key()})
        if run_folder is not None:
            history.save(run_folder / FILE)
    except (OSError, ValueError) as error:
        raise RunError(f"the motion prior could not be made: {error}") from error
    return history


def stored_motion(stage: Stage, options: WeatherOptions, run_folder: Path | None) -> ParticleHistory:
    """The motion prior that a run was trained with; nothing is simulated.

    Raises:
        RunError: the run's copy is missing or damaged, or the scene is no longer the one it was made for.
    """
    path = (run_folder or Path()) / FILE
    history = ParticleHistory.load(path)
    if history is None:
        raise RunError(f"the motion prior {path} is missing or damaged, make it again with: {options.command()}")
    if history.about.get("scene") != stage.scene.content_key():
        raise RunError(
            f"{options.load_scene} is not the scene this run was trained on (its Gaussians, cameras or scale have changed): "
            f"put the former one back, or train again with: {options.command()}"
        )
    return history
