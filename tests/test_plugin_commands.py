"""nerfstudio's commands as users call them, one after the other, on the built-in scene and on a real run."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch

pytestmark = pytest.mark.slow
SHORT = ["--seconds", "4", "--max-particles", "4000", "--steps", "4", "--timestamp", "now", "--output-dir", "outputs"]


def command(folder: Path, *arguments: object) -> subprocess.CompletedProcess:
    """Run one of nerfstudio's programs in a folder, with a PATH that holds no ffmpeg."""
    program = Path(sys.executable).with_name(str(arguments[0]))
    return subprocess.run(
        [str(program), *map(str, arguments[1:])],
        cwd=folder,
        env={**os.environ, "PATH": str(program.parent), "COLUMNS": "200"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=1500,
    )


def succeed(folder: Path, *arguments: object) -> str:
    done = command(folder, *arguments)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module", params=["demo", "splatfacto run"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which ns-train has ended by itself."""
    scene = "demo" if request.param == "demo" else request.getfixturevalue("splatfacto_run")
    folder = tmp_path_factory.mktemp("commands")
    said = succeed(folder, "ns-train", "pgsd-weather", "--load-scene", scene, "--experiment-name", "e2e", *SHORT)
    assert "Training Finished" in said and "ns-viewer --load-config" in said and "pgsd render --load-config" in said
    return folder


CONFIG = "outputs/e2e/pgsd-weather/now/config.yml"


def test_interpolate_shows_weather_that_gathers(run: Path):
    flags = ["--interpolation-steps", "4", "--downscale-factor", "4", "--output-path", "interpolate.mp4"]
    said = succeed(run, "ns-render", "interpolate", "--load-config", CONFIG, *flags)
    assert "the whole weather passes along it" in " ".join(said.split())
    assert imageio_ffmpeg.count_frames_and_secs(str(run / "interpolate.mp4"))[0] == 4 * (round(2.4 * 4) - 1)


def test_a_moved_run_is_rendered_from_another_folder_at_its_own_rate(run: Path, tmp_path: Path):
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree((run / CONFIG).parent, tmp_path / "mine")
    flags = ["--load-config", tmp_path / "mine", "--output", "v.mp4", "--width", "128"]
    succeed(tmp_path / "elsewhere", "pgsd", "render", *flags)
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "elsewhere/v.mp4")) == (100, 4.0)
    succeed(tmp_path / "elsewhere", "ns-eval", "--load-config", tmp_path / "mine/config.yml", "--output-path", "eval.json")


def test_a_run_that_is_refused_leaves_nothing(run: Path, tmp_path: Path):
    done = command(tmp_path, "ns-train", "pgsd-weather", "--load-scene", "demo", "--prior", "nothere")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "pgsd-weather: there is no local folder nothere" in done.stderr
    models = (run / CONFIG).parent / "nerfstudio_models"
    flags = ["--load-scene", "demo", "--effect", "fog", "--steps", "9", "--load-dir", models]
    done = command(tmp_path, "ns-train", "pgsd-weather", *flags)
    assert done.returncode == 1 and "--effect is fog, was snowfall" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_camera_path_shows_its_times(run: Path):
    import yaml

    from pgsd_nerfstudio.weather.loading import load_scene

    options = yaml.load((run / CONFIG).read_text(), Loader=yaml.Loader).pipeline.options
    scene = load_scene(options.scene.load_scene)
    matrix = scene.cameras.opengl()[0].flatten().tolist()
    keyframes = [{"camera_to_world": matrix, "fov": 45, "aspect": 1.5, "render_time": time} for time in (0.0, 0.5, 1.0)]
    path = {"render_width": 192, "render_height": 128, "seconds": 0.12, "camera_path": keyframes}
    (run / "path.json").write_text(json.dumps(path))
    flags = [
        "--camera-path-filename",
        "path.json",
        "--output-path",
        "path",
        "--output-format",
        "images",
        "--image-format",
        "png",
    ]
    succeed(run, "ns-render", "camera-path", "--load-config", CONFIG, *flags)
    from PIL import Image

    first, _, last = (np.asarray(Image.open(file), dtype=float) for file in sorted((run / "path").iterdir()))
    assert np.abs(last - first).mean() > 1, "snow has fallen and lies"
    assert last.mean() > first.mean(), "it makes the picture brighter"


def test_eval_and_export_end_well(run: Path):
    succeed(run, "ns-eval", "--load-config", CONFIG, "--output-path", "eval.json")
    results = json.loads((run / "eval.json").read_text())["results"]
    assert 0 <= results["drift_m"] < 0.1 and results["changed_by_weather"] > 0
    succeed(run, "ns-export", "gaussian-splat", "--load-config", CONFIG, "--output-dir", "export")

    from pgsd_nerfstudio.scene.splats.reading import read_splat

    assert len(read_splat(run / "export/splat.ply").gaussians) > 80_000


def test_bad_input_is_a_sentence_and_no_traceback(run: Path):
    (run / "cloud.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    failed = command(run, "ns-train", "pgsd-weather", "--load-scene", "cloud.ply", "--data", run, *SHORT)
    assert failed.returncode == 1 and "Traceback" not in failed.stderr
    assert "pgsd-weather: " in failed.stderr and "cloud.ply is a point cloud: it lacks the fields" in failed.stderr
    motion = run / Path(CONFIG).with_name("motion_prior.safetensors")
    motion.rename(motion.with_suffix(".away"))
    failed = command(run, "ns-render", "interpolate", "--load-config", CONFIG)
    motion.with_suffix(".away").rename(motion)
    assert failed.returncode == 1 and "Traceback" not in failed.stderr
    assert "motion prior" in failed.stderr and "ns-train pgsd-weather" in failed.stderr


def test_the_checkpoint_is_small(run: Path):
    stored = torch.load(next((run / CONFIG).parent.glob("nerfstudio_models/*.ckpt")), weights_only=False)
    assert sum(value.numel() for value in stored["pipeline"].values() if torch.is_tensor(value)) < 100_000
