"""Antialiased Gaussians: the blur of a pixel takes from their peak what it adds to their area, on every rasterizer. Whole ones
lose nothing to the smallest alpha that is drawn either."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from test_rendering_cuda import OnAnyDevice, assert_same_picture_and_gradients, moving_gaussians, torch_gsplat
from test_rendering_gradient import gradients
from test_rendering_image import assert_same_picture

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.reference import certain_pixels, project_reference, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

__all__ = ["torch_gsplat"]  # a fixture

BOTH = [(True, False), (False, True), (True, True)]
"""Whether the frozen scene is antialiased, and what moves in it."""


def antialiased(gaussians: Gaussians, yes: bool = True) -> Gaussians:
    return replace(gaussians, antialiased=yes)


def whole(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, antialiased=True, whole=True)


def test_opacities_on_the_image_plane_are_those_of_gsplat():
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    cameras, gaussians = random_cameras(1, 64, 48), random_gaussians(2000, size=0.02).to(torch.float64)
    viewmat, K = cameras.viewmats.double(), cameras.Ks.double()
    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, True, False)
    radii, *_, factors = _fully_fused_projection(gaussians.means, covariances, viewmat, K, 64, 48, calc_compensations=True)
    drawn = radii[0] > 0
    found = project_reference(antialiased(gaussians), viewmat[0], K[0], 64, 48, RasterConfig())
    assert drawn.sum() > 500
    assert 0.1 < factors[0][drawn].median() < 0.9
    assert torch.allclose(found.opacities[drawn], (gaussians.opacities * factors[0])[drawn], rtol=1e-7)


@pytest.mark.parametrize("moved", [None, (0.3, 0.1, 0.0)])
def test_the_light_that_a_small_gaussian_takes_is_that_of_a_sharp_picture_at_every_resolution(moved):
    """Faint and from afar: the sum of alpha over the picture is opacity times area, 2 pi sqrt(det), whatever a pixel's size."""
    moves = None if moved is None else torch.tensor([moved])
    one = Gaussians(
        torch.tensor([[0.1, -0.2, 100.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([[0.04, 0.02, 0.03]]),
        torch.tensor([0.01]),
        torch.ones(1, 3),
        moves,
    )
    fine = RasterConfig(min_alpha=1e-9, faint_alpha=1e-9, radius_sigmas=8.0)
    for width in (16, 64, 256):
        focal = 50.0 * width
        K = torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, width / 2], [0.0, 0.0, 1.0]]])
        cameras = Cameras(torch.eye(4)[None], K, width, width)
        expected = 0.01 * 2 * torch.pi * 0.04 * 0.02 * (focal / 100.0) ** 2
        for clip in (
            render_reference(cameras, antialiased(one), config=fine),
            CpuRasterizer(antialiased(one), config=fine).render(cameras),
            CpuRasterizer(Gaussians.empty(), config=fine).render(cameras, antialiased(one)),
        ):
            assert clip.accumulation.sum().item() == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize(("frozen", "moving"), BOTH)
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("size", [0.01, 0.15])
def test_picture_equals_the_reference(frozen, moving, moves, size):
    cameras = random_cameras(2, 48, 40)
    scene = antialiased(random_gaussians(200, 1, degree=1, size=size), frozen)
    dynamic = antialiased(moving_gaussians(100, degree=None, moves=moves), moving)
    assert_same_picture(cameras, CpuRasterizer(scene).render(cameras, dynamic), [scene, dynamic])


@pytest.mark.parametrize("layers", [None, 1])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("size", [0.002, 0.15])
def test_a_picture_of_what_is_whole_equals_the_reference(moves, size, layers):
    """Sharp frozen scenes in one picture with whole and moving ones, each by its own rule; one layer, behind all that moves."""
    cameras, dynamic = random_cameras(2, 48, 40), whole(moving_gaussians(100, degree=None, moves=moves))
    dynamic = replace(dynamic, scales=dynamic.scales * (size / 0.15))
    scene = random_gaussians(200, 1, degree=1)
    if layers:
        scene = scene.select(scene.means[:, 2] > 6.0)
        dynamic = replace(dynamic, means=dynamic.means.clamp(max=4.0))
    found = CpuRasterizer(scene, layers=layers).render(cameras, dynamic)
    if layers is None:
        assert_same_picture(cameras, found, [scene, dynamic])
    certain = certain_pixels(cameras, [scene, dynamic])
    assert certain.double().mean() > 0.9
    expected = render_reference(cameras, [scene, dynamic])
    assert (found.rgb - expected.rgb)[certain].abs().max() < (1e-3 if layers else 2e-5)


