"""The Python API: one way to make the weather of a scene, the same weather as that of the commands, quick to import."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image
from plugin_scene import tiny_config, train, write_scene

import pgsd_nerfstudio
from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny
from pgsd_nerfstudio.weather.adapting import adapted
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.stored import StoredWeatherError


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    ply = write_scene(tmp_path_factory.mktemp("scene"))
    return pgsd_nerfstudio.load_scene(ply, data=ply.parent)


@pytest.fixture(scope="module")
def weather(scene):
    snow = pgsd_nerfstudio.effect("snowfall", intensity=3.0)
    return pgsd_nerfstudio.simulate(scene, snow, seconds=1.0, max_particles=300, progress=False)


def test_every_public_name_is_there_and_documented():
    for name in pgsd_nerfstudio.__all__:
        found = getattr(pgsd_nerfstudio, name)
        assert name == "__version__" or (found.__doc__ and found.__doc__[0].isupper()), name
    assert dir(pgsd_nerfstudio) == sorted(pgsd_nerfstudio.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'snow'"):
        _ = pgsd_nerfstudio.snow


def test_importing_is_quick_and_brings_neither_torch_nor_nerfstudio():
    program = (
        "import sys, time; began = time.process_time(); import pgsd_nerfstudio; spent = time.process_time() - began;"
        "print(spent, {'torch', 'numba', 'nerfstudio', 'taichi', 'numpy'} & {*sys.modules})"
    )
    seconds, heavy = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split(
        " ", 1
    )
    assert heavy.strip() == "set()" and float(seconds) < 0.3


def test_weather_is_made_and_rendered_without_nerfstudio(tmp_path: Path):
    ply = write_scene(tmp_path)
    program = f"""
import sys, pgsd_nerfstudio
scene = pgsd_nerfstudio.load_scene({str(ply)!r}, data={str(ply.parent)!r})
weather = pgsd_nerfstudio.simulate(scene, "rainfall", seconds=0.4, max_particles=50, progress=False)
weather.render(scene.cameras[0], second=0.2).save({str(tmp_path / "a.png")!r})
print("nerfstudio" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip() == "False"
    assert np.asarray(Image.open(tmp_path / "a.png")).shape == (32, 48, 3)


def test_a_picture_has_colours_depth_and_accumulation(scene, weather):
    camera = scene.cameras[0]
    picture, clear = weather.render(camera, second=0.9), weather.render_clear(camera)
    size = (camera.height, camera.width)
    assert (picture.rgb.shape, picture.depth.shape, picture.accumulation.shape) == ((*size, 3), size, size)
    assert float((picture.rgb - clear.rgb).abs().mean()) > 0.01, "there is weather in it"
    centre = clear.depth[camera.height // 2, camera.width // 2]
    away = float((scene.cameras.centers[0] - torch.tensor([0.0, 0.0, 0.4])).norm())
    assert abs(float(centre) - away) < 0.6, "the table stands where the camera looks"


def test_seconds_outside_of_the_weather_are_refused(scene, weather):
    for second in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"this weather lasts from second 0 to 1, asked for"):
            weather.render(scene.cameras[0], second=second)
    assert weather.frame_at(0.0) == 0 and weather.frame_at(1.0) == 24 and weather.frame_at(0.21) == 5
    with pytest.raises(ValueError, match="one camera, got 6"):
        weather.render(scene.cameras, second=0.5)
    with pytest.raises(ValueError, match=r"6 pictures from second 0.9 need 28 frames, this weather has 25"):
        weather.frames(scene.cameras, start=0.9)


def test_positions_are_those_of_the_simulation_in_metres(weather):
    history, frame = weather.history, weather.frame_at(0.6)
    active, resting = history.active(frame), history.resting(frame)
    expected = torch.cat([history.positions_at(frame, active), history.rest_positions[resting]])
    assert torch.equal(weather.positions(0.6), expected)
    # The Gaussians that are drawn are the same, in scene units.
    torch.testing.assert_close(weather.scene.frame.to_metric(weather.gaussians(frame).means), expected, atol=1e-5, rtol=0)


def test_a_path_becomes_a_video(scene, weather, tmp_path: Path):
    path = pgsd_nerfstudio.slow_path(scene, frames=5, fps=weather.fps, views=(0, 1)).resized(48, 32)
    pictures = list(weather.frames(path, start=0.4))
    assert torch.equal(pictures[2].rgb, weather.render_frame(path[2], 12).rgb)
    pgsd_nerfstudio.write_video(tmp_path / "a.mp4", (picture.rgb for picture in pictures), weather.fps)
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))[0] == 5
    with pytest.raises(ValueError, match="views must lie in 0-5"):
        pgsd_nerfstudio.slow_path(scene, frames=5, views=(0, 6))


