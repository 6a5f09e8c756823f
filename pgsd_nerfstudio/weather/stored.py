"""A weather in a folder: motion, answer, effect and options as files that anyone can read.

The metric frame is stored with the motion: trajectories are in metres, and where the ground lies must not change with a later
version's way of estimating it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pydantic import TypeAdapter, ValidationError

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.prepare import save_answer, stored_answer
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import atomic_write, content_key
from pgsd_nerfstudio.version import __version__
from pgsd_nerfstudio.weather.options import SimulationOptions

MOTION_FILE, ANSWER_FILE, DESCRIPTION_FILE = "motion_prior.safetensors", "answer.safetensors", "weather.json"


class StoredWeatherError(ValueError):
    """A stored weather that cannot be opened: which file is wrong, and how."""


class StoredWeather(NamedTuple):
    """The parts of a weather that are stored; the scene stays where it is."""

    effect: Effect
    options: SimulationOptions
    history: ParticleHistory
    answer: Answer


def save_parts(folder: Path, scene: Scene, parts: StoredWeather) -> None:
    """Write the parts of a weather into a folder, which is made if need be.

    Args:
        folder: where they go.
        scene: for which they were made; its metric frame is stored with the motion.
        parts: what is stored.

    Raises:
        OSError: a file could not be written.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"a weather is stored in a folder, but {folder} is a file")
    made_for = {"splat": _splat_key(scene), "frame": _plain(scene.frame)}
    folder.mkdir(parents=True, exist_ok=True)
    replace(parts.history, about={**parts.history.about, **made_for}).save(folder / MOTION_FILE)
    save_answer(folder / ANSWER_FILE, parts.answer)
    description = {"version": __version__, "effect": asdict(parts.effect), "options": asdict(parts.options)}
    with atomic_write(folder / DESCRIPTION_FILE) as beside:
        beside.write_text(json.dumps(description, indent=1, ensure_ascii=False) + "\n", "utf-8")


def open_parts(folder: Path, scene: Scene) -> tuple[StoredWeather, Frame]:
    """The parts of a weather on the CPU, and the metric frame in which they were made.

    Args:
        folder: of `save_parts`.
        scene: for which they were made.

    Raises:
        StoredWeatherError: a file is missing, damaged or of another version, or the scene is another one.
    """
    if not (folder / DESCRIPTION_FILE).is_file():
        found = "holds none" if folder.is_dir() else "is no folder"
        raise StoredWeatherError(f"no weather was stored in {folder}: it {found}; Weather.save and ns-train store one")
    effect, options = _description(folder / DESCRIPTION_FILE)
    motion = folder / MOTION_FILE
    history = ParticleHistory.load(motion)
    if history is None or not {"splat", "frame"} <= set(history.about):
        raise StoredWeatherError(f"the motion prior {motion} is missing or damaged")
    if history.about["splat"] != _splat_key(scene):
        raise StoredWeatherError(
            f"this is not the scene for which {folder} was made: its Gaussians or cameras have changed; put the former one back"
        )
    frame = _frame(history.about["frame"])
    kept = folder / ANSWER_FILE
    answer = stored_answer(kept, replace(scene, frame=frame), effect, seconds=options.seconds, seed=options.seed)
    if answer is None:
        raise StoredWeatherError(f"the scene's answer {kept} is missing or damaged")
    return StoredWeather(effect, options, history, answer), frame


def _description(path: Path) -> tuple[Effect, SimulationOptions]:
    try:
        stored = json.loads(path.read_text("utf-8"))
        version = str(stored["version"])
        if version.split(".")[:2] != __version__.split(".")[:2]:
            raise StoredWeatherError(
                f"{path} was written by pgsd_nerfstudio {version}, installed is {__version__}: make it again"
            )
        effect = TypeAdapter(Effect).validate_python(stored["effect"])
        options = TypeAdapter(SimulationOptions).validate_python(stored["options"])
    except (OSError, ValidationError, json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise StoredWeatherError(f"the description {path} of the weather is damaged") from error
    return effect, options


def _splat_key(scene: Scene) -> str:
    return content_key(scene.gaussians, scene.cameras)


def _plain(frame: Frame) -> dict[str, Any]:
    return {
        "metres_per_unit": frame.metres_per_unit,
        "rotation": frame.rotation.tolist(),
        "origin": frame.origin.tolist(),
        "source": frame.source,
    }


def _frame(plain: dict[str, Any]) -> Frame:
    rotation, origin = torch.tensor(plain["rotation"]), torch.tensor(plain["origin"])
    return Frame(plain["metres_per_unit"], rotation, origin, plain["source"])
