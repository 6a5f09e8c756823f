"""Laws of `pgsd render`: all of the weather at its own rate, and nothing that a run's files say is run."""

import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from plugin_scene import tiny_config, train, write_scene

from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny

FRAMES = 20


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of one step and 0.8 s."""
    folder = tmp_path_factory.mktemp("scene")
    return train(tiny_config(write_scene(folder), write_tiny(folder / "prior"), folder / "outputs", steps=1)).parent


def render(config: Path, output: Path, *flags: object) -> int:
    return run(["render", "--load-config", str(config), "--output", str(output), *map(str, flags)])


def video(path: Path) -> tuple[dict, np.ndarray]:
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return about, np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]).astype(float)


def test_each_frame_of_the_weather_is_shown_once_at_its_own_rate(trained: Path, tmp_path: Path, capsys):
    assert render(trained, tmp_path / "v.mp4", "--width", 33) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'v.mp4'}\n"
    about, frames = video(tmp_path / "v.mp4")
    assert (about["fps"], about["duration"], len(frames), about["size"]) == (25.0, FRAMES / 25, FRAMES, (32, 22))
    assert about["pix_fmt"].startswith("yuv420p") and about["codec"] == "h264"


def test_it_shows_what_ns_render_shows(trained: Path, tmp_path: Path, capsys):
    from nerfstudio.scripts.render import RenderCameraPath

    pose = json.loads((trained.parents[3] / "transforms.json").read_text())["frames"][0]["transform_matrix"]
    frames = [{"camera_to_world": np.ravel(pose).tolist(), "fov": 50, "aspect": 1.5}] * 6
    path = {"render_width": 48, "render_height": 32, "seconds": 0.5, "camera_path": frames}
    (tmp_path / "path.json").write_text(json.dumps(path))
    assert render(trained / "config.yml", tmp_path / "ours.mp4", "--camera-path", tmp_path / "path.json") == 0
    assert "the whole weather passes along it" in " ".join(capsys.readouterr().err.split())
    RenderCameraPath(trained / "config.yml", tmp_path / "theirs.mp4", camera_path_filename=tmp_path / "path.json").main()
    (ours_about, ours), (about, theirs) = video(tmp_path / "ours.mp4"), video(tmp_path / "theirs.mp4")
    assert ours_about["fps"] == about["fps"] == 12.0 and len(ours) == len(theirs) == 6
    scene = theirs[:, 20:]  # beside the background, which ns-render shows as its viewer does
    assert np.abs(ours[:, 20:] - scene).mean() < 4 and np.abs(scene[-1] - scene[0]).mean() > 5


def test_nothing_in_the_files_of_a_run_is_run(trained: Path, tmp_path: Path, capsys):
    """Each file would make a folder if it were read as nerfstudio and pickle read it."""
    copy = Path(shutil.copytree(trained, tmp_path / "copy"))
    evidence = tmp_path / "evidence"
    config = copy / "config.yml"
    text = config.read_text().replace("experiment_name: floor", f"experiment_name: !!python/object/apply:os.mkdir [{evidence}]")
    config.write_text(text)
    assert render(config, tmp_path / "v.mp4") == 0
    assert not evidence.exists()

    class Mkdir:
        def __reduce__(self):
            return os.mkdir, (str(evidence),)

    with zipfile.ZipFile(next(copy.glob("nerfstudio_models/*.ckpt")), "w") as file:
        file.writestr("archive/data.pkl", pickle.dumps({"step": 0, "pipeline": Mkdir()}, protocol=2))
        file.writestr("archive/version", "3")
        file.writestr("archive/byteorder", "little")
    assert render(config, tmp_path / "w.mp4") == 1
    assert "is not opened: it holds something else than tensors and numbers" in capsys.readouterr().err
    assert not evidence.exists()


def test_opening_a_run_asks_no_language_model(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A file from elsewhere would name the address that the user's key is sent to."""
    monkeypatch.setattr("pgsd_nerfstudio.effects.options.EffectOptions.understand", None)
    copy = Path(shutil.copytree(trained, tmp_path / "copy"))
    changed(copy, "llm: null", "llm: openai:model")
    changed(copy, "llm_url: null", "llm_url: http://127.0.0.1:1/v1")
    changed(copy, "weather: null", "weather: purple snow")
    assert render(copy, tmp_path / "v.mp4", "--width", 32) == 0


def changed(copy: Path, old: str, new: str) -> None:
    text = (copy / "config.yml").read_text()
    assert old in text
    (copy / "config.yml").write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda copy: (copy / "config.yml").unlink(), "there is no run at"),
        (
            lambda copy: changed(copy, "method_name: pgsd-weather", "method_name: nerfacto"),
            "is the run of another method (nerfacto)",
        ),
        (lambda copy: changed(copy, "      version: 0.", "      version: 9."), "this config was written by pgsd_nerfstudio 9."),
        (
            lambda copy: changed(copy, "seconds: 0.8", "seconds: long"),
            "is damaged: simulation.seconds of its run cannot be used",
        ),
        (lambda copy: changed(copy, "seconds: 0.8", "seconds: -1.0"), "--seconds must"),
        (lambda copy: shutil.rmtree(copy / "nerfstudio_models"), "found no folder at"),
        (lambda copy: next(copy.glob("nerfstudio_models/*")).write_bytes(b"PK"), "step-000000000.ckpt is damaged"),
        (lambda copy: (copy / "answer.safetensors").unlink(), "answer.safetensors is missing or damaged"),
    ],
)
def test_a_damaged_run_is_refused_in_one_sentence(trained: Path, tmp_path: Path, capsys, damage, sentence):
    copy = Path(shutil.copytree(trained, tmp_path / "copy"))
    damage(copy)
    assert render(copy, tmp_path / "v.mp4") == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pgsd: ")]
    assert len(said) == 1 and sentence in said[0]
    assert not (tmp_path / "v.mp4").exists()


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--output", "v.avi"], "--output must end in .mp4, got v.avi"),
        (["--width", 8], "--width must lie in 16-8192, got 8"),
        (["--camera-path", "nothing.json"], "nothing.json cannot be read as a camera path"),
    ],
)
def test_bad_flags_get_one_sentence(trained: Path, tmp_path: Path, capsys, monkeypatch, flags, sentence):
    monkeypatch.chdir(tmp_path)
    words = ["render", "--load-config", str(trained), "--output", "v.mp4", *map(str, flags)]
    assert run(words) == 1
    assert sentence in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
