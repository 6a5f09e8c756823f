"""The scene of the rasterizer's figures: a walled yard of any number of flat Gaussians, and flakes in its air."""

from __future__ import annotations

import torch

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

HALF, TOP = 4.0, 3.0  # m: half the side of the yard, height of its walls


def yard(n: int) -> Gaussians:
    """A floor and four walls of flat Gaussians, SH degree 1, metres, z up; the more the smaller, as in real splats."""
    generator = torch.Generator().manual_seed(0)
    side = torch.arange(n) % 8  # four parts floor, one part each wall
    u, v = 2 * torch.rand(2, n, generator=generator) - 1
    along, up = HALF * u, TOP * (v + 1) / 2
    wall = torch.where((side % 2 == 0)[:, None], torch.stack([along, torch.full((n,), HALF), up], -1), 0.0)
    wall = torch.where((side % 2 == 1)[:, None], torch.stack([torch.full((n,), HALF), along, up], -1), wall)
    wall[:, :2] *= torch.where(side % 4 < 2, 1.0, -1.0)[:, None]
    floor = torch.stack([along, HALF * v, torch.zeros(n)], dim=-1)
    means = torch.where((side < 4)[:, None], floor, wall)
    normal = torch.where(side < 4, 2, torch.where(side % 2 == 0, 1, 0))
    size = 0.03 * (80_000 / n) ** 0.5
    scales = size * torch.exp(0.5 * torch.randn(n, 3, generator=generator))
    scales[torch.arange(n), normal] = 0.1 * size
    # Leaves before the walls, so that the frozen scene has depth and flakes fly within it.
    means = means + 0.15 * torch.randn(n, 3, generator=generator) * (side >= 4)[:, None]
    colors = 0.5 * torch.randn(n, 4, 3, generator=generator) * torch.tensor([1.0, 0.1, 0.1, 0.1])[:, None]
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return Gaussians(means, upright.repeat(n, 1), scales, 0.3 + 0.7 * torch.rand(n, generator=generator), colors)


def yard_flakes(n: int) -> Gaussians:
    """Small round Gaussians of many opacities, all over the air of the yard."""
    generator = torch.Generator().manual_seed(1)
    air = (2 * torch.rand(n, 3, generator=generator) - 1) * torch.tensor([HALF, HALF, TOP / 2]) + torch.tensor([0, 0, TOP / 2])
    return Gaussians(
        air,
        torch.randn(n, 4, generator=generator),
        0.003 * torch.exp(0.4 * torch.randn(n, 3, generator=generator)),
        0.2 + 0.7 * torch.rand(n, generator=generator),
        0.8 + 0.2 * torch.rand(n, 3, generator=generator),
    )


def view_into_yard(width: int, height: int) -> Cameras:
    """From eye height at one wall to the other."""
    viewmat = torch.tensor([[[1.0, 0, 0, 0], [0, 0, -1, 1.5], [0, 1, 0, 3.8], [0, 0, 0, 1]]])
    K = torch.tensor([[[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]]])
    return Cameras(viewmat, K, width, height)


def middle(cameras: Cameras, side: int) -> Cameras:
    """The middle of the image at the same scale."""
    Ks = cameras.Ks.clone()
    Ks[:, 0, 2] -= (cameras.width - side) / 2
    Ks[:, 1, 2] -= (cameras.height - side) / 2
    return Cameras(cameras.viewmats, Ks, side, side)