@pytest.mark.parametrize("moved", [None, (0.02, 0.01, 0.0)])
@pytest.mark.parametrize("opacity", [0.9, 0.05, 0.002])
def test_many_particles_cover_the_sum_of_their_areas_at_every_resolution(moved, opacity):
    """Particles of a hundredth to a sixth of a pixel, fainter than what is drawn of one pixel: the share of the picture that
    they cover is what Beer-Lambert says of their areas."""
    generator, n = torch.Generator().manual_seed(0), 100_000
    places = torch.rand(n, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.0]) + torch.tensor([-1.0, -1.0, 100.0])
    scales = 0.001 * (1.0 + torch.rand(n, 1, generator=generator)).expand(n, 3)
    moves = None if moved is None else torch.tensor([moved]).expand(n, 3)
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    some = whole(Gaussians(places, upright, scales, torch.full((n,), opacity), torch.ones(n, 3), moves))
    expected = 1.0 - math.exp(-float(2 * math.pi * opacity * scales[:, 0].square().sum()) / 4.0)  # of 4 square units
    for width in (20, 40, 160):
        K = torch.tensor([[[50.0 * width, 0.0, width / 2], [0.0, 50.0 * width, width / 2], [0.0, 0.0, 1.0]]])
        cameras = Cameras(torch.eye(4)[None], K, width, width)
        inner = slice(width // 8, -(width // 8))  # what is near the rim sends light out of the picture
        coarse = RasterConfig(faint_alpha=1.0 / 255.0)  # as gsplat
        clips = [CpuRasterizer(Gaussians.empty()).render(cameras, some)]
        clips.append(CpuRasterizer(Gaussians.empty(), config=coarse).render(cameras, some))
        if width == 40:
            clips.append(render_reference(cameras, [Gaussians.empty(), some]))
        for clip, alpha in zip(clips, (1e-2 / 255.0, 1.0 / 255.0, 1e-2 / 255.0), strict=False):
            found = clip.accumulation[0, inner, inner]
            # The faintest meet some pixels with the smallest alpha; three standard deviations of that number are allowed.
            chance = 3.0 * math.sqrt(alpha / (expected * found.numel()))
            assert found.mean().item() == pytest.approx(expected, rel=0.02 + chance)


@pytest.mark.parametrize("make", [antialiased, whole])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("size", [0.03, 0.15])
def test_gradients_equal_those_of_the_reference(moves, size, make):
    dynamic = random_gaussians(100, 50, size=size)
    if moves:
        dynamic = replace(dynamic, displacements=0.4 * torch.randn(100, 3, generator=torch.Generator().manual_seed(3)))
    found = gradients(random_cameras(2, 48, 40), random_gaussians(200), make(dynamic))
    for name, (gradient, expected) in found.items():
        assert relative_error(gradient, expected) < 1e-4, name


@pytest.mark.parametrize(("frozen", "moving"), BOTH)
@pytest.mark.parametrize("moves", [False, True])
def test_around_gsplats_kernels_picture_and_gradients_are_those_of_the_reference(torch_gsplat, frozen, moving, moves):
    scene = antialiased(random_gaussians(60, 1, degree=1), frozen)
    dynamic = antialiased(moving_gaussians(40, degree=None, moves=moves), moving)
    assert_same_picture_and_gradients(OnAnyDevice(scene), scene, dynamic, "cpu")
    assert_same_picture_and_gradients(OnAnyDevice(scene), scene, replace(dynamic, whole=True), "cpu")


def test_what_has_no_area_takes_no_light_and_has_finite_gradients():
    """Discs seen edge-on and points, among others that are seen."""
    gaussians = random_gaussians(60, 3)
    scales = gaussians.scales.clone()
    scales[:20, 1:], scales[20:30] = 0.0, 0.0
    leaf = replace(antialiased(gaussians), scales=scales.requires_grad_())
    cameras = random_cameras(1, 32, 24)
    for clip in (CpuRasterizer(Gaussians.empty()).render(cameras, leaf), render_reference(cameras, leaf)):
        (gradient,) = torch.autograd.grad(clip.rgb.sum(), scales)
        assert torch.isfinite(clip.rgb).all() and torch.isfinite(gradient).all()
        assert (
            clip.rgb - render_reference(cameras, antialiased(gaussians).select(torch.arange(30, 60))).rgb
        ).abs().max() < 1e-4


@pytest.mark.gpu
@pytest.mark.parametrize("moves", [False, True])
def test_picture_and_gradients_on_cuda_are_those_of_the_reference(moves):
    from pgsd_nerfstudio.rendering.choice import choose_rasterizer

    scene = antialiased(random_gaussians(200, 1, degree=1))
    dynamic = antialiased(moving_gaussians(100, degree=None, moves=moves))
    assert_same_picture_and_gradients(choose_rasterizer(scene, "cuda"), scene, dynamic, "cuda")


@pytest.mark.gpu
def test_the_picture_is_that_of_the_whole_of_gsplat_antialiased():
    import gsplat

    from pgsd_nerfstudio.rendering.choice import choose_rasterizer

    cameras, scene = random_cameras(1, 100, 70).to("cuda"), random_gaussians(2000, 1, size=0.03)
    found = choose_rasterizer(antialiased(scene), "cuda").render(cameras)
    tensors = (getattr(scene, name).cuda() for name in ("means", "quats", "scales", "opacities", "colors"))
    expected, _, _ = gsplat.rasterization(
        *tensors, cameras.viewmats, cameras.Ks, 100, 70, render_mode="RGB+ED", rasterize_mode="antialiased"
    )
    assert (found.rgb - expected[..., :3]).abs().max() < 1e-5
