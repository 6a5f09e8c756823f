"""Laws of the video and picture files, by independent readers (ffmpeg, Pillow)."""

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.storage import atomic_write
from pgsd_nerfstudio.weather.video import _encoder, to_bytes, write_picture, write_video


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
    with pytest.raises(RuntimeError), atomic_write(tmp_path / "v.mp4") as unfinished:
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
