"""What nerfstudio's commands raise about a damaged run before our code is asked: a sentence that names the file."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from plugin_scene import tiny_config, train, write_scene

from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.known_errors import explained, show_sentences
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.version import __version__

GONE = "pgsd_nerfstudio.plugin" + ".gone.RunOptions"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of one step."""
    folder = tmp_path_factory.mktemp("scene")
    return train(tiny_config(write_scene(folder), write_tiny(folder / "prior"), folder / "outputs", steps=1)).parent


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of it that may be damaged."""
    return Path(shutil.copytree(trained, tmp_path / "pgsd-weather" / "run"))


def said(command: Callable[[], object]) -> str | None:
    """What a command ends with: our own refusal, or what is made of another error."""
    try:
        command()
    except RunError as error:
        return str(error)
    except Exception as error:
        return explained(error, error.__traceback__)
    raise AssertionError("nothing was refused")


def opening(run: Path) -> str | None:
    from nerfstudio.utils.eval_utils import eval_setup

    return said(lambda: eval_setup(run / "config.yml"))


def rewritten(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_run_of_an_older_version_says_so_even_where_its_classes_have_moved(run: Path):
    rewritten(run / "config.yml", f"version: {__version__}", "version: 0.0.9")
    rewritten(run / "config.yml", "pgsd_nerfstudio.plugin.options.RunOptions", GONE)
    sentence = opening(run)
    assert sentence is not None and sentence.startswith("this config was written by pgsd_nerfstudio 0.0.9, installed is")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "pgsd_nerfstudio.plugin.options.RunOptions",
            GONE,
            "cannot make a configuration of it",
        ),
        ("method_name: pgsd-weather", "method_name: [pgsd-weather", "cannot be read as the config.yml of a run"),
    ],
)
def test_a_damaged_config_is_named(run: Path, old: str, new: str, sentence: str):
    rewritten(run / "config.yml", old, new)
    said = opening(run)
    assert said is not None and str(run / "config.yml") in said and sentence in said


@pytest.mark.parametrize("length", [0, 10, 0.5, 0.98, -7])
def test_a_checkpoint_that_is_cut_short_is_named(run: Path, length: float):
    checkpoint = next(run.glob("nerfstudio_models/*.ckpt"))
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: int(length if abs(length) >= 1 or length == 0 else length * len(whole))])
    sentence = opening(run)
    assert sentence is not None and f"the checkpoint {checkpoint} is damaged or cut short" in sentence


def test_a_run_without_checkpoints_says_so(run: Path):
    next(run.glob("nerfstudio_models/*.ckpt")).unlink()
    sentence = opening(run)
    assert sentence is not None and sentence.startswith(f"there is no checkpoint in {run / 'nerfstudio_models'}")


def test_a_run_that_is_not_there_is_named(tmp_path: Path):
    sentence = opening(tmp_path / "pgsd-weather/nothing")
    assert sentence is not None and "nothing/config.yml (No such file or directory): expected the config.yml" in sentence


FRAME = {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 50}
PATH = {"render_width": 48, "render_height": 32, "seconds": 1, "camera_path": [FRAME]}


@pytest.mark.parametrize(
    "text",
    [
        *(json.dumps({**PATH, "camera_path": []}), json.dumps({"camera_path": [FRAME]}), "{", "[]", "7", ""),
        *(json.dumps({**PATH, "camera_path": [{}]}), json.dumps({**PATH, "camera_path": [{**FRAME, "camera_to_world": [1]}]})),
        *(json.dumps({**PATH, "seconds": 0}), json.dumps({**PATH, "render_width": "wide"})),
    ],
)
def test_what_is_no_camera_path_is_named(trained: Path, tmp_path: Path, text: str):
    from nerfstudio.scripts.render import RenderCameraPath

    (tmp_path / "path.json").write_text(text)
    how = {"camera_path_filename": tmp_path / "path.json"}
    sentence = said(RenderCameraPath(trained / "config.yml", tmp_path / "v.mp4", **how).main)
    assert sentence is not None and sentence.startswith(f"{tmp_path / 'path.json'} is no camera path that can be rendered")


def test_numbers_that_cannot_be_rendered_are_refused(trained: Path, tmp_path: Path):
    from nerfstudio.scripts.render import RenderCameraPath, RenderInterpolated

    config, video = trained / "config.yml", tmp_path / "v.mp4"
    (tmp_path / "path.json").write_text(json.dumps(PATH))
    path = {"camera_path_filename": tmp_path / "path.json"}
    for command, sentence in (
        (RenderInterpolated(config, video, downscale_factor=0.0), "--downscale-factor must be positive, got 0"),
        (RenderInterpolated(config, video, frame_rate=0), "--frame-rate must be positive, got 0"),
        (RenderInterpolated(config, video, interpolation_steps=0), "--interpolation-steps must be positive, got 0"),
        (RenderCameraPath(config, video, downscale_factor=1000.0, **path), "the pictures would have 0x0 pixels: expected"),
        (
            RenderCameraPath(config, video, downscale_factor=1e-4, **path),
            "the pictures would have 480000x320000 pixels: expected",
        ),
        (
            RenderCameraPath(config, video, camera_path_filename=tmp_path / "no.json"),
            f"there is no camera path at {tmp_path}/no.json",
        ),
    ):
        found = said(command.main)
        assert found is not None and found.startswith(sentence)


@pytest.mark.parametrize("kind", ["ExportPointCloud", "ExportTSDFMesh", "ExportPoissonMesh", "ExportMarchingCubesMesh"])
def test_only_splats_can_be_exported(trained: Path, tmp_path: Path, kind: str):
    from nerfstudio.scripts import exporter

    for how in ({}, {"normal_method": "open3d"}):
        if "normal_method" in how and kind not in ("ExportPointCloud", "ExportPoissonMesh"):
            continue
        sentence = said(getattr(exporter, kind)(load_config=trained / "config.yml", output_dir=tmp_path, **how).main)
        assert sentence is not None and "ns-export gaussian-splat" in sentence


def test_errors_of_other_methods_are_not_ours(tmp_path: Path):
    from nerfstudio.scripts.render import RenderInterpolated

    (tmp_path / "config.yml").write_text("!!python/object:gone.Config {method_name: nerfacto}")
    assert said(RenderInterpolated(tmp_path / "config.yml").main) is None
    assert explained(ValueError("a bug"), None) is None


# What leaves the process.


@pytest.mark.parametrize("error", [SceneError("no scene at x"), RunError("the motion prior is missing")])
def test_errors_that_are_sentences_leave_without_a_traceback(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    show_sentences()
    sys.excepthook(type(error), error, None)
    assert capsys.readouterr().err == f"pgsd-weather: {error}\n"


def test_an_interrupted_command_ends_without_a_traceback_and_with_130():
    program = "import os, signal, time, pgsd_nerfstudio.plugin.known_errors as e; e.show_sentences()"
    waiting = f"{program}; os.kill(os.getpid(), signal.SIGINT); time.sleep(30)"
    done = subprocess.run(["bash", "-c", f"{sys.executable} -c '{waiting}'; exit $?"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_other_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch):
    shown = []
    monkeypatch.setattr(sys, "excepthook", lambda *found: shown.append(found))
    show_sentences()
    show_sentences()
    error = ValueError("a bug")
    sys.excepthook(ValueError, error, None)
    assert shown == [(ValueError, error, None)]