def test_a_stored_weather_comes_back_to_the_bit(scene, weather, tmp_path: Path):
    assert weather.save(tmp_path / "kept") == tmp_path / "kept"
    back = pgsd_nerfstudio.Weather.open(tmp_path / "kept", scene)
    assert (back.effect, back.options) == (weather.effect, weather.options)
    camera = scene.cameras[1]
    for ours, theirs in zip(weather.render(camera, second=0.8), back.render(camera, second=0.8), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda folder: (folder / "motion_prior.safetensors").unlink(), "the motion prior .* is missing or damaged"),
        (lambda folder: (folder / "answer.safetensors").write_bytes(b"no"), "the scene's answer .* is missing or damaged"),
        (lambda folder: (folder / "weather.json").unlink(), "no weather was stored in .*: it holds none"),
        (lambda folder: (folder / "weather.json").write_text("{}"), "the description .* is damaged"),
        (lambda folder: _older(folder / "weather.json"), r"was written by pgsd_nerfstudio 0\.0\.9, installed is"),
    ],
)
def test_what_is_missing_of_a_stored_weather_is_said(scene, weather, tmp_path: Path, spoil, sentence):
    folder = weather.save(tmp_path)
    spoil(folder)
    with pytest.raises(StoredWeatherError, match=sentence):
        pgsd_nerfstudio.Weather.open(folder, scene)


