"""nerfstudio's camera paths as files: what its viewer draws, loads and hands to ns-render.

A path holds one camera for each picture (`camera_path`), and the few that it was drawn through (`keyframes`), which only the
viewer reads. Poses lead from camera to world with OpenGL axes; `fov` is the angle of view across the height in degrees.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.capture import checked_poses
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.storage import atomic_write

MOST_PIXELS = 16384.0  # of a side: more than any video has
KEYFRAMES = 9  # that a path is written with: as many as the viewer shows well
HOW = "draw it anew in ns-viewer or write one with pgsd path"


@dataclass(frozen=True)
class CameraPath:
    """A camera path as it was read."""

    cameras: Cameras
    """One for each picture, in scene units."""
    times: tuple[float | None, ...]
    """render_time of each picture, as `scene.path_times` takes them."""
    seconds: float
    """Length of the video."""


def write_camera_path(path: Path, cameras: Cameras, fps: float) -> None:
    """Write a path along which the whole weather passes, from its beginning with the first picture to its end with the last.

    Args:
        path: of the file; its folder is made where it is missing.
        cameras: one for each picture; the principal point is taken to be the middle, since the format has none.
        fps: pictures per second.

    Raises:
        OSError: it could not be written.
    """
    count, seconds = len(cameras), len(cameras) / fps
    times = [index / max(1, count - 1) for index in range(count)]
    fovs = [math.degrees(2 * math.atan(cameras.height / (2 * float(K[1, 1])))) for K in cameras.Ks]
    poses = [pose.flatten().tolist() for pose in cameras.opengl()]
    aspect = cameras.width / cameras.height
    frames = [
        {"camera_to_world": pose, "fov": fov, "aspect": aspect, "render_time": time}
        for pose, fov, time in zip(poses, fovs, times, strict=True)
    ]
    drawn = np.unique(np.linspace(0, count - 1, min(count, KEYFRAMES)).round().astype(int)).tolist()
    step = seconds / max(1, len(drawn) - 1)
    timed = {"override_time_enabled": True, "override_transition_enabled": False, "override_transition_sec": None}
    keyframes = [
        {"matrix": poses[index], "fov": fovs[index], "aspect": aspect, "render_time": times[index], **timed} for index in drawn
    ]
    whole = {
        "default_fov": fovs[0],
        "default_time": 0.0,
        "default_transition_sec": step,
        "keyframes": keyframes,
        "camera_type": "perspective",
        "render_height": cameras.height,
        "render_width": cameras.width,
        "fps": fps,
        "seconds": seconds,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": frames,
    }
    with atomic_write(path) as beside:
        beside.write_text(json.dumps(whole) + "\n")


def read_camera_path(path: Path) -> CameraPath:
    """Read a path, of the viewer or of another program that writes its format.

    Where no picture has a render_time and keyframes do, those of the pictures lie between them.

    Args:
        path: of the file.

    Raises:
        SceneError: it cannot be read, or what a path needs is missing in it.
    """
    try:
        whole = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path} cannot be read as a camera path ({error}): {HOW}") from error
    frames = whole.get("camera_path") if isinstance(whole, Mapping) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, Mapping) for frame in frames):
        raise SceneError(f"{path} holds no camera path: expected a list camera_path with at least one camera; {HOW}")
    kind = str(whole.get("camera_type", "perspective")).lower()
    if kind != "perspective":
        raise SceneError(
            f"{path} is of cameras of the type {kind}, the weather is rendered through perspective ones only: {HOW}"
        )
    width, height = (int(_number(path, whole, side, least=1.0, most=MOST_PIXELS)) for side in ("render_width", "render_height"))
    stored = torch.tensor([_pose(path, frame) for frame in frames], dtype=torch.float64).reshape(-1, 4, 4)
    poses = checked_poses(stored, [f"frame {index}" for index in range(len(frames))], path)
    focal = torch.tensor([height / 2 / math.tan(math.radians(_number(path, frame, "fov", most=179.0)) / 2) for frame in frames])
    Ks = torch.zeros(len(frames), 3, 3)
    Ks[:, 0, 0] = Ks[:, 1, 1] = focal
    Ks[:, 0, 2], Ks[:, 1, 2], Ks[:, 2, 2] = width / 2, height / 2, 1.0
    times = tuple(_time(path, frame) for frame in frames)
    if all(time is None for time in times):
        times = _between_keyframes(path, whole, len(frames)) or times
    return CameraPath(Cameras.from_opengl(poses.float(), Ks, width, height), times, _number(path, whole, "seconds"))


def _number(path: Path, values: Mapping[str, Any], name: str, least: float = 0.0, most: float = math.inf) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not (least <= value < most and value > 0):
        raise SceneError(
            f"{path}: {name} must be a positive number{f' below {most:g}' if most < math.inf else ''}, got {value!r}; {HOW}"
        )
    return float(value)


def _pose(path: Path, frame: Mapping[str, Any]) -> list[float]:
    try:
        pose = np.asarray(frame["camera_to_world"], dtype=np.float64).reshape(16)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: each camera needs a camera_to_world of 4x4 numbers ({error!r}); {HOW}") from error
    return pose.tolist()


def _time(path: Path, frame: Mapping[str, Any]) -> float | None:
    time = frame.get("render_time")
    if time is not None and (isinstance(time, bool) or not isinstance(time, int | float)):
        raise SceneError(f"{path}: render_time must be a number, got {time!r}; {HOW}")
    return None if time is None else float(time)


def _between_keyframes(path: Path, whole: Mapping[str, Any], count: int) -> tuple[float, ...] | None:
    """Times of all pictures, linearly between those of the keyframes, which the path reaches one transition after the other."""
    keyframes = whole.get("keyframes")
    if not isinstance(keyframes, list) or len(keyframes) < 2 or not all(isinstance(one, Mapping) for one in keyframes):
        return None
    times = [_time(path, one) for one in keyframes]
    known: Sequence[float] = [time for time in times if time is not None]
    if len(known) < len(times):
        return None
    stops = [*zip(keyframes[1:], known[1:], strict=True), *([(keyframes[0], known[0])] if whole.get("is_cycle") else [])]
    reached, way = [0.0], [known[0]]
    for keyframe, time in stops:
        own = keyframe.get("override_transition_sec") if keyframe.get("override_transition_enabled") else None
        step = own if own is not None else whole.get("default_transition_sec")
        reached.append(reached[-1] + (float(step) if isinstance(step, int | float) and step > 0 else 1.0))
        way.append(time)
    # The viewer's pictures lie at i / count of the way, so that a circle closes.
    return tuple(np.interp(np.arange(count) / count * reached[-1], reached, way).tolist())
