"""The flags of ns-train pgsd-weather: where they arrive, what is refused, what a saved config says."""

from pathlib import Path

import pytest
import tyro
import yaml
from plugin_scene import tiny_config, write_scene

from pgsd_nerfstudio.plugin.config import WeatherTrainerConfig, pgsd_weather
from pgsd_nerfstudio.plugin.environment import RunError


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


def parse(*arguments: object) -> WeatherTrainerConfig:
    return tyro.cli(WeatherTrainerConfig, default=pgsd_weather.config, args=[str(a) for a in arguments])


def test_flags_reach_pipeline_data_manager_and_model(scene: Path):
    config = parse("--load-scene", scene, "--data", scene.parent, "--intensity", 2.5, "--steps", 7, "--machine.seed", 5)
    for part in (config.pipeline, config.pipeline.datamanager, config.pipeline.model):
        assert (part.options.load_scene, part.options.intensity, part.options.training_seed) == (scene, 2.5, 5)
    assert config.max_num_iterations == config.optimizers["look"]["scheduler"].max_steps == 7
    assert config.experiment_name == "floor"


def test_paths_are_saved_as_absolute_ones(scene: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(scene.parent)
    config = parse("--load-scene", "floor.ply", "--data", ".")
    assert config.pipeline.options.load_scene == scene and config.pipeline.options.data == scene.parent


def test_the_demo_needs_no_path():
    assert parse("--load-scene", "demo").pipeline.options.load_scene == Path("demo")


def test_help_shows_every_flag_once_and_none_twice(capsys: pytest.CaptureFixture):
    with pytest.raises(SystemExit) as left:
        parse("--help")
    shown = capsys.readouterr().out
    assert left.value.code == 0
    for flag in ("--load-scene", "--data", "--effect", "--prior", "--steps", "--seconds", "--metres-per-unit", "--intensity"):
        assert shown.count(f"{flag} ") == 1, flag
    assert "--pipeline" not in shown and "--optimizers" not in shown


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--load-scene", "nowhere.ply"], "no scene at"),
        (["--load-scene", "demo", "--data", "nowhere"], "no data at"),
        (["--load-scene", "demo", "--effect", "hail"], "there is no effect 'hail'; known are: "),
        (["--load-scene", "demo", "--intensity", "-1"], "intensity must lie in 0-100 mm/h"),
        (["--load-scene", "demo", "--seconds", "0"], "--seconds must be positive"),
        (["--load-scene", "demo", "--export-time", "2"], "--export-time must lie in 0-1"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(
    flags: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        parse(*flags)
    assert left.value.code == 2
    assert sentence in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert list(tmp_path.iterdir()) == []


def test_a_saved_config_comes_back_and_knows_where_its_run_lies(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    config = tiny_config(scene, Path("prior"), Path("outputs"))
    config.save_config()
    (tmp_path / "outputs").rename(tmp_path / "moved")
    text = (tmp_path / "moved/floor/pgsd-weather/now/config.yml").read_text().replace("- outputs", "- moved")
    loaded = yaml.load(text, Loader=yaml.Loader)
    assert loaded.pipeline.options == config.pipeline.options
    assert loaded.pipeline.run_folder == tmp_path / "moved/floor/pgsd-weather/now"


@pytest.mark.parametrize("version", ["version: 0.0.9", ""])
def test_the_config_of_another_version_is_refused_in_a_sentence(scene: Path, tmp_path: Path, version: str):
    config = tiny_config(scene, Path("prior"), tmp_path / "outputs")
    config.save_config()
    text = (config.get_base_dir() / "config.yml").read_text().replace(f"version: {config.version}", version)
    with pytest.raises(RunError, match=r"written by pgsd_nerfstudio .* installed is .*train the run again"):
        yaml.load(text, Loader=yaml.Loader)
