"""Gradients of the CPU rasterizer are those of autograd through the float64 reference."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rendering
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.gaussians import Gaussians

NAMES = ["means", "quats", "scales", "opacities", "colors"]


def leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    return replace(gaussians, **{n: t.detach().clone().to(dtype).requires_grad_() for n, t in gaussians.tensors.items()})


def gradients(cameras, frozen, dynamic, outputs=Rendering._fields, seed=0):
    """Gradients of a random weighting of the outputs: found and expected, by name."""
    generator = torch.Generator().manual_seed(seed)
    sure = certain_pixels(cameras, [frozen, dynamic])
    assert sure.float().mean() > 0.99

    def loss(clip: Rendering) -> torch.Tensor:
        total = 0.0
        generator.manual_seed(seed)
        for name in outputs:
            image = getattr(clip, name)
            weights = torch.randn(image.shape, generator=generator) * sure.view(*sure.shape, *[1] * (image.ndim - 3))
            total = total + (image * weights.to(image.dtype)).sum()
        return total

    found, expected = leaves(dynamic, torch.float32), leaves(dynamic, torch.float64)
    loss(CpuRasterizer(frozen).render(cameras, found)).backward()
    loss(render_reference(cameras, [frozen, expected])).backward()
    return {name: (tensor.grad, getattr(expected, name).grad) for name, tensor in found.tensors.items()}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("outputs", [("rgb",), ("depth",), ("accumulation",), Rendering._fields])
def test_gradients_of_all_five_parameters(outputs, seed):
    cameras, frozen, dynamic = random_cameras(2, 48, 40, seed), random_gaussians(200, seed), random_gaussians(100, seed + 50)
    for name, (found, expected) in gradients(cameras, frozen, dynamic, outputs, seed).items():
        if name == "colors" and "rgb" not in outputs:
            assert expected.abs().max() == found.abs().max() == 0
        else:
            assert relative_error(found, expected) < 1e-4, name


@pytest.mark.parametrize("size", [0.02, 0.15, 0.6])
def test_gradients_from_pin_pricks_to_clouds(size):
    cameras = random_cameras(1, 48, 40)
    for name, (found, expected) in gradients(cameras, random_gaussians(0), random_gaussians(120, 31, size=size)).items():
        assert relative_error(found, expected) < 1e-4, name


def test_gradients_beyond_the_edge_of_the_image():
    """There the projection is linearised at the limit of the frustum, and only the depth moves it."""
    dynamic = random_gaussians(60, 32, size=0.5)
    dynamic = replace(dynamic, means=dynamic.means * torch.tensor([3.0, 3.0, 0.3]) + torch.tensor([0.0, 0.0, 0.4]))
    cameras = random_cameras(1, 40, 40)
    for name, (found, expected) in gradients(cameras, random_gaussians(50, 33), dynamic).items():
        assert relative_error(found, expected) < 1e-4, name


def test_what_is_not_seen_gets_zero_and_not_nan():
    dynamic = leaves(random_gaussians(30, 34), torch.float32)
    with torch.no_grad():
        dynamic.means[:10, 2] = -5.0  # behind
        dynamic.means[10, 2] = 0.0
        dynamic.opacities[11:20] = 0.0
        dynamic.quats[20] = 0.0
        dynamic.scales[21] = 0.0
    clip = CpuRasterizer(random_gaussians(20, 35)).render(random_cameras(1, 32, 32), dynamic)
    sum(image.sum() for image in clip).backward()
    for name in NAMES:
        assert torch.isfinite(getattr(dynamic, name).grad).all(), name
        assert getattr(dynamic, name).grad[:10].abs().max() == 0, name


def test_background_has_a_gradient_and_the_frozen_scene_has_none():
    frozen, dynamic = leaves(random_gaussians(30, 36), torch.float32), leaves(random_gaussians(30, 37), torch.float32)
    background = torch.rand(3, requires_grad=True)
    clip = CpuRasterizer(frozen).render(random_cameras(1, 32, 32), dynamic, background)
    clip.rgb.sum().backward()
    assert torch.allclose(background.grad, (1 - clip.accumulation).sum().expand(3), rtol=1e-5)
    assert all(getattr(frozen, name).grad is None for name in NAMES)


def test_the_same_gradient_twice():
    cameras, frozen, dynamic = random_cameras(1, 64, 64), random_gaussians(200, 38), random_gaussians(200, 39)
    rasterizer, found = CpuRasterizer(frozen), []
    for _ in range(2):
        leaf = leaves(dynamic, torch.float32)
        rasterizer.render(cameras, leaf).rgb.square().sum().backward()
        found.append(leaf)
    assert all(torch.equal(getattr(found[0], name).grad, getattr(found[1], name).grad) for name in NAMES)


def test_parameters_that_need_no_gradient_do_not_cost_one():
    dynamic = random_gaussians(20, 40)
    dynamic = replace(dynamic, opacities=dynamic.opacities.requires_grad_())
    CpuRasterizer(random_gaussians(20, 41)).render(random_cameras(1, 16, 16), dynamic).rgb.sum().backward()
    assert dynamic.opacities.grad is not None and dynamic.means.grad is None
