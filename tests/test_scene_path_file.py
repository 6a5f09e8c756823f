"""Camera paths as files: what is written is what nerfstudio reads, and what people have is read or refused in a sentence."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pgsd_nerfstudio.scene.cameras import Cameras, interpolate
from pgsd_nerfstudio.scene.path_file import read_camera_path, write_camera_path
from pgsd_nerfstudio.scene.path_times import path_times
from pgsd_nerfstudio.scene.scene import SceneError


def cameras(count: int = 12) -> Cameras:
    ends = torch.eye(4).repeat(2, 1, 1)
    ends[1, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    ends[1, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.2], [0.5, 0.0, -0.1], [-0.2, 0.1, 0.0]]))
    K = torch.tensor([[90.0, 0.0, 48.0], [0.0, 90.0, 32.0], [0.0, 0.0, 1.0]])
    return interpolate(Cameras.from_opengl(ends, K.repeat(2, 1, 1), 96, 64), 0, 1, count)


def test_nerfstudio_reads_what_is_written(tmp_path: Path):
    from nerfstudio.cameras.camera_paths import get_path_from_json

    ours = cameras()
    write_camera_path(tmp_path / "deep/path.json", ours, fps=24.0)
    whole = json.loads((tmp_path / "deep/path.json").read_text())
    theirs = get_path_from_json(whole)
    assert whole["seconds"] == 0.5 and (int(theirs.width[0]), int(theirs.height[0])) == (96, 64)
    torch.testing.assert_close(theirs.camera_to_worlds, ours.opengl()[:, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(theirs.get_intrinsics_matrices(), ours.Ks, atol=1e-3, rtol=0)
    assert theirs.times is not None
    torch.testing.assert_close(theirs.times[:, 0], torch.linspace(0, 1, 12))
    # What the viewer loads.
    assert [key["render_time"] for key in whole["keyframes"]][::8] == [0.0, 1.0]
    assert whole["keyframes"][-1]["matrix"] == whole["camera_path"][-1]["camera_to_world"]


def test_what_is_written_is_read_again(tmp_path: Path):
    ours = cameras()
    write_camera_path(tmp_path / "path.json", ours, fps=24.0)
    path = read_camera_path(tmp_path / "path.json")
    torch.testing.assert_close(path.cameras.viewmats, ours.viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(path.cameras.Ks, ours.Ks, atol=1e-3, rtol=0)
    assert path.times == tuple(index / 11 for index in range(12)) and path.seconds == 0.5


FRAME = {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 90.0}
PATH = {"render_width": 96.0, "render_height": 64.0, "seconds": 2, "camera_path": [FRAME] * 4}


def read(folder: Path, **changes: object):
    whole = {name: value for name, value in {**PATH, **changes}.items() if value is not ...}
    (folder / "path.json").write_text(json.dumps(whole))
    return read_camera_path(folder / "path.json")


def test_an_old_path_of_the_viewer_is_read(tmp_path: Path):
    path = read(tmp_path)
    assert (path.cameras.width, path.cameras.height, path.times) == (96, 64, (None,) * 4)
    assert float(path.cameras.Ks[0, 1, 1]) == pytest.approx(32 / math.tan(math.radians(45)))


@pytest.mark.parametrize(
    ("keyframes", "extra", "times"),
    [
        ([0.0, 1.0], {}, (0.0, 0.25, 0.5, 0.75)),
        ([0.0, 1.0, 0.0], {}, (0.0, 0.5, 1.0, 0.5)),
        ([0.0, 1.0], {"is_cycle": True}, (0.0, 0.5, 1.0, 0.5)),
        ([0.5, None], {}, (None,) * 4),
    ],
)
def test_times_that_only_keyframes_have_are_used(tmp_path: Path, keyframes, extra, times):
    keys = [{"render_time": time} if time is not None else {} for time in keyframes]
    path = read(tmp_path, keyframes=keys, default_transition_sec=1.5, **extra)
    assert path.times == pytest.approx(times) if times[0] is not None else path.times == times


def test_a_keyframe_may_take_longer_than_the_others(tmp_path: Path):
    slow = {"render_time": 1.0, "override_transition_enabled": True, "override_transition_sec": 3.0}
    path = read(tmp_path, keyframes=[{"render_time": 0.0}, {"render_time": 0.5}, slow], default_transition_sec=1.0)
    assert path.times == pytest.approx((0.0, 0.5, 0.5 + 0.5 / 3, 0.5 + 1 / 3))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"camera_path": []}, "at least one camera"),
        ({"camera_path": ...}, "at least one camera"),
        ({"camera_path": [7]}, "at least one camera"),
        ({"seconds": 0}, "seconds must be a positive number, got 0"),
        ({"seconds": "long"}, "seconds must be a positive number"),
        ({"render_width": ...}, "render_width must be a positive number below 16384, got None"),
        ({"render_height": 0.5}, "render_height must be a positive number"),
        ({"camera_type": "equirectangular"}, "cameras of the type equirectangular"),
        ({"camera_path": [{**FRAME, "fov": 180}]}, "fov must be a positive number below 179"),
        ({"camera_path": [{"fov": 50}]}, "needs a camera_to_world of 4x4 numbers"),
        ({"camera_path": [{**FRAME, "camera_to_world": [1, 2]}]}, "needs a camera_to_world of 4x4 numbers"),
        ({"camera_path": [{**FRAME, "camera_to_world": [0] * 16}]}, "the pose of frame 0 has axes of no length"),
        ({"camera_path": [{**FRAME, "camera_to_world": [float("nan")] * 16}]}, "the pose of frame 0 holds a NaN"),
        ({"camera_path": [{**FRAME, "camera_to_world": [1e300, *[0] * 15]}]}, "the pose of frame 0 has axes of"),
        ({"render_width": 1e300}, "render_width must be a positive number below 16384"),
        ({"camera_path": [{**FRAME, "render_time": "noon"}]}, "render_time must be a number, got 'noon'"),
    ],
)
def test_what_is_no_camera_path_is_refused_in_a_sentence(tmp_path: Path, changes, sentence):
    with pytest.raises(SceneError, match=rf"path\.json.*{sentence}"):
        read(tmp_path, **changes)


@pytest.mark.parametrize("text", ["", "{", "[]", "7", "[" * 100_000])
def test_what_is_no_json_is_refused_in_a_sentence(tmp_path: Path, text: str):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(SceneError, match=r"path\.json"):
        read_camera_path(tmp_path / "path.json")


def test_paths_that_hang_are_real(shared: Path, tmp_path: Path):
    """As nerfstudio's viewer wrote one for the garden, and as it writes one whose time nobody touches."""
    script = shared / "cases" / "hanging_path.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], cwd=script.parent, check=True, capture_output=True)
    for name in ("path_without_times.json", "path_of_zeros.json"):
        path = read_camera_path(tmp_path / name)
        found = path_times(path.times, seconds=10.0, frames=250)
        assert len(path.cameras) == 480 and found.remark is not None
        assert found.times == pytest.approx([index / 479 for index in range(480)])
