"""The judge itself, against gsplat's own formulas and against pictures that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import roma
import torch

from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.reference import certain_pixels, project_reference, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.spherical_harmonics import sh_basis, view_colors

FOCAL = 40.0


def straight_camera(width: int = 32, height: int = 32) -> Cameras:
    K = torch.tensor([[FOCAL, 0.0, width / 2], [0.0, FOCAL, height / 2], [0.0, 0.0, 1.0]])
    return Cameras(torch.eye(4)[None], K[None], width, height)


def ball(x: float, y: float, z: float, size: float, opacity: float, color: tuple[float, float, float]) -> Gaussians:
    """One round Gaussian."""
    return Gaussians(
        torch.tensor([[x, y, z]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.full((1, 3), size),
        torch.tensor([opacity]),
        torch.tensor([color]),
    )


def test_projection_is_that_of_gsplat():
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    cameras, gaussians = random_cameras(1, 64, 48), random_gaussians(2000, size=0.3).to(torch.float64)
    viewmat, K = cameras.viewmats.double(), cameras.Ks.double()
    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, True, False)
    radii, centers, depths, conics, _ = _fully_fused_projection(gaussians.means, covariances, viewmat, K, 64, 48)
    found = project_reference(gaussians, viewmat[0], K[0], 64, 48, RasterConfig())
    drawn = radii[0] > 0
    assert 500 < drawn.sum() < 2000
    assert torch.equal(found.radii, radii[0, :, None].double().expand(-1, 2))
    assert torch.allclose(found.centers[drawn], centers[0][drawn], rtol=1e-9)
    assert torch.allclose(found.depths[drawn], depths[0][drawn], rtol=1e-12)
    inverse = torch.linalg.inv(found.covariances[drawn])
    assert torch.allclose(inverse[:, [0, 0, 1], [0, 1, 1]], conics[0][drawn], rtol=1e-7)


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_are_those_of_gsplat(degree):
    from gsplat.cuda._torch_impl import _spherical_harmonics

    gaussians = random_gaussians(100, degree=degree).to(torch.float64)
    viewmat = random_cameras(1, 8, 8).viewmats[0].double()
    directions = gaussians.means - torch.linalg.inv(viewmat)[:3, 3]
    expected = (_spherical_harmonics(degree, directions, gaussians.colors) + 0.5).clamp_min(0.0)
    assert torch.allclose(view_colors(gaussians.colors, gaussians.means, viewmat), expected, rtol=1e-12)
    assert torch.allclose(view_colors(expected, gaussians.means, viewmat), expected)


def test_harmonics_are_orthonormal():
    """Integrated over the sphere by Gauss-Legendre quadrature in z and equal steps around, exact for these degrees."""
    import numpy as np

    z, weight = np.polynomial.legendre.leggauss(12)
    around = np.arange(24) * 2 * math.pi / 24
    radius = np.sqrt(1 - z**2)
    grid = np.stack([np.outer(radius, np.cos(around)), np.outer(radius, np.sin(around)), np.outer(z, np.ones(24))], axis=-1)
    basis = sh_basis(4, torch.from_numpy(grid.reshape(-1, 3)))
    area = torch.from_numpy(np.repeat(weight, 24) * 2 * math.pi / 24)
    assert torch.allclose((basis * area[:, None]).T @ basis, torch.eye(25, dtype=torch.float64), atol=1e-7)


def test_a_degree_beyond_four_is_refused():
    with pytest.raises(ValueError, match="found 5"):
        sh_basis(5, torch.zeros(1, 3))


def test_a_round_gaussian_on_the_axis_is_a_known_bell():
    size, depth, opacity = 0.2, 4.0, 0.7
    clip = render_reference(straight_camera(), ball(0, 0, depth, size, opacity, (1.0, 0.5, 0.0)))
    variance = (FOCAL * size / depth) ** 2 + 0.3
    y, x = torch.meshgrid(torch.arange(32) - 15.5, torch.arange(32) - 15.5, indexing="ij")
    alpha = opacity * torch.exp(-(x**2 + y**2).double() / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    assert torch.allclose(clip.accumulation[0], alpha, atol=1e-7)
    assert torch.allclose(clip.rgb[0], alpha[..., None] * torch.tensor([1.0, 0.5, 0.0]), atol=1e-7)
    assert torch.allclose(clip.depth[0], depth * (alpha > 0).double())


def test_the_nearer_of_two_covers_the_other_by_its_opacity():
    far, near = ball(0, 0, 6.0, 5.0, 0.8, (0.0, 1.0, 0.0)), ball(0, 0, 3.0, 5.0, 0.6, (1.0, 0.0, 0.0))
    camera = straight_camera(33, 33)  # a pixel centre lies on the axis
    clip = render_reference(camera, concatenate([far, near]), torch.tensor([0.0, 0.0, 1.0]))
    middle = 16, 16
    assert clip.rgb[0][middle].tolist() == pytest.approx([0.6, 0.4 * 0.8, 0.4 * 0.2], abs=1e-6)
    assert clip.accumulation[0][middle].item() == pytest.approx(1 - 0.4 * 0.2, abs=1e-6)
    assert clip.depth[0][middle].item() == pytest.approx((0.6 * 3 + 0.32 * 6) / 0.92, abs=1e-6)


def test_a_pixel_is_finished_before_the_gaussian_that_would_take_its_last_light():
    layers = [ball(0, 0, 2.0 + k, 50.0, 0.99, (1.0, 1.0, 1.0)) for k in range(3)]
    clip = render_reference(straight_camera(33, 33), layers)
    assert clip.accumulation[0, 16, 16].item() == pytest.approx(0.99, abs=1e-6)  # a second would leave exactly 1e-4: not drawn


def test_a_tile_that_the_three_sigma_square_misses_stays_empty():
    """gsplat 1.4.0: alpha is still 0.006 at 3.2 sigma, but the next tile does not hear of it."""
    size, depth, border = 0.8, 4.0, 32
    variance = (FOCAL * size / depth) ** 2 + 0.3
    radius = math.ceil(3 * math.sqrt(variance + 0.1))  # gsplat adds at least sqrt(0.01) to the larger variance
    for gap, reached in ((0.2, False), (-0.2, True)):  # pixels between the square and the tile
        center = border - radius - gap
        assert math.exp(-((border + 0.5 - center) ** 2) / (2 * variance)) > 1 / 255
        camera = straight_camera(64, 64)
        camera.Ks[:, 0, 2] = center  # on the axis, where the footprint of a ball is round
        clip = render_reference(camera, ball(0, 0, depth, size, 1.0, (1.0, 1.0, 1.0)))
        assert (clip.accumulation[0, :, border:].max() > 0).item() == reached
        assert clip.accumulation[0, :, :border].max() > 0.9


def test_gradients_do_not_depend_on_the_length_of_a_quaternion():
    gaussians = random_gaussians(40).to(torch.float64)
    quats = gaussians.quats.clone().requires_grad_()
    moved = Gaussians(gaussians.means, quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    render_reference(random_cameras(1, 16, 16), moved).rgb.square().sum().backward()
    assert ((quats.grad * quats).sum(dim=-1).abs() < 1e-10).all()
    assert quats.grad.norm() > 1e-3


def test_turning_scene_and_camera_together_changes_nothing():
    gaussians, cameras = random_gaussians(60).to(torch.float64), random_cameras(1, 24, 24)
    turn = roma.random_rotmat().double()
    quats = roma.quat_product(roma.rotmat_to_unitquat(turn).expand(60, 4), gaussians.quats[:, [1, 2, 3, 0]])[:, [3, 0, 1, 2]]
    turned = Gaussians(gaussians.means @ turn.T, quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    viewmats = cameras.viewmats.double().clone()
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ turn.T
    before = render_reference(cameras, gaussians)
    after = render_reference(Cameras(viewmats, cameras.Ks, 24, 24), turned)
    assert torch.allclose(before.rgb, after.rgb, atol=1e-9)


def test_a_rectangle_is_that_of_gsplat_1_5():
    """ProjectionEWA3DGSFused.cu: extend = min(3.33, sqrt(2 ln(opacity / (1/255)))), radius = ceil(extend sqrt(variance))."""
    gaussians, cameras = random_gaussians(300, size=0.3).to(torch.float64), random_cameras(1, 64, 48)
    viewmat, K = cameras.viewmats[0].double(), cameras.Ks[0].double()
    found = project_reference(gaussians, viewmat, K, 64, 48, RasterConfig.of_gsplat("1.5.3"))
    drawn = 0
    for k in range(300):
        (x, y), opacity = found.centers[k].tolist(), gaussians.opacities[k].item()
        expected = [0.0, 0.0]
        if (viewmat @ torch.cat([gaussians.means[k], torch.ones(1)]))[2] >= 0.01 and opacity >= 1 / 255:
            extend = min(3.33, math.sqrt(2 * math.log(opacity * 255)))
            across, down = (math.ceil(extend * math.sqrt(found.covariances[k, i, i].item())) for i in (0, 1))
            if x + across > 0 and x - across < 64 and y + down > 0 and y - down < 48:
                expected = [across, down]
                drawn += across != down
        assert found.radii[k].tolist() == expected
    assert drawn > 50


def test_a_rectangle_hides_nothing_that_a_wider_one_would_show():
    cameras, gaussians = random_cameras(1, 48, 40), random_gaussians(150, opacity=0.3)
    rectangle = RasterConfig.of_gsplat("1.5.3")
    found = render_reference(cameras, gaussians, config=rectangle)
    everywhere = render_reference(cameras, gaussians, config=replace(rectangle, footprint="square", radius_sigmas=100.0))
    assert (found.rgb - everywhere.rgb).abs().max() < 1e-12
    assert found.accumulation.max() > 0.5


def test_default_conventions_are_those_of_the_installed_gsplat():
    import gsplat

    assert RasterConfig.of_gsplat(gsplat.__version__) == RasterConfig()
    with pytest.raises(ValueError, match=r"gsplat 1\.40\.0 are not known"):
        RasterConfig.of_gsplat("1.40.0")


def test_at_equal_depth_the_set_given_first_lies_in_front():
    red, blue = ball(0, 0, 4.0, 1.0, 0.9, (1.0, 0.0, 0.0)), ball(0, 0, 4.0, 1.0, 0.9, (0.0, 0.0, 1.0))
    for sets, front in (([red, blue], 0), ([blue, red], 2)):
        assert render_reference(straight_camera(33, 33), sets).rgb[0, 16, 16, front].item() == pytest.approx(0.9, abs=1e-6)


def test_single_precision_draws_the_same_picture():
    cameras, sets = random_cameras(1, 48, 40), [random_gaussians(100, 1, degree=2), random_gaussians(50, 2)]
    certain = certain_pixels(cameras, sets)
    single = render_reference(cameras, sets, dtype=torch.float32).rgb
    assert single.dtype == torch.float32
    assert (single - render_reference(cameras, sets).rgb)[certain].abs().max() < 2e-5


def smooth(config: RasterConfig) -> RasterConfig:
    """Without the steps that a difference quotient would stumble over."""
    return replace(config, footprint="square", min_alpha=1e-12, radius_sigmas=100.0)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "displacements"])
def test_gradients_are_difference_quotients_also_through_the_direction_of_harmonics(name):
    cameras, gaussians = random_cameras(1, 12, 10), random_gaussians(12, 3, degree=2, size=0.3, opacity=0.5).to(torch.float64)
    generator = torch.Generator().manual_seed(0)
    gaussians = replace(gaussians, displacements=0.3 * torch.randn(12, 3, generator=generator, dtype=torch.float64))
    weights = torch.randn(1, 10, 12, 3, generator=generator, dtype=torch.float64)
    value = getattr(gaussians, name)
    way = torch.randn(value.shape, generator=generator, dtype=torch.float64)

    def loss(tensor: torch.Tensor) -> torch.Tensor:
        clip = render_reference(cameras, replace(gaussians, **{name: tensor}), config=smooth(RasterConfig()))
        return (clip.rgb * weights).sum()

    leaf = value.clone().requires_grad_()
    loss(leaf).backward()
    quotient = (loss(value + 1e-5 * way) - loss(value - 1e-5 * way)) / 2e-5
    assert (leaf.grad * way).sum().item() == pytest.approx(quotient.item(), rel=1e-5, abs=1e-9)
    assert leaf.grad.norm() > 1e-3


def degenerate(kind: str) -> Gaussians:
    """Gaussians at which something divides by zero or loses all its digits."""
    g = random_gaussians(40, 5, degree=1)
    if kind == "points":
        return replace(g, scales=torch.zeros_like(g.scales))
    if kind == "unturned":
        return replace(g, quats=torch.zeros_like(g.quats))
    if kind == "invisible and opaque":
        return replace(g, opacities=(torch.arange(40) % 2).float())
    if kind == "needles":
        return replace(g, scales=torch.tensor([[1e3, 1e-2, 1e-2]]).expand(40, 3).contiguous())
    if kind == "around the camera":
        return replace(g, means=g.means * torch.tensor([0.02, 0.02, 0.01]) - torch.tensor([0.0, 0.0, 0.03]))
    if kind == "at the camera":
        return replace(g, means=torch.zeros_like(g.means))
    return g.select(torch.arange(0))


@pytest.mark.parametrize(
    "kind", ["points", "unturned", "invisible and opaque", "needles", "around the camera", "at the camera", "none"]
)
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("version", ["1.4", "1.5"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_degenerate_stays_finite_there_and_back(kind, moves, version, dtype):
    gaussians = degenerate(kind)
    if moves:
        gaussians = replace(gaussians, displacements=0.5 * torch.randn_like(gaussians.means))
    leaf = Gaussians(**{name: tensor.clone().requires_grad_() for name, tensor in gaussians.tensors.items()})
    camera = straight_camera(20, 18)
    clip = render_reference(camera, [random_gaussians(3), leaf], config=RasterConfig.of_gsplat(version), dtype=dtype)
    sum(image.sum() for image in clip).backward()
    assert all(torch.isfinite(image).all() for image in clip)
    for name, tensor in leaf.tensors.items():
        assert torch.isfinite(tensor.grad).all(), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_blur_what_has_no_area_stays_finite_too(dtype):
    points, needles = degenerate("points"), degenerate("needles")
    points = replace(points, displacements=0.5 * torch.randn(40, 3))
    needles = replace(needles, scales=torch.tensor([[0.3, 3e-6, 3e-6]]).expand(40, 3))
    for gaussians in (points, needles):
        leaf = Gaussians(**{name: tensor.clone().requires_grad_() for name, tensor in gaussians.tensors.items()})
        scene, config = [random_gaussians(3), leaf], RasterConfig(blur=0.0)
        clip = render_reference(straight_camera(), scene, config=config, dtype=dtype)
        sum(image.sum() for image in clip).backward()
        assert all(torch.isfinite(tensor.grad).all() for tensor in leaf.tensors.values())


def test_the_zero_quaternion_turns_nothing():
    gaussians = replace(random_gaussians(30), quats=torch.zeros(30, 4))
    upright = replace(gaussians, quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(30, 4))
    camera = random_cameras(1, 24, 24)
    assert torch.equal(render_reference(camera, gaussians).rgb, render_reference(camera, upright).rgb)


def test_no_sets_make_an_empty_picture():
    assert render_reference(straight_camera(), Gaussians.empty()).accumulation.sum() == 0
