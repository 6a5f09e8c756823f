"""Laws of the camera path of a preview: calm, between views that see the middle, and the same whichever part is asked for."""

import pytest
import torch

from pgsd_nerfstudio.scene.camera_path import DEGREES_PER_SECOND, choose_views, slow_path
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
