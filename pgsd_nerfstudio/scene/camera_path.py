"""Camera paths that stay where something was captured: between two training views, around the middle, ahead, or on the spot."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.cameras import Cameras, interpolate, level_axes
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.scene import Scene

TURN = 25.0  # degrees between the two views: enough for parallax, and both views saw what lies between them
DEGREES_PER_SECOND = 3.0  # slow enough that the motion of the particles is seen and not that of the camera
SLOPE = 20.0  # degrees below the horizon: views that look up see sky, views that look straight down see no snow fall

NEAREST = 0.05  # m from the middle of the scene: an orbit must be at least so wide


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
    to_middle = torch.nn.functional.normalize(_looked_at(centers, forward) - centers, dim=1)
    aside = torch.rad2deg(torch.arccos((to_middle * forward).sum(1).clamp(-1.0, 1.0)))
    turns = poses[:, :3, :3]
    turn = torch.rad2deg(rotations.rotmat_geodesic_distance(turns[:, None], turns[None, :]))
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
    turn = float(torch.rad2deg(rotations.rotmat_geodesic_distance(poses[0], poses[1])))
    whole = max(2, start + frames, round(turn / DEGREES_PER_SECOND * fps))
    return interpolate(cameras, first, last, whole)[slice(start, start + frames)]


def orbit_path(scene: Scene, *, frames: int, degrees: float = 360.0) -> Cameras:
    """Cameras on a circle around the middle of the scene, as far away and as high as its training views stand in the median.

    They look at the height that the training views look at; a full circle ends where it began, without showing that view twice.

    Args:
        scene: the scene with its training views.
        frames: number of cameras.
        degrees: by how much the path turns, against the clock as seen from above; negative: with it.

    Raises:
        ValueError: a number is out of its range, or all views stand in the middle of the scene.
    """
    if frames < 1 or not abs(degrees) < float("inf"):
        raise ValueError(f"an orbit has frames >= 1 and a finite number of degrees, got {frames} and {degrees:g}")
    poses = scene.frame.cameras_to_metric(scene.cameras).opengl().double()
    centers, forward = poses[:, :3, 3], -poses[:, :3, 2]
    away = centers[:, :2].norm(dim=1)
    radius, height = float(away.median()), float(centers[:, 2].median())
    if radius < NEAREST:
        raise ValueError(
            f"the training views stand {radius:.2g} m from the middle of the scene: an orbit needs views around it"
        )
    target = _looked_at(centers, forward)
    nearest = int(((away - radius).abs() + (centers[:, 2] - height).abs()).argmin())
    start = torch.atan2(centers[nearest, 1], centers[nearest, 0])
    closed = math.isclose(abs(degrees) % 360.0, 0.0)
    turn = torch.linspace(0.0, math.radians(degrees), frames + closed, dtype=torch.float64)[:frames]
    azimuth = start + turn
    around = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), torch.full_like(azimuth, height)], dim=1)
    return _from_metric(scene, around, target - around, scene.cameras.Ks[nearest])


def dolly_path(scene: Scene, *, frames: int, forward: float = 0.3, view: int | None = None) -> Cameras:
    """Cameras on the line of sight of a training view, straight ahead.

    Args:
        scene: the scene with its training views.
        frames: number of cameras.
        forward: how far they go, as a part of the way to the middle of the scene; negative: backwards.
        view: number of the training view; by default the first of `choose_views`.

    Raises:
        ValueError: there is no such view, or a number is out of its range.
    """
    if frames < 1 or not abs(forward) < 1.0:
        raise ValueError(
            f"a dolly has frames >= 1 and goes less than the whole way to the middle, got {frames} and {forward:g}"
        )
    start = scene.cameras[_view(scene, view)]
    pose = start.opengl()[0]
    way = (scene.frame.origin - pose[:3, 3]).norm()
    at = torch.linspace(0.0, forward, frames)[:, None] * way
    poses = pose.repeat(frames, 1, 1)
    poses[:, :3, 3] = pose[:3, 3] - at * pose[:3, 2]
    return Cameras.from_opengl(poses, start.Ks.repeat(frames, 1, 1), start.width, start.height)


def still_path(scene: Scene, *, frames: int, view: int | None = None) -> Cameras:
    """The same training view again and again: only the weather moves.

    Args:
        scene: the scene with its training views.
        frames: number of cameras.
        view: number of the training view; by default the first of `choose_views`.

    Raises:
        ValueError: there is no such view, or there is no frame.
    """
    if frames < 1:
        raise ValueError(f"a path has frames >= 1, got {frames}")
    return scene.cameras[torch.full((frames,), _view(scene, view))]


def _view(scene: Scene, view: int | None) -> int:
    if view is not None and not 0 <= view < len(scene.cameras):
        raise ValueError(f"the view must lie in 0-{len(scene.cameras) - 1}, the training views of this scene, got {view}")
    return choose_views(scene.cameras, scene.frame)[0] if view is None else view


def _looked_at(centers: Tensor, forward: Tensor) -> Tensor:
    """The metric point [3] over the middle that views at centres [t, 3] along directions [t, 3] look at.

    It is where most lines of sight pass nearest to the vertical through the middle; the ground if none comes near.
    """
    ahead = -(centers[:, :2] * forward[:, :2]).sum(1) / forward[:, :2].square().sum(1).clamp_min(1e-6)
    seen = (centers[:, 2] + ahead * forward[:, 2])[ahead > 0]
    return torch.tensor([0.0, 0.0, float(seen.median()) if len(seen) else 0.0], dtype=centers.dtype, device=centers.device)


def _from_metric(scene: Scene, centers: Tensor, forward: Tensor, K: Tensor) -> Cameras:
    """Cameras at metric places [t, 3] that look along metric directions [t, 3] with up above them, in scene units."""
    turn = level_axes(-torch.nn.functional.normalize(forward, dim=1))
    frame, size = scene.frame, scene.cameras
    poses = torch.cat([frame.rotation.T.to(turn) @ turn, frame.to_scene(centers)[:, :, None]], dim=2).float()
    return Cameras.from_opengl(poses, K.repeat(len(poses), 1, 1), size.width, size.height)
