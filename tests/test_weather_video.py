"""Laws of the files and the flight of `pgsd preview`, by independent readers (ffmpeg, Pillow) where there are any."""

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.weather.video import _beside, _encoder, to_bytes, write_picture, write_video
from pgsd_nerfstudio.scene.camera_path import DEGREES_PER_SECOND, choose_views, fly
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame

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


def test_a_video_holds_the_frames_it_was_given(tmp_path):
    shades = (0.1, 0.5, 0.9)
    assert write_video(tmp_path / "new" / "v.mp4", (torch.full((33, 49, 3), shade) for shade in shades), fps=10.0) == 3
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "new" / "v.mp4"))
    about = next(reader)
    assert about["size"] == (48, 32) and about["fps"] == 10.0
    means = [np.frombuffer(frame, np.uint8).mean() / 255 for frame in reader]
    assert means == pytest.approx(shades, abs=0.02)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["v.mp4"]


def test_a_video_that_fails_halfway_leaves_the_old_one_and_nothing_else(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"old")

    def frames():
        yield torch.zeros(32, 32, 3)
        raise RuntimeError("the scene melted")

    with pytest.raises(RuntimeError, match="melted"):
        write_video(tmp_path / "v.mp4", frames(), fps=10.0)
    assert (tmp_path / "v.mp4").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["v.mp4"]


def test_an_unfinished_file_is_removed(tmp_path):
    with pytest.raises(RuntimeError), _beside(tmp_path / "v.mp4") as unfinished:
        unfinished.write_bytes(b"half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_an_encoder_that_fails_is_an_error_with_its_own_words(tmp_path):
    with (
        pytest.raises(OSError, match="Invalid argument"),
        _encoder(tmp_path / "v.mp4", 32, 32, fps=-1.0) as send,
    ):
        for _ in range(100):
            send(bytes(32 * 32 * 3))


def test_no_frames_are_no_video(tmp_path):
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "v.mp4", iter(()), fps=10.0)
    assert list(tmp_path.iterdir()) == []


def test_colours_are_rounded_and_clipped():
    picture = torch.tensor([[[0.0, 1.0, 2.0], [-1.0, 0.5, 100.6 / 255]]])
    assert to_bytes(picture).tolist() == [[[0, 255, 255], [0, 128, 101]]]


def test_a_picture_is_written_without_loss(tmp_path):
    picture = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))
    write_picture(tmp_path / "p.png", picture)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "p.png")), to_bytes(picture))


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


def test_a_single_view_is_a_flight_on_the_spot():
    cameras = ring(40)[3]
    assert choose_views(cameras, STILL_WORLD) == (0, 0)
    flown = fly(cameras, 0, 0, start=5, frames=3, fps=25.0)
    assert torch.allclose(flown.viewmats, cameras.viewmats.expand(3, 4, 4), atol=1e-5)


@pytest.mark.parametrize(("start", "frames"), [(0, 12), (238, 12), (0, 250)])
def test_a_flight_is_calm_however_short_it_is(start, frames):
    flown = fly(ring(40), 0, 3, start=start, frames=frames, fps=25.0)
    assert len(flown) == frames
    rotations = flown.viewmats[:, :3, :3].double()
    per_second = [25 * angle(rotations[i], rotations[i + 1]) for i in range(frames - 1)]
    assert max(per_second) < 1.1 * DEGREES_PER_SECOND


def test_shots_of_one_flight_join():
    cameras = ring(40)
    whole = fly(cameras, 0, 3, start=0, frames=250, fps=25.0)
    part = fly(cameras, 0, 3, start=100, frames=150, fps=25.0)
    assert torch.allclose(whole.viewmats[100:], part.viewmats, atol=1e-5)
