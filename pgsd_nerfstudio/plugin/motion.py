"""The motion prior of a run and the scene's answer to the weather: prepared once under the Trainer, kept with the run, only
ever read afterwards.

The metric frame is kept with it: trajectories are in metres, and where the ground lies must not change with a later version's
way of estimating it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from pgsd_nerfstudio.dynamics import scattered
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import WeatherOptions
from pgsd_nerfstudio.plugin.prepared_scene import PreparedScene
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.prepare import answer_of, edits_of, save_answer, stored_answer
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import content_key

FILE = "motion_prior.safetensors"
ANSWER_FILE = "answer.safetensors"


class Weather(NamedTuple):
    """What a run is made of."""

    prepared: PreparedScene
    history: ParticleHistory
    answer: Answer


def prepare_motion(prepared: PreparedScene, options: WeatherOptions, run_folder: Path | None) -> Weather:
    """Surface and motion prior (both cached by content), with a copy beside the run's config.yml so that it stands alone.

    Raises:
        RunError: the scene cannot hold this weather, or the disk is full.
    """
    from pgsd_nerfstudio.physics.motion_prior import motion_prior
    from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of

    try:
        surface = surface_of(prepared.scene, prepared.rasterizer)
        clock = Clock(fps=options.fps, frames=options.frames)
        effect, most = options.chosen_effect(), options.max_particles
        history = motion_prior(
            prepared.scene,
            surface if options.collisions else SurfaceMesh.empty(),
            effect,
            clock,
            seed=options.weather_seed,
            max_particles=most,
            profile=options.physics,
            everything=options.everything,
        )
        if options.motion == "deformation":
            # As many, in the same box and sizes; the domain goes along with the simulation's account.
            box = torch.tensor(history.about["domain"]).reshape(2, 3)
            count = int(((history.births <= 0) & (history.ends > 0)).sum()) or len(history)
            history = replace(scattered(box, history, count, seed=options.weather_seed), about=history.about)
        made_for = {"splat": _splat_key(prepared.scene), "frame": _written(prepared.scene.frame)}
        history = replace(history, about={**history.about, **made_for})
        edits = None
        if options.edited_images is not None:
            edits = edits_of(prepared.scene, options.edited_images, prepared.device, seed=options.weather_seed)
        answer = answer_of(prepared.scene, surface, effect, seconds=options.seconds, seed=options.weather_seed, edits=edits)
        if run_folder is not None:
            history.save(run_folder / FILE)
            save_answer(run_folder / ANSWER_FILE, answer)
    except (OSError, ValueError) as error:
        raise RunError(f"the motion prior could not be made: {error}") from error
    return Weather(prepared, history, answer)


def stored_motion(prepared: PreparedScene, options: WeatherOptions, run_folder: Path | None) -> Weather:
    """The motion prior that a run was trained with, and the scene in the metric frame it was made in; nothing is simulated.

    Raises:
        RunError: the run's copy is missing or damaged, or the scene is no longer the one it was made for.
    """
    path = (run_folder or Path()) / FILE
    history = ParticleHistory.load(path)
    if history is None or not {"splat", "frame"} <= set(history.about):
        raise RunError(f"the motion prior {path} is missing or damaged, make it again with: {options.command()}")
    if history.about["splat"] != _splat_key(prepared.scene):
        raise RunError(
            f"{options.load_scene} is not the scene this run was trained on (its Gaussians or cameras have changed): "
            f"put the former one back, or train again with: {options.command()}"
        )
    scene = replace(prepared.scene, frame=_read(history.about["frame"]))
    kept, effect = (run_folder or Path()) / ANSWER_FILE, options.chosen_effect()
    answer = stored_answer(kept, scene, effect, seconds=options.seconds, seed=options.weather_seed)
    if answer is None:
        raise RunError(f"the scene's answer {kept} is missing or damaged, make it again with: {options.command()}")
    return Weather(replace(prepared, scene=scene), history, answer)


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
