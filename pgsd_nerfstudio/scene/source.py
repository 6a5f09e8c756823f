"""What people hand over as a scene: which file holds the splat, and what came with it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgsd_nerfstudio.scene.captures.inria import newest_splat
from pgsd_nerfstudio.scene.captures.reading import camera_file
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.frame import direction
from pgsd_nerfstudio.scene.splats.reading import SPLAT_SUFFIXES

ACCEPTED = f"a splatfacto run folder, its config.yml, a .ckpt, a splat ({', '.join(SPLAT_SUFFIXES)}), Inria's output folder"
POINTS = ("sparse_pc.ply", "points3D.ply", "input.ply")
"""Clouds of points that nerfstudio and Inria's trainer lay beside their data, and no splats."""


def check_source(
    path: Any,
    data: Any = None,
    metres_per_unit: Any = None,
    up: Any = None,
    camera: Any = None,
) -> None:
    """Refuse what `loading.read_scene` can refuse without opening anything; its arguments have the same names.

    Raises:
        SceneError: there is no such scene or data, the scale is not a positive number, or arguments exclude each other.
        TypeError: an argument is of another type.
    """
    for name, value in (("path", path), ("data", data)):
        if not isinstance(value, str | os.PathLike) and (name == "path" or value is not None):
            raise TypeError(f"{name} must be the path of a file or folder, got {type(value).__name__}")
        if value is not None and not str(value).strip():
            raise SceneError(f"{name} is empty: expected {ACCEPTED}, or the word demo" if name == "path" else "data= is empty")
    if metres_per_unit is not None:
        if isinstance(metres_per_unit, bool) or not isinstance(metres_per_unit, int | float):
            raise TypeError(f"metres_per_unit must be a number, got {type(metres_per_unit).__name__}")
        if not 0 < metres_per_unit < math.inf:
            raise SceneError(f"metres per scene unit must be a positive number, got {metres_per_unit:g}")
    if up is not None:
        try:
            direction(up)
        except ValueError as error:
            raise SceneError(str(error)) from error
    if camera not in (None, "orbit"):
        raise SceneError(f"camera must be 'orbit', which makes cameras, or left out; got {camera!r}")
    if str(path) == "demo":
        if data is not None or camera is not None:
            raise SceneError("the demo has cameras of its own: leave data= and camera= out")
    elif not _exists(path):
        raise SceneError(f"no scene at {path}: expected {ACCEPTED}, or the word demo")
    if data is not None and not _exists(data):
        raise SceneError(f"no data at {data}: expected a transforms.json, a COLMAP folder, or a cameras.json")
    if data is not None and camera is not None:
        raise SceneError("camera='orbit' makes cameras, and data= has some: leave one of the two out")


def _exists(path: Any) -> bool:
    try:
        return Path(path).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # a name that no file can have, or the home of nobody
        return False


@dataclass(frozen=True)
class Source:
    """What was handed over as a scene."""

    splat: Path
    name: str
    run: Path | None = None
    """Folder of the splatfacto run that trained it."""
    cameras: Path | None = None
    """Folder with the cameras that came with it."""


def source_of(path: Path) -> Source:
    """The splat in a run folder, config.yml or .ckpt, in Inria's output folder, or the file itself.

    Args:
        path: exists.

    Raises:
        SceneError: there is no splat in it; the sentence says what it is instead, where that is plain.
    """
    if path.is_file() and path.suffix == ".ckpt":
        return _of_run(path, path.resolve().parent.parent)
    if path.is_file() and path.name != "config.yml":
        if path.suffix.lower() == ".json" and path.name != "meta.json":
            raise SceneError(f"{path} holds no splat: if these are its cameras, pass the splat with data={path}")
        return Source(path, path.stem)
    run = path.resolve() if path.is_dir() else path.resolve().parent
    if run.parent.name == "pgsd-weather":
        raise SceneError(
            f"{path} is a run of pgsd-weather, which holds a weather and no scene: ns-viewer and ns-render show it; "
            "for another weather pass the scene that it was trained on"
        )
    checkpoints = sorted((run / "nerfstudio_models").glob("step-*.ckpt"))
    if checkpoints:
        return _of_run(checkpoints[-1], run)
    if (splat := newest_splat(run)) is not None:
        return Source(splat, run.name, cameras=run)
    if path.is_dir():
        splats = [file for file in sorted(run.iterdir()) if file.suffix.lower() in SPLAT_SUFFIXES and file.name not in POINTS]
        such = f", such as {splats[0]}" if splats else ""
        if camera_file(path) is not None:
            raise SceneError(
                f"{path} holds cameras, and is no scene: pass a splat that was trained on them{such}, with data={path}; or "
                f"train one (ns-train splatfacto --data {path}) and pass its run"
            )
        if splats:
            raise SceneError(f"{path} is a folder: pass the splat in it{such}, with data= for its cameras")
    raise SceneError(f"{run} is no trained run: expected nerfstudio_models/step-*.ckpt in it, found none")


def _of_run(checkpoint: Path, run: Path) -> Source:
    return Source(checkpoint, run.parent.parent.name if run.parent.name == "splatfacto" else run.name, run=run)
