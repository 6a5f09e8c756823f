"""Laws of camera paths: calm, between views that see the middle, the same whichever part is asked for; around, ahead, still."""

import math
from itertools import pairwise

import pytest
import torch

from pgsd_nerfstudio.scene.camera_path import (
    DEGREES_PER_SECOND,
    choose_views,
    dolly_path,
    orbit_path,
    slow_path,
    still_path,
)
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene

STILL_WORLD = Frame(1.0, torch.eye(3), torch.zeros(3))


def ring(count: int, height: float = 1.5, radius: float = 4.0) -> Cameras:
    """Views on a ring around the origin, looking at a point one metre above it."""
    azimuth = torch.arange(count) * (2 * torch.pi / count)
    centers = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), torch.full_like(azimuth, height)], 1)
    back = torch.nn.functional.normalize(centers - torch.tensor([0.0, 0.0, 1.0]), dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]).expand_as(back), back), dim=1)
    c2w = torch.stack([right, torch.linalg.cross(back, right), back, centers], 2)
    K = torch.tensor([[100.0, 0.0, 64.0], [0.0, 100.0, 48.0], [0.0, 0.0, 1.0]])
    return Cameras.from_opengl(c2w, K.expand(count, 3, 3), 128, 96)


def angle(a: torch.Tensor, b: torch.Tensor) -> float:
    """Degrees between two rotations, by the trace."""
    return float(torch.rad2deg(torch.arccos(((torch.trace(a.T @ b) - 1) / 2).clamp(-1, 1))))


def seen_by(cameras: Cameras) -> Scene:
    return Scene("ring", Gaussians.empty(), cameras, STILL_WORLD)


def test_the_two_views_look_at_the_middle_and_are_25_degrees_apart():
    cameras = ring(72)  # 5 degrees apart
    poses = cameras.opengl()
    poses[::2, :3, :3] = poses[::2, :3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # every second one turned away
    first, last = choose_views(Cameras.from_opengl(poses, cameras.Ks, 128, 96), STILL_WORLD)
    assert first % 2 == 1 and last % 2 == 1
    turn = angle(poses[first, :3, :3], poses[last, :3, :3])
    assert 19 < turn < 31


def test_the_two_views_have_what_all_look_at_in_the_middle_and_not_the_ground_below_it():
    """A statue whose face is 2.2 m above the ground; a few views look at its feet."""
    target = torch.tensor([0.0, 0.0, 1.2])
    poses = ring(48, height=1.5 + 4.0 * math.tan(math.radians(20)))[torch.arange(40)].opengl()
    feet = ring(48, height=1.5).opengl()
    poses[:, :3, 3] += target  # they look at 2.2 m, 20 degrees down
    poses[::4] = feet[:40:4]
    poses[::4, :3, 3] -= torch.tensor([0.0, 0.0, 1.0])
    cameras = Cameras.from_opengl(poses, ring(40).Ks, 128, 96)
    for view in choose_views(cameras, STILL_WORLD):
        x, y, z = cameras.viewmats[view, :3, :3] @ torch.tensor([0.0, 0.0, 2.2]) + cameras.viewmats[view, :3, 3]
        assert z > 0 and abs(x / z) < 0.02 and abs(y / z) < 0.02


def test_the_choice_of_views_does_not_depend_on_the_scenes_own_axes():
    cameras = ring(40)[torch.tensor([0, 3, 7, 12, 20])]
    turned = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    turned = turned * torch.linalg.det(turned)
    poses = cameras.opengl()
    poses[:, :3] = turned.T @ poses[:, :3]
    poses[:, :3, 3] *= 3.0
    assert choose_views(Cameras.from_opengl(poses, cameras.Ks, 128, 96), Frame(1 / 3, turned, torch.zeros(3))) == choose_views(
        cameras, STILL_WORLD
    )


def test_a_single_view_is_a_path_on_the_spot():
    cameras = ring(40)[3]
    assert choose_views(cameras, STILL_WORLD) == (0, 0)
    path = slow_path(seen_by(cameras), start=5, frames=3)
    assert torch.allclose(path.viewmats, cameras.viewmats.expand(3, 4, 4), atol=1e-5)


@pytest.mark.parametrize(("start", "frames"), [(0, 12), (238, 12), (0, 250)])
def test_a_path_is_calm_however_short_it_is(start, frames):
    path = slow_path(seen_by(ring(40)), views=(0, 3), start=start, frames=frames)
    assert len(path) == frames
    rotations = path.viewmats[:, :3, :3].double()
    per_second = [25 * angle(rotations[i], rotations[i + 1]) for i in range(frames - 1)]
    assert max(per_second) < 1.1 * DEGREES_PER_SECOND


def test_shots_of_one_path_join():
    cameras = ring(40)
    whole = slow_path(seen_by(cameras), views=(0, 3), frames=250)
    part = slow_path(seen_by(cameras), views=(0, 3), start=100, frames=150)
    assert torch.allclose(whole.viewmats[100:], part.viewmats, atol=1e-5)


# Around, ahead, on the spot.


def lifted(cameras: Cameras) -> Scene:
    """The ring's scene in turned and shifted axes of half a metre, as captures are."""
    turned = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)))[0]
    turned = turned * torch.linalg.det(turned)
    frame = Frame(0.5, turned, torch.tensor([3.0, -1.0, 2.0]))
    poses = cameras.opengl()
    poses[:, :3, :3] = frame.rotation.T @ poses[:, :3, :3]
    poses[:, :3, 3] = frame.to_scene(poses[:, :3, 3])
    return Scene("lifted", Gaussians.empty(), Cameras.from_opengl(poses, cameras.Ks, cameras.width, cameras.height), frame)


