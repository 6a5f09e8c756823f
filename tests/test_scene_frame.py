"""The metric frame: known scale and up are found again, whatever the position and orientation of the scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from plyfile import PlyData
from rounds import round_of

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame, attention, estimate_frame
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.weather.loading import load_scene


def some_frame() -> Frame:
    rotation = roma.rotvec_to_rotmat(torch.tensor([0.4, -1.1, 0.3], dtype=torch.float64)).float()
    return Frame(0.37, rotation, torch.tensor([1.0, -2.0, 0.5]))


def terrace(seed: int = 0) -> Gaussians:
    """A floor at z = 0 under low plants and a finely modelled table at 0.75 m, strays below and haze above it; metres."""
    generator = np.random.default_rng(seed)

    def disc(n, radius, height, spread):
        angle, r = generator.uniform(0, 2 * np.pi, n), radius * np.sqrt(generator.uniform(0, 1, n))
        return np.stack([r * np.cos(angle), r * np.sin(angle), generator.normal(height, spread, n)], axis=1)

    parts = [(disc(8000, 6.0, 0.0, 0.01), 0.9), (disc(20000, 0.7, 0.75, 0.005), 0.9)]
    plants = disc(24000, 6.0, 0.0, 0.0)
    plants[:, 2] = generator.uniform(0.0, 0.4, len(plants))
    parts += [(plants, 0.9), (disc(300, 3.0, -0.8, 0.4), 0.9), (disc(3000, 3.0, 0.4, 0.2), 0.1)]
    means = torch.from_numpy(np.concatenate([points for points, _ in parts])).float()
    opacities = torch.cat([torch.full((len(points),), opacity) for points, opacity in parts])
    n = len(means)
    return Gaussians(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.full((n, 3), 0.02), opacities, torch.zeros(n, 1, 3)
    )


def into_scene(frame: Frame, cameras: Cameras) -> Cameras:
    """Metric cameras in the scene coordinates of a frame."""
    rotation = frame.rotation.T
    inverse = Frame(1 / frame.metres_per_unit, rotation, -frame.metres_per_unit * frame.rotation @ frame.origin)
    return inverse.cameras_to_metric(cameras)


def angle_between(a: torch.Tensor, b: torch.Tensor) -> float:
    cosine = torch.nn.functional.cosine_similarity(a.double(), b.double(), dim=0)
    return math.degrees(math.acos(float(cosine.clamp(-1, 1))))


def test_points_and_vectors_come_back():
    frame, points = some_frame(), torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(frame.to_scene(frame.to_metric(points)), points, atol=1e-5)
    assert torch.allclose(frame.vectors_to_scene(frame.vectors_to_metric(points)), points, atol=1e-5)
    assert torch.allclose(frame.to_metric(frame.origin), torch.zeros(3), atol=1e-6)
    expected = torch.stack([0.37 * frame.rotation @ (point - frame.origin) for point in points])
    assert torch.allclose(frame.to_metric(points), expected, atol=1e-5)
    moved = frame.to_metric(points + 1.0) - frame.to_metric(points)
    assert torch.allclose(frame.vectors_to_metric(torch.ones(50, 3)), moved, atol=1e-5)


def test_gaussians_keep_their_shape_in_scene_units():
    """The covariance of a moved Gaussian is the moved covariance."""
    frame, generator = some_frame(), torch.Generator().manual_seed(1)
    quats = torch.nn.functional.normalize(torch.randn(20, 4, generator=generator), dim=1)
    scales = torch.rand(20, 3, generator=generator) + 0.1
    ways = torch.randn(20, 3, generator=generator)
    metric = Gaussians(torch.randn(20, 3, generator=generator), quats, scales, torch.rand(20), torch.rand(20, 3), ways)
    moved = frame.gaussians_to_scene(metric)
    assert torch.allclose(moved.displacements, frame.to_scene(metric.means + ways) - moved.means, atol=1e-5)

    def covariance(g: Gaussians) -> torch.Tensor:
        axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(g.quats)) * g.scales[:, None, :]
        return axes @ axes.transpose(1, 2)

    to_scene = frame.rotation.T / frame.metres_per_unit
    assert torch.allclose(covariance(moved), to_scene @ covariance(metric) @ to_scene.T, atol=1e-4)
    assert torch.allclose(frame.to_metric(moved.means), metric.means, atol=1e-5)
    assert torch.equal(moved.colors, metric.colors) and torch.equal(moved.opacities, metric.opacities)
    with pytest.raises(ValueError, match="SH colours of degree 1"):
        frame.gaussians_to_scene(Gaussians(metric.means, quats, scales, metric.opacities, torch.zeros(20, 4, 3)))


def test_gradients_pass_into_metres():
    frame = some_frame()
    means = torch.randn(4, 3, requires_grad=True)
    quats = torch.randn(4, 4, requires_grad=True)
    moved = frame.gaussians_to_scene(Gaussians(means, quats, torch.ones(4, 3), torch.ones(4), torch.ones(4, 3)))
    (moved.means.sum() + moved.quats[:, 1].sum()).backward()
    assert torch.isfinite(means.grad).all() and means.grad.norm() > 0 and quats.grad.norm() > 0


def test_metric_cameras_see_the_same_picture():
    frame, scene_cameras = some_frame(), round_of(5, 2.0, 1.0)
    metric = frame.cameras_to_metric(scene_cameras)
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(0))

    def seen(cameras: Cameras, at: torch.Tensor) -> torch.Tensor:
        return torch.einsum("tij,nj->tni", cameras.viewmats[:, :3, :3], at) + cameras.viewmats[:, None, :3, 3]

    assert torch.allclose(seen(metric, frame.to_metric(points)), 0.37 * seen(scene_cameras, points), atol=1e-4)
    assert torch.allclose(metric.centers, frame.to_metric(scene_cameras.centers), atol=1e-4)


@pytest.mark.parametrize("tilted", [False, True])
def test_a_known_frame_is_found_again(tilted):
    truth = some_frame() if tilted else Frame(0.37, torch.eye(3), torch.tensor([1.0, -2.0, 0.5]))
    cameras = into_scene(truth, round_of(24, 2.5, 1.5))
    assert torch.allclose(truth.to_metric(cameras.centers)[:, 2], torch.full((24,), 1.5), atol=1e-4)
    found = estimate_frame(cameras, truth.gaussians_to_scene(_plain(terrace())))
    up = torch.tensor([0.0, 0.0, 1.0])
    assert angle_between(found.rotation.T @ up, truth.rotation.T @ up) < 0.1
    assert found.metres_per_unit == pytest.approx(0.37, rel=0.01)
    assert truth.to_metric(found.origin).tolist() == pytest.approx([0, 0, 0], abs=0.02)
    assert ("+z" in found.source) != tilted and "1.5 m" in found.source


def test_a_given_scale_is_kept_and_said():
    found = estimate_frame(round_of(12, 2.5, 1.2), terrace(), metres_per_unit=2.0)
    assert found.metres_per_unit == 2.0
    assert "as given" in found.source and "2.4" in found.source.split("puts the cameras ")[1][:4]
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="must be a positive number"):
            estimate_frame(round_of(12, 2.5, 1.2), terrace(), metres_per_unit=wrong)


def test_cameras_that_look_down_from_one_side_do_not_tilt_the_world():
    """Their mean up leans by 40 degrees; their horizontal axes do not. An arc of 90 degrees suffices."""
    cameras = round_of(12, 2.0, 2.2, target=0.5, arc=math.pi / 2)
    found = estimate_frame(cameras, terrace())
    assert torch.equal(found.rotation, torch.eye(3))
    mean_up = -torch.linalg.inv(cameras.viewmats)[:, :3, 1].mean(0)
    assert angle_between(mean_up, torch.tensor([0.0, 0.0, 1.0])) > 25


def test_few_cameras_held_sideways_do_not_tilt_the_world():
    cameras = round_of(16, 2.5, 1.5, arc=math.pi / 2)
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    viewmats = cameras.viewmats.clone()
    viewmats[[1, 6, 10, 14]] = turn @ viewmats[[1, 6, 10, 14]]
    found = estimate_frame(Cameras(viewmats, cameras.Ks, 128, 128), terrace())
    assert angle_between(found.rotation[2], torch.tensor([0.0, 0.0, 1.0])) < 0.5


def test_cameras_that_all_look_one_way_still_have_a_frame():
    one = round_of(1, 2.5, 1.5, target=1.5)
    viewmats = one.viewmats.repeat(6, 1, 1)
    viewmats[:, 0, 3] += torch.linspace(-0.5, 0.5, 6)
    found = estimate_frame(Cameras(viewmats, one.Ks.repeat(6, 1, 1), 128, 128), terrace())
    assert torch.equal(found.rotation, torch.eye(3))
    assert found.origin[2].item() == pytest.approx(0.0, abs=0.03)
    with pytest.raises(ValueError, match="at least one camera"):
        estimate_frame(one[torch.zeros(0, dtype=torch.long)], terrace())


@pytest.mark.parametrize("radius", [200.0, 1e5])
def test_a_sphere_of_sky_changes_no_frame(radius):
    """Neither for cameras around a middle, nor for those that look one way, whose middle follows from the Gaussians."""
    bare, count = terrace(), len(terrace()) // 4
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    domed = concatenate([bare, replace(bare.select(torch.arange(count)), means=radius * directions)])
    one = round_of(1, 2.5, 1.5, target=1.5)
    same_way = Cameras(one.viewmats.repeat(6, 1, 1), one.Ks.repeat(6, 1, 1), 128, 128)
    for cameras in (round_of(12, 2.5, 1.5), same_way):
        expected, found = estimate_frame(cameras, bare), estimate_frame(cameras, domed)
        assert found.metres_per_unit == expected.metres_per_unit and torch.equal(found.origin, expected.origin)
        assert torch.equal(found.rotation, expected.rotation) and attention(cameras, domed)[1] == attention(cameras, bare)[1]


def test_a_scene_without_ground_says_so():
    nothing = terrace().select(torch.zeros(len(terrace()), dtype=torch.bool))
    found = estimate_frame(round_of(12, 2.5, 1.5), nothing)
    assert "no opaque Gaussians below the cameras" in found.source and found.metres_per_unit > 0


def test_the_garden_stands_on_its_paving(garden_ply, garden_data):
    """Judged by the capture's sparse points, which no Gaussian was trained from."""
    scene = load_scene(garden_ply, garden_data)
    vertices = PlyData.read(str(garden_data / "sparse_pc.ply"))["vertex"].data
    sparse = torch.from_numpy(np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float32))
    points = scene.frame.to_metric(sparse).double()
    paving = points[(points[:, :2].norm(dim=1) < 2.5) & (points[:, 2].abs() < 0.2)]
    for _ in range(10):  # plane through the points near it
        lever = torch.cat([paving[:, :2], torch.ones(len(paving), 1)], dim=1)
        plane = torch.linalg.lstsq(lever, paving[:, 2:]).solution[:, 0]
        paving = paving[(paving[:, 2] - lever @ plane).abs() < 0.05]
    assert len(paving) > 3000
    assert math.degrees(math.atan(float(plane[:2].norm()))) < 1.0
    assert abs(float(plane[2])) < 0.03
    table = points[(points[:, :2].norm(dim=1) < 0.5) & (points[:, 2] > 0.3) & (points[:, 2] < 0.9)][:, 2].median()
    assert 0.6 < float(table) < 0.8  # tables are 0.7 to 0.76 m high, if people hold cameras at 1.5 m


def _plain(gaussians: Gaussians) -> Gaussians:
    return Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors[:, 0])


def test_cameras_that_stand_on_the_ground_give_no_scale():
    """So far away that double precision knows no height above the ground; a scale that is given is taken."""
    cameras = round_of(12, 2.5, 1.2)
    rotation = cameras.viewmats[:, :3, :3]
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] -= rotation @ torch.tensor([0.0, 0.0, 1e20])
    far = Cameras(viewmats, cameras.Ks, cameras.width, cameras.height)
    with pytest.raises(ValueError, match="the cameras stand on the ground, which gives no scale"):
        estimate_frame(far, Gaussians.empty(), up=(0.0, 0.0, 1.0))
    assert estimate_frame(far, Gaussians.empty(), metres_per_unit=2.0, up=(0.0, 0.0, 1.0)).metres_per_unit == 2.0
