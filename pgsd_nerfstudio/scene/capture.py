"""Cameras and photographs of a capture from nerfstudio's transforms.json.

Rasterizers of Gaussians know only pinhole cameras, so lens distortion (k1, k2, k3, p1, p2) is ignored, and fisheye and
panoramic captures are refused.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.scene import SceneError

PINHOLES = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE"}


def read_capture(data: Path) -> tuple[Cameras, tuple[Path, ...]]:
    """Cameras and photographs of a capture, both sorted by file name as nerfstudio sorts them.

    A camera stays in the list if its photograph is missing on disk. If the image sizes differ, all cameras take the most
    frequent size.

    Args:
        data: a transforms.json, or the folder that holds it.

    Returns:
        The cameras in the coordinates of the file's own poses, and the paths of the photographs, one for each camera; no paths
        if a frame names none.

    Raises:
        SceneError: the file is missing, is no transforms.json, has no frames, or its cameras are no pinholes.
    """
    path, meta = _meta(data)
    frames = sorted(meta["frames"], key=lambda frame: str(frame.get("file_path", "")))
    model = meta.get("camera_model", frames[0].get("camera_model", "OPENCV"))
    if model not in PINHOLES:
        raise SceneError(f"{path} was taken with {model} cameras; undistort it first; known: {', '.join(sorted(PINHOLES))}")
    poses = torch.stack([_pose(path, frame) for frame in frames])
    read = [_intrinsics(path, meta, frame) for frame in frames]
    (width, height), _ = Counter((w, h) for _, w, h in read).most_common(1)[0]
    Ks = torch.stack([_resized(K, w, h, width, height) for K, w, h in read])
    images = tuple(path.parent / frame["file_path"] for frame in frames if "file_path" in frame)
    return Cameras.from_opengl(poses, Ks, width, height), images if len(images) == len(frames) else ()


def in_run(cameras: Cameras, data: Path, dataparser_transforms: Path) -> Cameras:
    """Cameras in the coordinates of a run: x_run = scale * (T @ inv(applied_transform)) x_saved.

    Args:
        cameras: the cameras that `read_capture(data)` returned.
        data: the transforms.json that holds applied_transform, or its folder.
        dataparser_transforms: the run's dataparser_transforms.json, which holds T (3x4) and the scale.

    Raises:
        SceneError: dataparser_transforms.json, which the run writes, is missing or damaged.
    """
    try:
        stored = json.loads(dataparser_transforms.read_text("utf-8"))
        original_to_run, scale = _affine(stored["transform"]), float(stored["scale"])
    except FileNotFoundError as error:
        raise SceneError(f"{dataparser_transforms} is missing; --data needs it beside the run's config.yml") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{dataparser_transforms} must hold a 3x4 transform and a scale, found {error!r}") from error
    _, meta = _meta(data)
    saved = _affine(meta.get("applied_transform", torch.eye(4)[:3].tolist()))
    move = original_to_run @ torch.linalg.inv(saved)
    c2w = move @ cameras.opengl().double()
    c2w[:, :3, 3] *= scale / float(meta.get("applied_scale", 1.0))
    return Cameras.from_opengl(c2w.float(), cameras.Ks, cameras.width, cameras.height)


def _meta(data: Path) -> tuple[Path, dict[str, Any]]:
    path = data / "transforms.json" if data.is_dir() else data
    if not path.is_file():
        raise SceneError(f"no cameras at {path}: expected a transforms.json as ns-process-data writes it")
    try:
        meta = json.loads(path.read_text("utf-8"))
    except (ValueError, OSError) as error:
        raise SceneError(f"{path} cannot be read as JSON ({error}): write it again with ns-process-data") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f'{path} has no cameras: expected a list "frames" with at least one pose, as ns-process-data writes')
    return path, meta


def _pose(path: Path, frame: Mapping[str, Any]) -> Float[Tensor, "4 4"]:
    try:
        pose = _affine(frame["transform_matrix"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SceneError(f"{path}: {frame.get('file_path', 'a frame')} needs a 4x4 transform_matrix ({error!r})") from error
    if not torch.isfinite(pose).all():
        raise SceneError(f"{path}: the transform_matrix of {frame.get('file_path', 'a frame')} holds a NaN or infinity")
    return pose.float()


def _intrinsics(path: Path, meta: Mapping[str, Any], frame: Mapping[str, Any]) -> tuple[Float[Tensor, "3 3"], int, int]:
    """Intrinsics of one frame; values of the whole capture take precedence, as in nerfstudio."""
    values = {name: meta.get(name, frame.get(name)) for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    bad = [
        name for name, value in values.items() if not isinstance(value, int | float) or not math.isfinite(value) or value <= 0
    ]
    if bad:
        raise SceneError(f"{path}: {', '.join(bad)} must be positive pixel numbers, for the whole file or in every frame")
    fl_x, fl_y, cx, cy, w, h = (float(value) for value in values.values())  # type: ignore[arg-type]
    return torch.tensor([[fl_x, 0.0, cx], [0.0, fl_y, cy], [0.0, 0.0, 1.0]]), int(w), int(h)


def _resized(K: Float[Tensor, "3 3"], w: int, h: int, width: int, height: int) -> Float[Tensor, "3 3"]:
    return Cameras(torch.eye(4)[None], K[None], w, h).resized(width, height).Ks[0]


def _affine(rows: Any) -> Float[Tensor, "4 4"]:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3] = torch.tensor(rows, dtype=torch.float64)[:3].reshape(3, 4)
    return matrix