def _older(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": "0.0.9"}))


def test_a_stored_weather_of_another_scene_is_refused(weather, tmp_path: Path):
    other = write_scene(tmp_path, table=0.7)
    with pytest.raises(StoredWeatherError, match="is not the scene for which"):
        pgsd_nerfstudio.Weather.open(weather.save(tmp_path / "kept"), pgsd_nerfstudio.load_scene(other, data=tmp_path))


@pytest.mark.parametrize("device", ["tpu", "cuda", "mps"])
def test_a_device_that_is_not_there_is_said(scene, device):
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(ValueError, match=f"a scene is prepared on cpu or cuda, got '?{device}"):
        pgsd_nerfstudio.simulate(scene, device=device)


def test_making_and_opening_a_weather_draws_nothing_from_the_random_stream_of_training(scene, tmp_path: Path):
    before = torch.get_rng_state()
    made = pgsd_nerfstudio.simulate(scene, seconds=0.2, max_particles=50, progress=False)
    opened = pgsd_nerfstudio.Weather.open(made.save(tmp_path), scene)
    assert len(opened.look.active.opacity) == len(made.history)
    assert torch.equal(torch.get_rng_state(), before)


def test_words_become_weather(scene):
    purple = pgsd_nerfstudio.EffectOptions(weather="purple snow")
    made = pgsd_nerfstudio.simulate(scene, purple, seconds=0.2, max_particles=50, progress=False)
    assert made.effect == adapted(purple.resolve()[0], made.prepared)[0]
    assert repr(made).startswith("Weather(snowfall in floor, 0.2 s, ")


def test_pictures_are_png_in_the_folder_that_is_meant(scene, weather, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    picture = weather.render(scene.cameras[0], second=0.5)
    assert picture.save("~/a.png") == tmp_path / "a.png" and (tmp_path / "a.png").is_file()
    assert weather.save("~/kept") == tmp_path / "kept"
    assert weather.save_video("~/a.mp4", scene.cameras[:2].resized(48, 32)) == tmp_path / "a.mp4"
    with pytest.raises(ValueError, match=r"a picture is written as \.png, got .*a\.jpg"):
        picture.save(tmp_path / "a.jpg")
    with pytest.raises(NotADirectoryError, match=r"a weather is stored in a folder, but .*a\.png is a file"):
        weather.save(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"seconds": 0}, "--seconds must be positive, got 0 s"),
        ({"seconds": float("inf")}, "--seconds must be at most 3600 s, got inf s"),
        ({"fps": float("nan")}, "--fps must be positive, got nan"),
        ({"fps": 1e-9}, "--fps must be at least 1, got 1e-09"),
        ({"max_particles": 0}, "--max-particles must be positive, got 0"),
        ({"max_particles": 10**11}, "--max-particles must be at most 1e+07, got 1e+11"),
        ({"seconds": 3000, "fps": 1000}, "are 3,000,000 frames; at most 200,000 can be simulated"),
        ({"seed": -1}, "--seed must not be negative"),
        ({"seed": 2**70}, "less than 2^63, got"),
        ({"physics": "newton"}, "--physics must be metric or paper, got 'newton'"),
        ({"collisions": "False"}, "--collisions must be True or False, got 'False'"),
        ({"max_particles": 1.5}, "--max-particles must be a whole number, got 1.5"),
    ],
)
@pytest.mark.mistyped
def test_one_judge_of_simulation_options(options, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        SimulationOptions(**options).check()


def test_the_same_words_are_simulated_once_by_simulate_training_and_python(tmp_path: Path, monkeypatch, capsys):
    """`pgsd preview` for its path, then `pgsd simulate`, two steps of training and Python: one simulation for all cameras."""
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "cache"))
    module = importlib.import_module("pgsd_nerfstudio.physics.motion_prior")
    simulated, simulate = [], module.simulate_metric

    def counted(*arguments, **named):
        simulated.append(named["max_particles"])
        return simulate(*arguments, **named)

    monkeypatch.setattr(module, "simulate_metric", counted)
    ply = write_scene(tmp_path)
    words = ["--load-scene", str(ply), "--data", str(tmp_path), "--intensity", "3", "--seconds", "0.8"]
    words += ["--max-particles", "500", "--seed", "5"]
    small = ["--frames", "2", "--width", "48", "--height", "32"]
    assert run(["preview", *words, *small, "--output", str(tmp_path / "a.mp4")]) == 0
    assert run(["simulate", *words, "--output", str(tmp_path / "report")]) == 0
    prior = write_tiny(tmp_path / "prior")
    asked = {"intensity": 3.0, "seconds": 0.8, "seed": 5, "max_particles": 500, "steps": 2}
    config = train(tiny_config(ply, prior, tmp_path / "outputs", **asked))
    assert (config.parent / "motion_prior.safetensors").is_file()
    scene = pgsd_nerfstudio.load_scene(ply, data=tmp_path)
    snow = pgsd_nerfstudio.effect("snowfall", intensity=3.0)
    weather = pgsd_nerfstudio.simulate(scene, snow, seconds=0.8, seed=5, max_particles=500, progress=False)
    assert simulated == [500, 500]
    assert "other" in run_with_another_seed(words, small, tmp_path) and len(simulated) == 3
    # A run of ns-train holds the weather as Python knows it.
    assert torch.equal(pgsd_nerfstudio.Weather.open(config.parent, scene).positions(0.5), weather.positions(0.5))


def run_with_another_seed(words: list[str], small: list[str], folder: Path) -> str:
    assert run(["preview", *words[:-1], "6", *small, "--output", str(folder / "other.mp4")]) == 0
    return "other"
