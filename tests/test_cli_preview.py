"""Laws of `pgsd preview`: what a new user tries first says clearly what is wrong, and shows the scene with weather in it."""

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from pgsd_nerfstudio import load_scene
from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.scene.camera_path import choose_views


def preview(yard, output, **flags) -> int:
    ply, data = yard
    words = {"load-scene": ply, "data": data, "output": output, "frames": 4, "width": 96, "height": 64, "seconds": 1.0} | flags
    return run(
        [
            "preview",
            *(str(word) for name, value in words.items() if value is not None for word in (f"--{name}", *_words(value))),
        ]
    )


def _words(value):
    return value if isinstance(value, tuple) else (value,)


def test_a_preview_shows_the_scene_with_something_bright_falling_in_it(yard, tmp_path, capsys):
    assert preview(yard, tmp_path / "v.mp4", **{"max-particles": 2000}) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "v.mp4"), str(tmp_path / "v.png")]
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "v.mp4"))
    about = next(reader)
    frames = np.stack([np.frombuffer(frame, np.uint8).reshape(64, 96, 3) for frame in reader]).astype(float)
    assert about["size"] == (96, 64) and len(frames) == 4
    # The floor is a tenth as bright as white: what is brighter is weather, and it moves.
    assert 0.001 < (frames[0] > 100).mean() < 0.5
    assert (abs(frames[1] - frames[0]) > 10).any()
    poster = np.asarray(Image.open(tmp_path / "v.png")).astype(float)
    assert abs(poster - frames[-1]).mean() < 6
    assert sorted(path.name for path in tmp_path.iterdir()) == ["v.mp4", "v.png"]


def test_the_same_preview_twice_is_the_same_picture(yard, tmp_path):
    pictures = []
    for name in ("a", "b"):
        assert preview(yard, tmp_path / f"{name}.mp4", frames=1, **{"max-particles": 500}) == 0
        pictures.append((tmp_path / f"{name}.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert preview(yard, tmp_path / "c.mp4", frames=1, seed=1, **{"max-particles": 500}) == 0
    assert (tmp_path / "c.png").read_bytes() != pictures[0]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ({"load-scene": "nowhere"}, "no scene at nowhere"),
        ({"data": None}, "pass --data"),
        ({"data": "nowhere"}, "no data at nowhere"),
        ({"effect": "hail"}, "known are: "),
        ({"frames": 0}, "--frames must be positive, got 0"),
        ({"fps": "nan"}, "--fps must be positive, got nan"),
        ({"width": 8}, "--width must lie in 16-8192, got 8"),
        ({"output": "v.avi"}, "--output must end in .mp4, got v.avi"),
        ({"start": -1}, "--start must not be negative, got -1 s"),
        ({"start": 0.9}, "4 frames from --start 0.9 s go beyond the end of the weather at 1 s"),
        ({"intensity": -2}, "intensity must lie in"),
        ({"max-particles": 0}, "--max-particles must be positive, got 0"),
        ({"views": (0, 8)}, "views must lie in 0-7"),
        ({"metres-per-unit": -1}, "metres per scene unit must be a positive number"),
        ({"output": "/proc/none/v.mp4"}, "/proc/none/v.mp4 cannot be written (No such file or directory); choose another"),
    ],
)
def test_bad_input_gets_one_sentence_and_exit_code_1(yard, tmp_path, capsys, monkeypatch, flags, sentence):
    monkeypatch.chdir(tmp_path)
    assert preview(yard, **({"output": tmp_path / "v.mp4"} | flags)) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pgsd: ")]
    assert len(said) == 1 and sentence in said[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("asked", "size"), [((None, None), (640, 426)), ((100, None), (100, 66)), ((None, 50), (74, 50)), ((64, 64), (64, 64))]
)
def test_a_preview_has_the_shape_of_the_capture_unless_another_is_asked_for(yard, tmp_path, asked, size):
    """The views of the yard have 96 x 64 pixels. Sides are even, so that every player shows 4:2:0."""
    sides = dict(zip(("width", "height"), asked, strict=True))
    assert preview(yard, tmp_path / "v.mp4", frames=1, **sides, **{"max-particles": 50}) == 0
    about = next(imageio_ffmpeg.read_frames(str(tmp_path / "v.mp4")))
    assert about["size"] == size and about["pix_fmt"].startswith("yuv420p")
    assert Image.open(tmp_path / "v.png").size == size


def test_a_video_is_no_longer_than_its_weather(yard, tmp_path, capsys):
    """A longer one would be another weather, and its motion another one than that of the other commands."""
    assert preview(yard, tmp_path / "v.mp4", frames=50, seconds=0.2, **{"max-particles": 50}) == 0
    assert "the weather has 5 frames: the video shows all of them, not 50" in capsys.readouterr().err
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "v.mp4"))[0] == 5


def test_a_camera_that_keeps_away_from_all_particles_says_so(yard, tmp_path, capsys):
    """At 100 m per unit the views stand hundreds of metres apart, and the air lies around the last that a preview shows."""
    ply, data = yard
    scene = load_scene(ply, data, metres_per_unit=100.0)
    last = choose_views(scene.cameras, scene.frame)[1]
    opposite = (last + 4) % 8
    for views, away in ((None, False), ((last, last), False), ((opposite, opposite), True)):
        flags = {"metres-per-unit": 100, "max-particles": 50, "fps": 5, "seconds": 20.0} | (
            {} if views is None else {"views": views}
        )
        assert preview(yard, tmp_path / "v.mp4", frames=2, **flags) == 0
        said = " ".join(capsys.readouterr().err.split())
        assert ("keeps away from the air in which particles are simulated" in said) == away


def test_a_splat_that_is_none_is_named(yard, tmp_path, capsys):
    (tmp_path / "text.ply").write_text("no splat at all")
    assert preview(yard, tmp_path / "v.mp4", **{"load-scene": tmp_path / "text.ply"}) == 1
    assert "text.ply" in capsys.readouterr().err
    assert not (tmp_path / "v.mp4").exists()


def test_wrong_usage_is_exit_code_2():
    with pytest.raises(SystemExit) as exit_:
        run(["preview", "--load-scene", "demo", "--framez", "3"])
    assert exit_.value.code == 2