def test_an_orbit_keeps_its_distance_and_looks_at_the_middle():
    scene = lifted(ring(12, height=1.5, radius=4.0))
    path = orbit_path(scene, frames=36)
    poses = scene.frame.cameras_to_metric(path).opengl()
    centers = poses[:, :3, 3]
    torch.testing.assert_close(centers[:, :2].norm(dim=1), torch.full((36,), 4.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(centers[:, 2], torch.full((36,), 1.5), atol=1e-3, rtol=0)
    # The views look at a point one metre above the ground: it stays in the middle of the picture, and up stays up.
    target = scene.frame.to_scene(torch.tensor([0.0, 0.0, 1.0]))
    local = path.viewmats[:, :3, :3] @ target + path.viewmats[:, :3, 3]
    seen = torch.einsum("nij,nj->ni", path.Ks, local)
    torch.testing.assert_close(seen[:, :2] / seen[:, 2:], torch.tensor([64.0, 48.0]).expand(36, 2), atol=0.05, rtol=0)
    assert (poses[:, 2, 1] > 0.9).all() and poses[:, 2, 0].abs().max() < 1e-4


def test_a_full_orbit_closes_without_showing_its_first_view_twice():
    scene = seen_by(ring(12))
    azimuth = [torch.atan2(c[1], c[0]) for c in orbit_path(scene, frames=8).centers]
    steps = torch.stack([(after - before) % (2 * torch.pi) for before, after in pairwise([*azimuth, azimuth[0]])])
    torch.testing.assert_close(steps, torch.full((8,), torch.pi / 4), atol=1e-4, rtol=0)
    half = orbit_path(scene, frames=5, degrees=-180.0).centers
    torch.testing.assert_close(half[0] + half[-1], torch.tensor([0.0, 0.0, 3.0]), atol=1e-3, rtol=0)


def test_a_dolly_goes_straight_ahead_a_part_of_the_way():
    scene = seen_by(ring(12))
    path = dolly_path(scene, frames=5, view=3, forward=0.4)
    pose = scene.cameras.opengl()[3]
    torch.testing.assert_close(path.opengl()[:, :3, :3], pose[:3, :3].expand(5, 3, 3), atol=1e-5, rtol=0)
    way = pose[:3, 3].norm()
    expected = pose[:3, 3] - torch.linspace(0, 0.4, 5)[:, None] * way * pose[:3, 2]
    torch.testing.assert_close(path.centers, expected, atol=1e-4, rtol=0)
    assert float(path.centers[-1].norm()) < float(path.centers[0].norm())


def test_a_still_camera_does_not_move():
    scene = seen_by(ring(12))
    path = still_path(scene, frames=4, view=7)
    assert len(path) == 4 and (path.viewmats == scene.cameras.viewmats[7]).all()
    assert (still_path(scene, frames=1).viewmats == scene.cameras.viewmats[choose_views(scene.cameras, scene.frame)[0]]).all()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda scene: orbit_path(scene, frames=0), "frames >= 1"),
        (lambda scene: orbit_path(scene, frames=2, degrees=float("nan")), "finite number of degrees"),
        (
            lambda scene: orbit_path(seen_by(ring(5, radius=1e-3)), frames=2),
            "from the middle of the scene: an orbit needs views",
        ),
        (lambda scene: dolly_path(scene, frames=2, forward=1.5), "less than the whole way"),
        (lambda scene: dolly_path(scene, frames=2, view=12), "must lie in 0-11"),
        (lambda scene: still_path(scene, frames=2, view=-1), "must lie in 0-11"),
    ],
)
def test_paths_that_cannot_be_are_refused(make, sentence: str):
    with pytest.raises(ValueError, match=sentence):
        make(seen_by(ring(12)))
