"""Cameras of a transforms.json: nerfstudio's, instant-ngp's and Blender's, and what ns-process-data makes of Polycam, Record3D,
Metashape and RealityScan.

Numbers of the whole file take precedence over those of a frame, and frames are sorted by file name, as in nerfstudio's
nerfstudio_dataparser.py; where it would take every camera for the first frame's kind, each frame's own model counts here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from pgsd_nerfstudio.scene.captures.capture import Capture, checked_poses
from pgsd_nerfstudio.scene.captures.lenses import Lens, lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, find_photographs, is_there
from pgsd_nerfstudio.scene.captures.placements import affine, applied_transform, saved_placements
from pgsd_nerfstudio.scene.errors import SceneError

DISTORTION: tuple[str, ...] = ("k1", "k2", "k3", "k4", "p1", "p2")
"""In the order of distortion_params."""
ALIASES = {"PERSPECTIVE": "OPENCV"}
UNWRITTEN = ("FULL_OPENCV", "THIN_PRISM_FISHEYE", "FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM")
"""Models for whose parameters a transforms.json has no names."""
MOST_BYTES = 500_000_000


def read_json(path: Path) -> Any:
    """Content of a JSON file.

    Raises:
        SceneError: the file cannot be read or is no JSON.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise SceneError(f"{path} is longer than {MOST_BYTES:,} bytes, which no list of cameras is")
        return json.loads(path.read_text("utf-8-sig"))
    except RecursionError as error:
        raise SceneError(f"{path} is nested too deeply for a list of cameras") from error
    except (ValueError, OSError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{path} cannot be read as JSON ({error}): write it again with ns-process-data") from error


def read_transforms(path: Path, meta: Any) -> Capture:
    """Views in the coordinates of the file's own poses.

    Args:
        path: the transforms.json.
        meta: its content.

    Raises:
        SceneError: it has no frames, or one of them cannot be a camera; the sentence names it.
    """
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f'{path} has no cameras: expected a list "frames" with at least one pose, as ns-process-data writes')
    frames = sorted(frames, key=lambda frame: Path(_name(frame)))
    names = [_name(frame) for frame in frames]
    folders = [path.parent, path.parent / "images"]
    paths = find_photographs(names, folders)
    masked = [str(frame["mask_path"]) for frame in frames if frame.get("mask_path")]
    masks = iter(find_photographs(masked, [path.parent]))
    matrices = torch.stack([_matrix(path, frame) for frame in frames])
    photographs = []
    for frame, photograph in zip(frames, paths, strict=True):
        mask = next(masks) if frame.get("mask_path") else None
        photographs.append(Photograph(photograph, _lens(path, meta, frame, photograph), mask))
    poses = checked_poses(matrices, names, path)
    applied = applied_transform(meta, path)
    return Capture(poses, tuple(photographs), saved_placements(poses, *applied), *applied)


def _name(frame: Mapping[str, Any]) -> str:
    name = frame.get("file_path")
    return name if isinstance(name, str) and name and "\0" not in name else "a frame without file_path"


def _matrix(path: Path, frame: Mapping[str, Any]) -> torch.Tensor:
    try:
        return affine(frame["transform_matrix"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        found = "there is none" if isinstance(error, KeyError) else str(error)
        raise SceneError(f"{path}: {_name(frame)} needs a transform_matrix of 4x4 numbers: {found}") from error


def _lens(path: Path, meta: Mapping[str, Any], frame: Mapping[str, Any], photograph: Path) -> Lens:
    whose = f"{path}: the lens of {_name(frame)}"

    def number(name: str) -> float | None:
        value = meta.get(name, frame.get(name))
        return None if value is None else _number(value, name, whose)

    width, height = number("w"), number("h")
    if width is None or height is None:
        size = _size(photograph)
        if size is None:
            raise SceneError(f"{whose} needs w and h in pixels: the file has none, and there is no photograph at {photograph}")
        width, height = (size[0] if width is None else width), (size[1] if height is None else height)
    focal = {
        name: _focal(number(f"fl_{axis}"), number(f"{axis}_fov"), number(f"camera_angle_{axis}"), side)
        for name, axis, side in (("fx", "x", width), ("fy", "y", height))
    }
    known = next((value for value in focal.values() if value is not None), None)
    if known is None:
        raise SceneError(f"{whose} needs a focal length: fl_x in pixels, or camera_angle_x in radians")
    cx, cy = number("cx"), number("cy")
    values = {name: known if value is None else value for name, value in focal.items()}
    values |= {"cx": width / 2 if cx is None else cx, "cy": height / 2 if cy is None else cy}
    # A frame with a model of its own has a lens of its own.
    own = frame if any(name in frame for name in ("camera_model", "is_fisheye")) else {}
    return lens_of(_model(meta, frame, whose), width, height, {**values, **_distortion(meta, frame, own, whose)}, whose)


def _focal(pixels: float | None, degrees: float | None, radians: float | None, side: float) -> float | None:
    """Focal length in pixels, given or from the angle of view."""
    angle = radians if degrees is None else math.radians(degrees)
    if pixels is not None or angle is None:
        return pixels
    return 0.5 * side / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan


def _model(meta: Mapping[str, Any], frame: Mapping[str, Any], whose: str) -> str:
    """COLMAP's name of a frame's lens."""
    for names in (frame, meta):
        model = names.get("camera_model")
        if model is not None:
            if not isinstance(model, str):
                raise SceneError(f"{whose} needs a camera_model such as OPENCV, found {str(model)[:40]!r}")
            if model in UNWRITTEN:
                raise SceneError(f"{whose} is of the model {model}, which no transforms.json describes: pass COLMAP's folder")
            return ALIASES.get(model, model)
        if names.get("is_fisheye"):
            return "OPENCV_FISHEYE"
    return "OPENCV"


def _distortion(meta: Mapping[str, Any], frame: Mapping[str, Any], own: Mapping[str, Any], whose: str) -> dict[str, float]:
    for names in (own, meta, frame):
        listed = names.get("distortion_params")
        if isinstance(listed, list):
            return {name: _number(value, name, whose) for name, value in zip(DISTORTION, listed, strict=False)}
        if any(name in names for name in DISTORTION):
            return {name: _number(names[name], name, whose) for name in DISTORTION if names.get(name) is not None}
    return {}


def _number(value: Any, name: str, whose: str) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SceneError(f"{whose} needs a number for {name}, found {str(value)[:40]!r}") from error


def _size(photograph: Path) -> tuple[int, int] | None:
    """Width and height of a photograph in pixels; None if it is missing or unreadable."""
    if not is_there(photograph):
        return None
    try:
        with Image.open(photograph) as picture:
            return picture.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
