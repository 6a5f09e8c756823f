"""A slow camera path from one training view towards another, so that the camera shows only what was captured."""

from __future__ import annotations

import roma
import torch

from pgsd_nerfstudio.scene.cameras import Cameras, interpolate
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.scene import Scene

TURN = 25.0  # degrees between the two views: enough for parallax, and both views saw what lies between them
DEGREES_PER_SECOND = 3.0  # slow enough that the motion of the particles is seen and not that of the camera
SLOPE = 20.0  # degrees below the horizon: views that look up see sky, views that look straight down see no snow fall


def choose_views(cameras: Cameras, frame: Frame) -> tuple[int, int]:
    """Choose two training views about 25 degrees apart that look at the middle of the scene and slightly down.

    Args:
        cameras: the training views, in scene units; at least one.
        frame: the metric frame of the scene.

    Returns:
        Indices of the first and the last view; 0 and 0 if there is only one.
    """
    if len(cameras) == 1:
        return 0, 0
    poses = cameras.opengl()
    centers = frame.to_metric(poses[:, :3, 3])
    forward = torch.nn.functional.normalize(-frame.vectors_to_metric(poses[:, :3, 2]), dim=1)
    aside = torch.rad2deg(torch.arccos((torch.nn.functional.normalize(-centers, dim=1) * forward).sum(1).clamp(-1.0, 1.0)))
    rotations = poses[:, :3, :3]
    turn = torch.rad2deg(roma.rotmat_geodesic_distance(rotations[:, None], rotations[None, :]))
    slope = (torch.rad2deg(torch.arcsin(-forward[:, 2].clamp(-1.0, 1.0))) - SLOPE).abs()
    cost = (turn - TURN).abs() + (aside + slope)[:, None] + (aside + slope)[None, :]
    cost.fill_diagonal_(float("inf"))
    best = int(cost.argmin())
    return best // len(cameras), best % len(cameras)


def slow_path(scene: Scene, *, frames: int, fps: float = 25.0, start: int = 0, views: tuple[int, int] | None = None) -> Cameras:
    """Cameras of some frames of a slow path from one training view to another.

    The path spans `start + frames` frames, or more where the camera would turn by more than 3 degrees in a second.

    Args:
        scene: the scene with its training views.
        frames: number of frames that are asked for.
        fps: frames per second.
        start: first frame that is asked for.
        views: numbers of the views that the path leads from and to; by default `choose_views`.

    Raises:
        ValueError: there is no such view, or a number is out of its range.
    """
    cameras = scene.cameras
    if frames < 1 or start < 0 or not 0 < fps < float("inf"):
        raise ValueError(f"a path has frames >= 1, start >= 0 and fps > 0, got {frames}, {start} and {fps:g}")
    first, last = views or choose_views(cameras, scene.frame)
    if not (0 <= first < len(cameras) and 0 <= last < len(cameras)):
        raise ValueError(f"views must lie in 0-{len(cameras) - 1}, the training views of this scene, got {first} {last}")
    poses = cameras.opengl()[[first, last], :3, :3]
    turn = float(torch.rad2deg(roma.rotmat_geodesic_distance(poses[0], poses[1])))
    whole = max(2, start + frames, round(turn / DEGREES_PER_SECOND * fps))
    return interpolate(cameras, first, last, whole)[slice(start, start + frames)]
