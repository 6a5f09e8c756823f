"""The layer of snow: where it lies, how it begins and grows, its light; the sky and the air around it."""

import math
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.response.airlight import thinned
from pgsd_nerfstudio.response.layer import Layer, upright
from pgsd_nerfstudio.response.layer_making import Carriers, borne, layer_of
from pgsd_nerfstudio.response.light import received
from pgsd_nerfstudio.response.patchiness import covered_share, fallen_until_hidden, hidden_share, ranks
from pgsd_nerfstudio.response.prepare import to_metric
from pgsd_nerfstudio.response.sky import overcast, sky_share
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

FRAME = Frame(2.0, torch.eye(3), torch.zeros(3))
SNOW = effect("snowfall")


def square(half: float, height: float = 0.0) -> SurfaceMesh:
    """Level, faces up, metres."""
    corners = half * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners[:, 2] = height
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A floor of 2 m and a ring of cameras around it, 2 m away, in units of 2 m."""
    at = torch.linspace(-0.5, 0.5, 41)
    means = torch.cat([torch.cartesian_prod(at, at), torch.zeros(41**2, 1)], 1)
    n = len(means)
    scales = torch.tensor([0.015, 0.015, 0.001]).repeat(n, 1)
    floor = Gaussians(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), 0.9), torch.full((n, 3), 0.4))
    poses = []
    for angle in torch.linspace(0, 2 * math.pi, 9)[:-1].tolist():
        eye = torch.tensor([math.cos(angle), math.sin(angle), 0.5])
        forward = torch.nn.functional.normalize(-eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1])), dim=0)
        turn = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ eye
        poses.append(pose)
    K = torch.tensor([[50.0, 0, 24], [0, 50, 16], [0, 0, 1]]).repeat(8, 1, 1)
    return Scene(name="floor", gaussians=floor, cameras=Cameras(torch.stack(poses), K, 48, 32), frame=FRAME)


@pytest.fixture(scope="module")
def layer(scene) -> Layer:
    found = layer_of(scene, to_metric(scene), square(1.0), SNOW)
    assert found is not None
    return found


def test_the_layer_covers_an_open_floor_and_grows_at_the_rate_of_the_time_lapse(layer):
    assert layer.points[:, 2].abs().max() < 1e-4
    assert float((layer.spacing**2).sum()) == pytest.approx(4.0, rel=0.15)
    # 1.5 mm/h of water for 10 s, 800 times faster, ten times as thick as water
    assert layer.thickness(SNOW, 10.0).mean() == pytest.approx(1.5e-3 / 3600 * 10 * 800 * 10, rel=0.1)


def test_nothing_lies_at_second_0_and_the_layer_begins_as_patches(layer):
    assert len(layer.grown(SNOW, 0.0)[0]) == 0
    _, shown, _ = layer.grown(SNOW, 2.0)
    share = shown.sum() / len(layer)
    assert 0.15 < share < 0.85
    assert ((shown < 0.05) | (shown > 0.95)).float().mean() > 0.5  # crisp: most pieces are there or not
    assert layer.grown(SNOW, 10.0)[1].sum() / len(layer) > 0.9


def test_no_layer_lies_on_shreds_of_the_surface_that_no_gaussian_carries(scene):
    assert layer_of(scene, to_metric(scene), square(1.0, height=0.2), SNOW) is None
    assert Carriers.of(torch.tensor([[0.0, 0, 0.2]]), to_metric(scene)).share[0] < 1e-3


@pytest.mark.parametrize(("tilt", "share"), [(0.0, 1.0), (60.0, 0.5), (85.0, math.cos(math.radians(85)))])
def test_a_disc_is_as_level_as_its_area_from_above(tilt, share):
    half = math.radians(tilt) / 2
    quat = torch.tensor([[math.cos(half), math.sin(half), 0.0, 0.0]])
    disc = Gaussians(torch.zeros(1, 3), quat, torch.tensor([[0.02, 0.02, 1e-4]]), torch.ones(1), torch.ones(1, 3))
    found = Carriers.of(torch.zeros(1, 3), disc).level(disc)
    assert found.item() == pytest.approx(share, abs=0.01)


def test_leaves_on_edge_bear_caps_and_ground_bears_any_cover(scene, layer):
    """The same floor with its Gaussians set upright: the layer ends at a few millimetres and never closes."""
    assert layer.bears.isinf().all()
    upright_quat = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0]).repeat(len(scene.gaussians), 1)
    leaves = replace(scene, gaussians=replace(scene.gaussians, quats=upright_quat))
    on_edge = layer_of(leaves, to_metric(leaves), square(1.0), SNOW)
    assert on_edge is not None
    assert on_edge.thickness(SNOW, 100.0).max() < 0.0035
    assert on_edge.grown(SNOW, 100.0)[1].sum() / len(on_edge) < 0.4
    assert borne(torch.tensor([0.0, 0.5, 0.6, 0.8])).tolist() == pytest.approx([0.003, 0.003, 0.006, math.inf])


def test_an_effect_of_which_nothing_stays_has_no_layer(scene, layer):
    assert layer_of(scene, to_metric(scene), square(1.0), effect("rainfall")) is None
    bare = replace(SNOW, surface=replace(SNOW.surface, accumulates=False))
    assert len(layer.grown(bare, 10.0)[0]) == 0


def test_pieces_are_lifted_by_half_their_thickness_in_scene_units_and_take_the_form_of_the_scenes_colours(scene, layer):
    grown = layer.grown(SNOW, 10.0)
    placed = layer.gaussians(*grown, like=scene.gaussians)
    torch.testing.assert_close(2.0 * placed.means[:, 2], 0.5 * grown[2] * layer.normals[grown[0], 2], atol=1e-5, rtol=1e-4)
    assert placed.colors.shape == (len(grown[0]), 3)


def test_rims_lean_outwards_and_the_middle_does_not(layer):
    radius = layer.points[:, :2].abs().amax(1)
    out = (layer.normals[:, :2] * torch.sign(layer.points[:, :2])).amax(1)
    assert out[radius > 0.985].mean() > 0.2 and layer.normals[radius < 0.8, 2].mean() > 0.97


def test_pieces_of_some_gaussians_lie_on_these_and_keep_their_order(scene, layer):
    which = scene.gaussians.means[:, 0] > 0
    some = layer.on(which, len(which))
    assert 0.4 < len(some) / len(layer) < 0.6 and (some.points[:, 0] > -0.06).all()
    kept = scene.gaussians.means[which]
    assert (2.0 * kept[some.host] - some.points).norm(dim=1).max() < 0.1


def test_z_is_turned_into_each_normal():
    import roma

    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    normals = torch.cat([normals, torch.tensor([[0.0, 0, 1], [0.0, 0, -1]])])
    turned = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(upright(normals)))[:, :, 2]
    torch.testing.assert_close(turned, normals, atol=1e-5, rtol=0)


def test_light_under_a_partly_open_sky_is_the_sum_of_all_bounces():
    sky, series = torch.tensor([0.2, 0.7, 1.0]), torch.zeros(3)
    for bounce in range(200):
        series = series + sky * (0.6 * (1 - sky)) ** bounce
    torch.testing.assert_close(received(sky), series, rtol=1e-5, atol=0)


def test_ranks_are_even_and_half_hidden_when_their_time_has_come():
    places = 5 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0))
    rank = ranks(places, 3)
    assert torch.allclose(rank.quantile(torch.linspace(0.1, 0.9, 9)), torch.linspace(0.1, 0.9, 9), atol=0.06)
    rate = torch.full_like(rank, 0.003)
    then = fallen_until_hidden(rate, rank, 0.008)
    sure = rank < 0.9
    torch.testing.assert_close(
        hidden_share(covered_share(rate * then, 0.008), rank)[sure], torch.full((int(sure.sum()),), 0.5), atol=1e-3, rtol=0
    )
    assert hidden_share(torch.zeros(5), torch.rand(5)).max() == 0 and hidden_share(torch.ones(5), torch.rand(5)).min() == 1


def test_an_overcast_sky_lights_level_ground_as_an_even_one():
    height = (torch.arange(2000) + 0.5) / 2000  # sine; the irradiance is twice the mean of light times sine
    light = overcast(height, (1.0, 1.0, 1.0))[:, 0]
    assert float(2 * (light * height).mean()) == pytest.approx(1.0, rel=1e-4)


def test_bright_and_far_is_sky_but_leaves_and_ground_are_not():
    places = torch.tensor([[0.0, 300, 100], [0.0, 300, 100], [0.0, 3, 1], [0.0, 30, -20]])
    colors = torch.tensor([[0.7, 0.8, 0.95], [0.25, 0.5, 0.15], [0.7, 0.8, 0.95], [0.7, 0.8, 0.95]])
    far = Gaussians(places, torch.tensor([1.0, 0, 0, 0]).repeat(4, 1), torch.ones(4, 3), torch.ones(4), colors)
    assert sky_share(far, torch.zeros(1, 3), 2.0).tolist() == [1, 0, 0, 0]


def test_near_walls_take_forward_light_from_the_air_and_far_ones_do_not():
    depth, fog = torch.ones(2), effect("fog")
    near, far = thinned(depth, torch.tensor([3.0, 3000.0]), fog).tolist()
    assert near == pytest.approx(1 - 0.85**2, rel=1e-5) and far == pytest.approx(1.0, abs=0.01)
