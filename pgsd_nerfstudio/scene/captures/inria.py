"""Cameras of Inria's trainer: the cameras.json in its output folder (utils/camera_utils.py of gaussian-splatting).

Each camera has its centre, its camera-to-world rotation in OpenCV's axes, and focal lengths in pixels of the whole photograph;
the principal point is the middle, as that trainer takes it. Poses are in COLMAP's world, as is the splat beside them.
"""

from __future__ import annotations

import ast
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from pgsd_nerfstudio.scene.captures.capture import Capture, checked_poses
from pgsd_nerfstudio.scene.captures.lenses import lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, find_photographs
from pgsd_nerfstudio.scene.captures.placements import colmap_placements
from pgsd_nerfstudio.scene.errors import SceneError

NEEDED = ("position", "rotation", "width", "height", "fx", "fy")


def newest_splat(folder: Path) -> Path | None:
    """The splat with the most iterations in an output folder of Inria's trainer; None if there is none."""
    found = [path for path in (folder / "point_cloud").glob("iteration_*/point_cloud.ply") if _iteration(path) >= 0]
    return max(found, key=_iteration, default=None)


def _iteration(splat: Path) -> int:
    number = splat.parent.name.removeprefix("iteration_")
    return int(number) if number.isdecimal() else -1


def is_camera_list(content: Any) -> bool:
    """Whether the content of a JSON file is such a list of cameras."""
    return isinstance(content, list) and bool(content) and isinstance(content[0], dict) and "position" in content[0]


def read_camera_list(path: Path, content: Any) -> Capture:
    """Cameras sorted by the names of their photographs.

    Args:
        path: the cameras.json.
        content: what it holds.

    Raises:
        SceneError: an entry is no camera; the sentence names it.
    """
    cameras = [camera if isinstance(camera, dict) else {} for camera in content]
    cameras = sorted(cameras, key=lambda camera: PurePosixPath(_name(camera)))
    matrices, lenses = torch.eye(4, dtype=torch.float64).repeat(len(cameras), 1, 1), []
    for matrix, camera in zip(matrices, cameras, strict=True):
        whose = f"{path}: the camera of {_name(camera)}"
        missing = [name for name in NEEDED if name not in camera]
        if missing:
            raise SceneError(f"{whose} lacks {', '.join(missing)}; cameras.json of Inria's trainer names them")
        try:
            matrix[:3, :3] = torch.tensor(camera["rotation"], dtype=torch.float64).reshape(3, 3)
            matrix[:3, 3] = torch.tensor(camera["position"], dtype=torch.float64).reshape(3)
            width, height, fx, fy = (float(camera[name]) for name in ("width", "height", "fx", "fy"))
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            reason = str(error).splitlines()[0]
            raise SceneError(f"{whose} needs 3 numbers of position, 3x3 of rotation, and sizes in pixels ({reason})") from error
        middle = {"cx": width / 2, "cy": height / 2}
        lenses.append(lens_of("PINHOLE", width, height, {"fx": fx, "fy": fy, **middle}, whose))
    matrices[:, :3, 1:3] *= -1  # OpenCV's axes to OpenGL's
    names = [_name(camera) for camera in cameras]
    poses = checked_poses(matrices, names, path)
    photographs = zip(find_photographs(names, _folders(path.parent)), lenses, strict=True)
    return Capture(poses, tuple(Photograph(place, lens) for place, lens in photographs), colmap_placements(poses))


def _name(camera: dict[str, Any]) -> str:
    name = camera.get("img_name")
    return name if isinstance(name, str) and name and "\0" not in name else f"camera {str(camera.get('id', '?'))[:20]}"


def _folders(output: Path) -> list[Path]:
    """Where the photographs may lie: cfg_args, which the trainer writes, names the folder of its data."""
    try:
        tree = ast.parse((output / "cfg_args").read_text("utf-8"), mode="eval").body
        words = tree.keywords if isinstance(tree, ast.Call) else []
        said = {word.arg: word.value.value for word in words if isinstance(word.value, ast.Constant)}
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError):
        said = {}
    source, images = str(said.get("source_path") or ""), str(said.get("images") or "images")
    beside = [output / images, output / "images", output]
    if not source or "\0" in source + images:
        return beside
    return [Path(source) / images, Path(source), output.parent / Path(source).name / images, *beside]
