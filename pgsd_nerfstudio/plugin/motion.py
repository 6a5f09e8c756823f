"""The motion prior of a run: prepared once under the Trainer, kept with the run, only ever read afterwards.

The metric frame is kept with it: trajectories are in metres, and where the ground lies must not change with a later version's
way of estimating it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.history import ParticleHistory
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import WeatherOptions
from pgsd_nerfstudio.plugin.stage import Stage
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import content_key

FILE = "motion_prior.safetensors"


def prepare_motion(stage: Stage, options: WeatherOptions, run_folder: Path | None) -> tuple[Stage, ParticleHistory]:
    """Surface and motion prior (both cached by content), with a copy beside the run's config.yml so that it stands alone.

    Raises:
        RunError: the scene cannot hold this weather, or the disk is full.
    """
    from pgsd_nerfstudio.physics.prior import motion_prior
    from pgsd_nerfstudio.surface.mesh import surface_of

    try:
        surface = surface_of(stage.scene, stage.rasterizer)
        clock = Clock(fps=options.fps, frames=options.frames)
        effect, most = options.chosen_effect(), options.max_particles
        history = motion_prior(
            stage.scene,
            surface,
            effect,
            clock,
            seed=options.weather_seed,
            max_particles=most,
            profile=options.physics,
            everything=options.everything,
        )
        made_for = {"splat": _splat_key(stage.scene), "frame": _written(stage.scene.frame)}
        history = replace(history, about={**history.about, **made_for})
        if run_folder is not None:
            history.save(run_folder / FILE)
    except (OSError, ValueError) as error:
        raise RunError(f"the motion prior could not be made: {error}") from error
    return stage, history


def stored_motion(stage: Stage, options: WeatherOptions, run_folder: Path | None) -> tuple[Stage, ParticleHistory]:
    """The motion prior that a run was trained with, and the stage in the metric frame it was made in; nothing is simulated.

    Raises:
        RunError: the run's copy is missing or damaged, or the scene is no longer the one it was made for.
    """
    path = (run_folder or Path()) / FILE
    history = ParticleHistory.load(path)
    if history is None or not {"splat", "frame"} <= set(history.about):
        raise RunError(f"the motion prior {path} is missing or damaged, make it again with: {options.command()}")
    if history.about["splat"] != _splat_key(stage.scene):
        raise RunError(
            f"{options.load_scene} is not the scene this run was trained on (its Gaussians or cameras have changed): "
            f"put the former one back, or train again with: {options.command()}"
        )
    return replace(stage, scene=replace(stage.scene, frame=_read(history.about["frame"]))), history


def _splat_key(scene: Scene) -> str:
    return content_key(scene.gaussians, scene.cameras)


def _written(frame: Frame) -> dict[str, Any]:
    return {
        "metres_per_unit": frame.metres_per_unit,
        "rotation": frame.rotation.tolist(),
        "origin": frame.origin.tolist(),
        "source": frame.source,
    }


def _read(written: dict[str, Any]) -> Frame:
    rotation, origin = torch.tensor(written["rotation"]), torch.tensor(written["origin"])
    return Frame(written["metres_per_unit"], rotation, origin, written["source"])
