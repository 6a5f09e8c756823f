"""Light is lost along every ray as Beer and Lambert say, and airlight takes its place, in every rasterizer."""

from __future__ import annotations

import math

import pytest
import torch

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.medium import Froxels, Medium
from pgsd_nerfstudio.rendering.reference import render_reference
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

BLACK, WHITE = torch.zeros(3), torch.ones(3)
K = torch.tensor([[60.0, 0, 24], [0, 60.0, 16], [0, 0, 1]])
LENS = K, 48, 32
TURNED = torch.tensor(  # a camera off the origin that looks along none of the axes
    [[0.8, 0.6, 0.0, 1.0], [-0.36, 0.48, 0.8, -2.0], [0.48, -0.64, 0.6, 0.5], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64
)
DISTANCES = (10.0, 20.0, 50.0, 100.0, 200.0)


def before(viewmat: torch.Tensor, count: int, nearest: float, farthest: float) -> torch.Tensor:
    """Points in the picture of a camera at distances from it, float64."""
    generator = torch.Generator().manual_seed(5)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    pixels = uniform[:, :2] * torch.tensor([48.0, 32.0]).double()
    flat = (pixels - K[:2, 2]) / K.diagonal()[:2]
    rays = torch.nn.functional.normalize(torch.cat([flat, torch.ones(count, 1)], 1), dim=1) @ viewmat[:3, :3]
    center = torch.linalg.inv(viewmat)[:3, 3]
    return center + nearest * (farthest / nearest) ** uniform[:, 2:] * rays


def wall(distance: float, rgb: torch.Tensor) -> Gaussians:
    """One Gaussian that fills the picture, `distance` in front of the camera."""
    middle = torch.tensor([[0.0, 0.0, distance]])
    return Gaussians(middle, torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[50.0, 50.0, 1e-3]]) * distance, torch.ones(1), rgb)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("visibility", [20.0, 50.0, 200.0])
@pytest.mark.parametrize("rasterizer", ["cpu", "reference"])
def test_walls_fade_into_airlight_as_beer_and_lambert_say(rasterizer, visibility, distance):
    cameras = Cameras(torch.eye(4)[None], K[None], 48, 32)
    expected = math.exp(-math.log(50.0) / visibility * distance)

    def seen(own: torch.Tensor, airlight: torch.Tensor) -> float:
        medium = Medium(airlight, math.log(50.0) / visibility)
        bare = wall(distance, own[None])
        shaded = wall(distance, medium.through(bare.colors, bare.means, torch.eye(4), *LENS))
        clip = CpuRasterizer(shaded).render(cameras) if rasterizer == "cpu" else render_reference(cameras, shaded)
        return linear(clip.rgb[0, 16, 24] / clip.accumulation[0, 16, 24, None]).double().mean().item()

    assert seen(WHITE, BLACK) == pytest.approx(expected, rel=1e-4)
    assert seen(BLACK, WHITE) == pytest.approx(1 - expected, rel=1e-4)


def test_the_way_of_the_light_counts_and_not_the_depth_along_the_axis():
    means = torch.tensor([[0.0, 0, 3], [4.0, 0, 3], [0.0, 3.0, 4.0]])
    depth = Medium(WHITE, 0.5).optical_depth(means, torch.eye(4), *LENS)
    assert depth.tolist() == pytest.approx([1.5, 2.5, 2.5])
    sampled = Medium(WHITE, lambda points: torch.full_like(points[:, 0], 0.5)).optical_depth(means, torch.eye(4), *LENS)
    assert sampled.tolist() == pytest.approx([1.5, 2.5, 2.5], rel=1e-5)


@pytest.mark.parametrize("extinction", [0.3, lambda points: 0.3 + 0.0 * points[:, 0]])
def test_gradients_reach_the_colours_dimmed_by_what_the_air_lets_through(extinction):
    medium, means = Medium(WHITE.double(), extinction), before(TURNED, 12, 1.0, 20.0)
    rgb = torch.rand(12, 3, dtype=torch.float64, requires_grad=True)
    linear(medium.through(encoded(rgb), means, TURNED, *LENS)).sum().backward()
    expected = torch.exp(-0.3 * (means - torch.linalg.inv(TURNED)[:3, 3]).norm(dim=1))
    assert rgb.grad is not None
    torch.testing.assert_close(rgb.grad, expected[:, None].expand(12, 3))


