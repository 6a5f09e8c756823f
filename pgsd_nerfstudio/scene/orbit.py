"""Cameras for a splat that came without any: an orbit around its middle, at the height of a person's eyes."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras, level_axes
from pgsd_nerfstudio.scene.frame import ground_level, rotation_to_z
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.level import middle_of

VIEWS = 24
WIDTH, HEIGHT = 960, 720
ANGLE_OF_VIEW = math.radians(60)  # across the width
ELEVATION = math.radians(30)  # from the ground at the middle up to the camera: 1.5 m high, 2.6 m away
TARGET = 0.25  # of the camera's height above the ground, at the middle: what the cameras look at
FREE = 0.1  # of the radius: around a camera there must be hardly anything so near
SMALLER = 0.85


def orbit(gaussians: Gaussians, up: Float64[Tensor, "3"]) -> Cameras:
    """Views of the middle of a splat from all sides.

    The orbit is as large as the splat's median extent, or smaller where cameras would stand inside of things.

    Args:
        gaussians: the frozen scene.
        up: direction of length 1 in scene axes.
    """
    middle, radius = middle_of(gaussians)
    axes = rotation_to_z(up)  # scene to level axes
    local = (gaussians.means.double().cpu() - middle) @ axes.T
    solid = local[gaussians.opacities.cpu() > 0.5]
    ground, _ = ground_level(gaussians, up, middle, radius, middle @ up + radius)
    floor = float(ground - middle @ up)  # height of the ground over the middle
    best, fewest = radius, len(solid) + 1
    for _ in range(8):
        centers = _ring(radius, floor)
        near = min(int((torch.cdist(centers, solid) < FREE * radius).sum()), fewest)
        if near < 0.7 * fewest:
            best, fewest = radius, near
        radius *= SMALLER
    centers = _ring(best, floor)
    target = torch.tensor([0.0, 0.0, floor + TARGET * best * math.tan(ELEVATION)], dtype=torch.float64)
    back = torch.nn.functional.normalize(centers - target, dim=1)
    c2w = torch.cat([axes.T @ level_axes(back), (centers @ axes + middle)[:, :, None]], dim=2)
    focal = WIDTH / 2 / math.tan(ANGLE_OF_VIEW / 2)
    K = torch.tensor([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Cameras.from_opengl(c2w.float(), K.repeat(VIEWS, 1, 1), WIDTH, HEIGHT)


def _ring(radius: float, floor: float) -> Float64[Tensor, "t 3"]:
    """Centres of the cameras around the middle, in level axes."""
    angle = 2 * math.pi * torch.arange(VIEWS, dtype=torch.float64) / VIEWS
    height = torch.full_like(angle, floor + radius * math.tan(ELEVATION))
    return torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=1)
