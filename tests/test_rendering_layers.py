"""Layers in place of the frozen splats: the same frozen picture, nearly the same picture and gradient with what moves in it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.laboratory.rows.rasterizer import leaves, psnr
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.gaussians import Gaussians

SIZE = (90, 70)  # no multiple of the tile


def crowd(n: int = 3000) -> Gaussians:
    """Many small frozen Gaussians, one behind the other."""
    return random_gaussians(n, 1, size=0.08, degree=1)


def rendered(rasterizer: CpuRasterizer, dynamic: Gaussians) -> tuple:
    leaf = leaves(dynamic)
    clip = rasterizer.render(random_cameras(1, *SIZE), leaf)
    generator = torch.Generator().manual_seed(0)
    sum((image * torch.randn(image.shape, generator=generator)).sum() for image in clip).backward()
    return clip, torch.cat([tensor.grad.flatten() for tensor in leaf.tensors.values()])


@pytest.mark.parametrize("layers", [1, 7, 64])
def test_without_anything_that_moves_the_picture_is_exact(layers):
    cameras, frozen = random_cameras(2, *SIZE), crowd()
    exact, pressed = CpuRasterizer(frozen).render(cameras), CpuRasterizer(frozen, layers=layers).render(cameras)
    assert all(torch.equal(a, b) for a, b in zip(exact, pressed, strict=True))


@pytest.mark.parametrize("layers", [1, 7, 64])
@pytest.mark.parametrize("depth", [2.0, 60.0])
def test_before_and_behind_the_whole_scene_any_number_of_layers_is_right(layers, depth):
    """There nothing flies inside a layer: what is left is the rounding to 16 bits, 2e-5 for each layer."""
    frozen = crowd()
    frozen = replace(
        frozen, scales=4 * frozen.scales, means=frozen.means + torch.tensor([0.0, 0.0, 15.0]), opacities=0.3 * frozen.opacities
    )
    dynamic = random_gaussians(200, 2, size=0.03 * depth)
    dynamic = replace(dynamic, means=dynamic.means * torch.tensor([0.2, 0.2, 0.0]) * depth + torch.tensor([0.0, 0.0, depth]))
    (exact, truth), (pressed, found) = (rendered(CpuRasterizer(frozen, layers=n), dynamic) for n in (None, layers))
    assert (exact.accumulation - CpuRasterizer(frozen).render(random_cameras(1, *SIZE)).accumulation).abs().max() > 0.05
    assert (exact.rgb - pressed.rgb).abs().max() < 2e-5 * layers + 1e-4  # 1e-4: light at which a pixel counts as finished
    assert relative_error(found, truth.double()) < 2e-3


def test_more_layers_are_nearer_to_the_exact_picture_and_gradient():
    frozen, dynamic = crowd(), random_gaussians(500, 3, size=0.04)
    exact, truth = rendered(CpuRasterizer(frozen), dynamic)
    pictures, gradients = [], []
    for layers in (2, 16, 128):
        pressed, found = rendered(CpuRasterizer(frozen, layers=layers), dynamic)
        pictures.append(psnr(pressed.rgb, exact.rgb))
        gradients.append(relative_error(found, truth.double()))
    assert pictures == sorted(pictures) and pictures[-1] > pictures[0] + 15
    assert gradients == sorted(gradients, reverse=True) and gradients[-1] < 0.2 * gradients[0]


def test_the_gradient_is_that_of_the_layered_picture():
    """Central differences of what is drawn, not of the exact picture; with faint contributions kept, for there it jumps."""
    frozen, dynamic = crowd(600), random_gaussians(12, 4, size=0.1, opacity=0.5)
    rasterizer = CpuRasterizer(frozen, layers=5, config=RasterConfig(min_alpha=1e-6, radius_sigmas=6.0))
    cameras = random_cameras(1, *SIZE)
    weights = torch.randn(1, SIZE[1], SIZE[0], 3, generator=torch.Generator().manual_seed(1))

    def loss(gaussians: Gaussians) -> torch.Tensor:
        return (rasterizer.render(cameras, gaussians).rgb.double() * weights).sum()

    leaf = leaves(dynamic)
    loss(leaf).backward()
    for name, step in (("colors", 1e-2), ("opacities", 3e-3), ("means", 3e-4), ("scales", 3e-4)):
        along = torch.randn(getattr(dynamic, name).shape, generator=torch.Generator().manual_seed(2))
        up, down = (loss(replace(dynamic, **{name: getattr(dynamic, name) + sign * step * along})) for sign in (1, -1))
        expected = (getattr(leaf, name).grad * along).sum().item()
        assert ((up - down) / (2 * step)).item() == pytest.approx(expected, rel=0.02)


def test_memory_grows_with_layers_and_stays_within_its_bound():
    cameras, frozen, dynamic = random_cameras(4, *SIZE), crowd(), random_gaussians(50, 5)
    few, many = (CpuRasterizer(frozen, layers=n) for n in (4, 32))
    few.render(cameras, dynamic), many.render(cameras, dynamic)
    assert few.views.nbytes < many.views.nbytes
    bounded = CpuRasterizer(frozen, layers=32, cache_bytes=many.views.nbytes // 2)
    assert torch.equal(bounded.render(cameras, dynamic).rgb, many.render(cameras, dynamic).rgb)
    assert 0 < bounded.views.nbytes <= many.views.nbytes // 2
    assert "32 layers" in bounded.memory
