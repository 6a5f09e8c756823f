"""Random scenes on which `pgsd verify`, `pgsd bench` and the tests compare rasterizers."""

from __future__ import annotations

import torch
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians


def random_cameras(frames: int, width: int, height: int, seed: int = 0) -> Cameras:
    """Cameras near the origin that look along z, each slightly rotated, with unequal focal lengths and an off-centre axis.

    Args:
        frames: number of cameras.
        width: of the image in pixels.
        height: of the image in pixels.
        seed: of the random poses.
    """
    generator = torch.Generator().manual_seed(seed)
    turn = 0.15 * torch.randn(frames, 3, generator=generator)
    skew = torch.zeros(frames, 3, 3)
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -turn[:, 2], turn[:, 1], -turn[:, 0]
    viewmats = torch.eye(4).repeat(frames, 1, 1)
    viewmats[:, :3, :3] = torch.linalg.matrix_exp(skew - skew.mT)
    viewmats[:, :3, 3] = 0.2 * torch.randn(frames, 3, generator=generator)
    K = torch.tensor([[0.9 * width, 0.0, 0.48 * width], [0.0, 1.1 * width, 0.53 * height], [0.0, 0.0, 1.0]])
    return Cameras(viewmats, K.repeat(frames, 1, 1), width, height)


def random_gaussians(
    n: int, seed: int = 0, *, degree: int | None = None, size: float = 0.15, opacity: float = 1.0
) -> Gaussians:
    """Gaussians in front of, beside and behind the cameras, from points to splats that cover the image.

    Args:
        n: number of Gaussians.
        seed: of all their random numbers.
        degree: of spherical harmonics; None gives plain RGB.
        size: median scale in scene units.
        opacity: largest opacity, which the first tenth of the Gaussians has.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(n, 3) * torch.tensor([1.2, 1.0, 1.5]) + torch.tensor([0.0, 0.0, 3.0])
    scales = size * torch.exp(0.8 * normal(n, 3))
    opacities = opacity * torch.rand(n, generator=generator)
    opacities[: n // 10] = 1.0 * opacity
    colors = torch.rand(n, 3, generator=generator) if degree is None else 0.3 * normal(n, (degree + 1) ** 2, 3)
    return Gaussians(means, normal(n, 4), scales, opacities, colors)


def relative_error(found: Tensor, expected: Tensor) -> float:
    """L2 norm of the difference over that of the expected tensor."""
    return ((found.double() - expected).norm() / expected.norm()).item()