def test_gradients_reach_the_places_in_even_air():
    means, rgb = before(TURNED, 6, 1.0, 9.0).requires_grad_(), torch.rand(6, 3, dtype=torch.float64)
    medium = Medium(torch.tensor([0.2, 0.5, 0.9]).double(), 0.2)
    assert torch.autograd.gradcheck(lambda at: medium.through(rgb, at, TURNED, *LENS), (means,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(48, 32), (32, 48), (1, 1), (960, 600)])
def test_froxels_meet_even_air_exactly_from_the_lens_to_beyond_the_last_slice(size, dtype):
    means = torch.cat([before(TURNED, 200, 0.01, 40.0), before(TURNED, 200, 40.0, 2000.0)]).to(dtype)
    medium = Medium(WHITE, lambda points: torch.full_like(points[:, 0], 0.07), Froxels(farthest=50.0))
    depth = medium.optical_depth(means, TURNED.to(dtype), K.to(dtype), *size)
    expected = 0.07 * (means.double() - torch.linalg.inv(TURNED)[:3, 3]).norm(dim=1)
    assert depth.dtype == dtype
    torch.testing.assert_close(depth.double(), expected, rtol=5e-4 if dtype == torch.float32 else 1e-9, atol=1e-9)


@pytest.mark.parametrize("height", [1.5, 6.0, 40.0])
def test_froxels_meet_the_closed_form_of_air_that_thins_with_height(height):
    """Optical depth of b exp(-z / H) between heights a and c over a way d: b H (exp(-a / H) - exp(-c / H)) d / (c - a)."""
    medium = Medium(WHITE, lambda points: 0.1 * torch.exp(-points[:, 2] / height), Froxels(farthest=80.0))
    means = before(TURNED, 500, 0.5, 60.0)
    center = torch.linalg.inv(TURNED)[:3, 3]
    rise = means[:, 2] - center[2]
    shares = torch.exp(-center[2] / height) - torch.exp(-means[:, 2] / height)
    expected = 0.1 * height * shares * (means - center).norm(dim=1) / rise
    found = medium.optical_depth(means, TURNED, K.double(), 48, 32)
    counted = expected > 0.05
    assert ((found - expected)[counted] / expected[counted]).abs().max() < 0.02
    assert (torch.exp(-found) - torch.exp(-expected)).abs().max() < 0.002


def test_each_view_is_sampled_for_itself():
    """The last view is kept: another one must not be answered with it, nor the same one in another precision."""

    def leaning(points: torch.Tensor) -> torch.Tensor:
        return 0.02 * points[:, 0].abs()

    kept = Medium(WHITE, leaning)
    means = before(TURNED, 50, 1.0, 20.0)
    elsewhere = TURNED.clone()
    elsewhere[:3, 3] += torch.tensor([3.0, 0.0, 0.0])
    for view, size, dtype in (
        (TURNED, (48, 32), torch.float64),
        (elsewhere, (48, 32), torch.float64),
        (elsewhere, (40, 40), torch.float64),
        (elsewhere, (40, 40), torch.float32),
        (TURNED, (48, 32), torch.float64),
    ):
        asked = means.to(dtype), view.to(dtype), K.to(dtype), *size
        assert torch.equal(kept.optical_depth(*asked), Medium(WHITE, leaning).optical_depth(*asked))


def test_the_same_view_is_sampled_once():
    asked: list[int] = []

    def counting(points: torch.Tensor) -> torch.Tensor:
        asked.append(len(points))
        return torch.ones_like(points[:, 0])

    medium, means = Medium(WHITE, counting), before(TURNED, 5, 1.0, 2.0).float()
    for count in (1, 3, 5):
        medium.through(torch.rand(count, 3), means[:count], TURNED.float(), *LENS)
    medium.behind(None, TURNED.float(), *LENS, far=10.0)
    assert len(asked) == 1


