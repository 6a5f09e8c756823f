"""A streak against the average of many short exposures."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.rendering.ewa import covariances
from pgsd_nerfstudio.rendering.motion_blur import dimming, stretched_covariances
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.reference import project_reference, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

SMOOTH = RasterConfig(blur=0.05, min_alpha=1e-9, radius_sigmas=8.0)
"""Nothing cut off, so that sums over the pixels are integrals."""


def moments(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sum, centroid [2] and central second moments [2, 2] of a picture [h, w]."""
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in image.shape), indexing="ij")
    places, total = torch.stack([x, y], dim=-1).double(), image.sum()
    centroid = (image[..., None] * places).sum(dim=(0, 1)) / total
    off = places - centroid
    return total, centroid, (image[..., None, None] * off[..., :, None] * off[..., None, :]).sum(dim=(0, 1)) / total


@pytest.mark.parametrize("way", [(1.2, 0.0, 0.0), (0.5, -0.9, 0.0), (0.02, 0.03, 0.1)])
def test_a_streak_has_the_sum_the_place_and_the_second_moment_of_the_exposure(way):
    """64 short exposures at even steps along the way; faint, so that alphas add up, and from afar, so that all look alike."""
    K = torch.tensor([[[6e4, 0.0, 24.0], [0.0, 6e4, 24.0], [0.0, 0.0, 1.0]]])
    camera = Cameras(torch.eye(4)[None], K, 48, 48)
    quats, scales = torch.tensor([[0.9, 0.1, -0.3, 0.2]]), torch.tensor([[0.12, 0.2, 0.3]])
    still = Gaussians(torch.tensor([[0.1, -0.1, 6000.0]]), quats, scales, torch.tensor([0.01]), torch.ones(1, 3)).to(
        torch.float64
    )
    displacement = torch.tensor([way], dtype=torch.float64)
    exposures = [
        render_reference(camera, replace(still, means=still.means + ((k + 0.5) / 64 - 0.5) * displacement), config=SMOOTH)
        for k in range(64)
    ]
    expected = moments(torch.stack([clip.accumulation[0] for clip in exposures]).mean(dim=0))
    found = moments(render_reference(camera, replace(still, displacements=displacement), config=SMOOTH).accumulation[0])
    assert found[0].item() == pytest.approx(expected[0].item(), rel=1e-3)
    assert torch.allclose(found[1], expected[1], atol=1e-3)
    assert torch.allclose(found[2], expected[2], rtol=1e-3, atol=2e-3)


def test_dimming_is_the_root_of_the_ratio_of_determinants_on_the_image_plane():
    cameras, gaussians = random_cameras(1, 64, 48), random_gaussians(200).to(torch.float64)
    moving = replace(gaussians, displacements=0.7 * torch.randn(200, 3, dtype=torch.float64))
    lens = cameras.viewmats[0].double(), cameras.Ks[0].double(), 64, 48, RasterConfig()
    sharp, smeared = project_reference(gaussians, *lens), project_reference(moving, *lens)
    drawn = (smeared.radii > 0).all(dim=1)
    ratio = (torch.linalg.det(sharp.covariances) / torch.linalg.det(smeared.covariances)).sqrt()
    assert drawn.sum() > 50
    assert torch.allclose((smeared.opacities / gaussians.opacities)[drawn], ratio[drawn], rtol=1e-9)


def test_what_does_not_move_is_drawn_as_if_it_could_not():
    cameras, gaussians = random_cameras(1, 32, 24), random_gaussians(80)
    resting = replace(gaussians, displacements=torch.zeros(80, 3))
    for found, expected in zip(render_reference(cameras, resting), render_reference(cameras, gaussians), strict=True):
        assert torch.equal(found, expected)
    assert torch.equal(stretched_covariances(resting), covariances(gaussians))


def test_a_direction_and_its_opposite_leave_the_same_streak():
    gaussians = replace(random_gaussians(80), displacements=0.5 * torch.randn(80, 3))
    back = replace(gaussians, displacements=-gaussians.displacements)
    cameras = random_cameras(1, 32, 24)
    assert torch.allclose(render_reference(cameras, gaussians).rgb, render_reference(cameras, back).rgb, atol=1e-12)


def test_dimming_of_a_long_thin_streak_keeps_its_digits_in_single_precision():
    """A footprint of half a pixel that moves by a thousand: det S' from its entries would be noise."""
    length = 1000.0
    found = dimming(0.25 * torch.eye(2)[None], length * torch.tensor([[math.cos(0.7), math.sin(0.7)]]))
    assert found.item() == pytest.approx(1 / math.sqrt(1 + length**2 / 12 / 0.25), rel=1e-6)
