"""Cameras that walk around a thing, as people photograph it."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras


def look_at(eyes: Float[Tensor, "t 3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "t 4 4"]:
    """World to camera, OpenCV axes, without roll."""
    forward = torch.nn.functional.normalize(target - eyes, dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=1)
    c2w = torch.eye(4).repeat(len(eyes), 1, 1)
    c2w[:, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward, eyes], dim=2)
    return torch.linalg.inv(c2w)


def round_of(
    count: int, radius: float, height: float, target: float = 0.5, size: int = 128, arc: float = 2 * math.pi, wave: float = 0.0
) -> Cameras:
    """Cameras on a circle about the z axis that look at `target` on it; 56 degrees wide."""
    angle = torch.arange(count) * arc / count
    heights = height + wave * torch.sin(3 * angle)
    eyes = torch.stack([radius * angle.cos(), radius * angle.sin(), heights], dim=1)
    focal = 0.94 * size
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    viewmats = look_at(eyes, torch.tensor([0.0, 0.0, target]), torch.tensor([0.0, 0.0, 1.0]))
    return Cameras(viewmats, K.repeat(count, 1, 1), size, size)


def pixel_rays(cameras: Cameras) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t h w 3"]]:
    """Centres, and directions through the pixel centres that are 1 long along the optical axis, in float64."""
    v, u = torch.meshgrid(torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
    in_camera = torch.einsum("tij,hwj->thwi", torch.linalg.inv(cameras.Ks.double()), pixels)
    c2w = torch.linalg.inv(cameras.viewmats.double())
    return c2w[:, :3, 3], torch.einsum("tij,thwj->thwi", c2w[:, :3, :3], in_camera)