def test_half_of_the_light_of_a_white_wall_is_shown_as_half_of_the_light_and_not_of_the_display_value():
    half = Medium(BLACK, math.log(2.0)).through(WHITE[None], torch.tensor([[0.0, 0, 1]]), torch.eye(4), *LENS)
    assert half[0].tolist() == pytest.approx([0.5 ** (1 / 2.2)] * 3, rel=1e-5)  # 0.73, where sRGB has 0.735


def test_black_in_clear_air_has_finite_gradients():
    rgb = torch.zeros(1, 3, requires_grad=True)
    Medium(BLACK, 0.1).through(rgb, torch.tensor([[0.0, 0, 1]]), torch.eye(4), *LENS).sum().backward()
    assert rgb.grad is not None and rgb.grad.isfinite().all()


def test_what_has_the_colour_of_the_air_keeps_it():
    airlight = torch.tensor([0.3, 0.6, 0.8])
    means = before(TURNED, 20, 1.0, 90.0).float()
    for extinction in (0.1, lambda points: 0.05 * points[:, 1].abs()):
        found = Medium(airlight, extinction).through(airlight.expand(20, 3), means, TURNED.float(), *LENS)
        torch.testing.assert_close(found, airlight.expand(20, 3))


def test_the_background_is_seen_from_its_distance():
    sky, airlight = torch.tensor([0.1, 0.4, 0.9]), torch.tensor([0.8, 0.7, 0.6])
    even = Medium(airlight, 0.02).behind(sky, torch.eye(4), *LENS, far=30.0)
    light, share = linear(torch.stack([sky, airlight])), math.exp(-0.6)
    torch.testing.assert_close(even, encoded(light[0] * share + light[1] * (1 - share)))
    unseen = Medium(airlight, 0.02).behind(None, torch.eye(4), *LENS, far=30.0)
    torch.testing.assert_close(unseen, encoded(light[1] * (1 - share)))


@pytest.mark.parametrize("far", [0.7, 25.0, 300.0])
def test_uneven_air_before_the_background_is_that_before_points_at_its_distance(far):
    medium = Medium(torch.tensor([0.8, 0.7, 0.6]), lambda points: 0.03 * torch.exp(0.1 * points[:, 0].clamp(-9, 9)))
    sky = torch.tensor([0.1, 0.4, 0.9])
    found = medium.behind(sky, TURNED.float(), *LENS, far=far)
    assert found.shape == (32, 48, 3)
    x, y = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(32) + 0.5, indexing="xy")
    flat = torch.stack([(x - 24) / 60, (y - 16) / 60, torch.ones(32, 48)], -1).view(-1, 3)
    rays = torch.nn.functional.normalize(flat, dim=1).double() @ TURNED[:3, :3]
    points = (torch.linalg.inv(TURNED)[:3, 3] + far * rays).float()
    expected = medium.through(sky.expand(len(points), 3), points, TURNED.float(), *LENS)
    torch.testing.assert_close(found.view(-1, 3), expected, rtol=1e-4, atol=1e-5)


def test_what_is_beside_or_behind_the_camera_stays_finite():
    means = torch.tensor([[0.0, 0, -5], [0.0, 0, 0], [9.0, 0, 1e-9], [-80.0, 50.0, 0.1]], requires_grad=True)
    medium = Medium(WHITE, lambda points: 0.1 * torch.ones_like(points[:, 0]))
    found = medium.through(torch.rand(4, 3), means, torch.eye(4), *LENS)
    found.sum().backward()
    assert found.isfinite().all()
    assert means.grad is not None and means.grad.isfinite().all()


@pytest.mark.parametrize("wrong", [-0.1, math.inf, math.nan])
def test_impossible_air_is_refused(wrong):
    with pytest.raises(ValueError, match="extinction per scene unit must be finite and not negative"):
        Medium(WHITE, wrong)


@pytest.mark.parametrize("far", [0.0, -3.0, math.inf, math.nan])
def test_impossible_distances_of_the_background_are_refused(far):
    with pytest.raises(ValueError, match="positive, finite distance"):
        Medium(WHITE, 0.1).behind(None, torch.eye(4), *LENS, far=far)


def test_slices_that_would_have_to_shrink_are_refused():
    with pytest.raises(ValueError, match="must reach farther than 64 even ones, 32 scene units; found 20"):
        Froxels(nearest=0.5, farthest=20.0)
