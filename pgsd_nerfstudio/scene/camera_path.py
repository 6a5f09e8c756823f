"""Where the preview's camera goes: slowly from one training view towards another, so that it shows only what was captured."""

from __future__ import annotations

import roma
import torch

from pgsd_nerfstudio.scene.cameras import Cameras, interpolate
from pgsd_nerfstudio.scene.frame import Frame

TURN = 25.0  # degrees between the two views: parallax without leaving what both of them saw
DEGREES_PER_SECOND = 3.0  # a calm hand; falling flakes are to be seen, not the camera


def choose_views(cameras: Cameras, frame: Frame) -> tuple[int, int]:
    """Two training views about 25 degrees apart that look at the middle of the scene, as seen from its ground."""
    if len(cameras) == 1:
        return 0, 0
    poses = cameras.opengl()
    centers = frame.to_metric(poses[:, :3, 3])
    forward = torch.nn.functional.normalize(-frame.vectors_to_metric(poses[:, :3, 2]), dim=1)
    aside = torch.rad2deg(torch.arccos((torch.nn.functional.normalize(-centers, dim=1) * forward).sum(1).clamp(-1.0, 1.0)))
    rotations = poses[:, :3, :3]
    turn = torch.rad2deg(roma.rotmat_geodesic_distance(rotations[:, None], rotations[None, :]))
    # Views that look up see sky, views that look straight down see no snow fall: a slope of 20 degrees shows both.
    slope = (torch.rad2deg(torch.arcsin(-forward[:, 2].clamp(-1.0, 1.0))) - 20.0).abs()
    cost = (turn - TURN).abs() + (aside + slope)[:, None] + (aside + slope)[None, :]
    cost.fill_diagonal_(float("inf"))
    best = int(cost.argmin())
    return best // len(cameras), best % len(cameras)


def fly(cameras: Cameras, first: int, last: int, *, start: int, frames: int, fps: float) -> Cameras:
    """Frames start .. start + frames of a slow flight from view `first` to view `last`, where it stays.

    A flight is never faster than its shots need: all frames of one second turn the camera by at most 3 degrees.
    """
    poses = cameras.opengl()[[first, last], :3, :3]
    turn = float(torch.rad2deg(roma.rotmat_geodesic_distance(poses[0], poses[1])))
    whole = max(2, start + frames, round(turn / DEGREES_PER_SECOND * fps))
    return interpolate(cameras, first, last, whole)[slice(start, start + frames)]
