"""The flags of ns-train pgsd-weather: where they arrive, what is refused, what a saved config says."""

import json
import re
import shlex
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.base_config import ViewerConfig
from plugin_scene import grouped, tiny_config, write_scene
from test_effects_language_model import GOOD, keys, needs_library, serving  # noqa: F401

from pgsd_nerfstudio.effects.application import applied
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.effects.reader import read
from pgsd_nerfstudio.plugin.config import WeatherTrainerConfig, pgsd_weather
from pgsd_nerfstudio.plugin.distiller import Distiller
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.weather.options import SceneOptions


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


def parse(*arguments: object) -> WeatherTrainerConfig:
    # As ns-train has it: no --flag alone, always --flag True.
    as_nerfstudio = tyro.conf.FlagConversionOff[WeatherTrainerConfig]
    config = tyro.cli(as_nerfstudio, default=pgsd_weather.config, args=[str(a) for a in arguments])
    assert isinstance(config, WeatherTrainerConfig)
    return config


def test_flags_reach_pipeline_data_manager_and_model(scene: Path):
    config = parse("--load-scene", scene, "--data", scene.parent, "--intensity", 2.5, "--steps", 7, "--machine.seed", 5)
    for part in (config.pipeline, config.pipeline.datamanager, config.pipeline.model):
        assert (part.options.scene.load_scene, part.options.weather.intensity, part.options.training_seed) == (scene, 2.5, 5)
    assert config.max_num_iterations == config.optimizers["look"]["scheduler"].max_steps == 7
    assert config.experiment_name == "floor"


def test_paths_are_saved_as_absolute_ones(scene: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(scene.parent)
    config = parse("--load-scene", "floor.ply", "--data", ".")
    assert config.pipeline.options.scene == SceneOptions(load_scene=scene, data=scene.parent)


def test_the_demo_needs_no_path():
    assert parse("--load-scene", "demo").pipeline.options.scene.load_scene == Path("demo")


def test_help_shows_every_flag_once_and_none_twice(capsys: pytest.CaptureFixture):
    with pytest.raises(SystemExit) as left:
        parse("--help")
    shown = capsys.readouterr().out
    assert left.value.code == 0
    knobs = [f"--{knob.name.replace('_', '-')}" for knob in fields(EffectOptions)]
    for flag in ("--load-scene", "--data", "--prior", "--steps", "--seconds", "--metres-per-unit", *knobs):
        assert len(re.findall(rf"^[│ ] {flag} ", shown, re.MULTILINE)) == 1, flag
    assert shown.index("--load-scene") < shown.index("--effect") < shown.index("--prior")
    assert not any(flag in shown for flag in ("--pipeline", "--optimizers", "--understood"))


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--load-scene", "nowhere.ply"], "no scene at"),
        (["--load-scene", "demo", "--data", "nowhere"], "the demo has cameras of its own: leave --data"),
        (["--load-scene", "demo", "--effect", "hail"], "there is no effect 'hail'; known are: "),
        (["--load-scene", "demo", "--intensity", "-1"], "intensity must lie in 0.01-100 mm/h"),
        (["--load-scene", "demo", "--size", "9"], "--size must lie in 0.2-5, got 9"),
        (["--load-scene", "demo", "--color", "purpel"], "got 'purpel'; was 'purple' meant?"),
        (["--load-scene", "demo", "--weather", "snow", "--effect", "fog"], "--weather stands in place of --effect"),
        (["--load-scene", "demo", "--weather", "bliss"], "'bliss' names nothing that could be in the air"),
        (["--load-scene", "demo", "--llm", "openai:x"], "--llm openai:x needs words to ask about"),
        (["--load-scene", "demo", "--seconds", "0"], "--seconds must be positive"),
        # As Python says it, test_response_edited: one sentence for both.
        (["--load-scene", "demo", "--edited-images", "no"], "edited pictures must be in a folder, but no does not exist"),
        (["--load-scene", "demo", "--export-time", "2"], "--export-time must lie in 0-1"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(
    flags: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As an error that tyro does not dress up as one of its own parsing; what it looks like, test_plugin_environment says."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match=re.escape(sentence)):
        parse(*flags)
    assert list(tmp_path.iterdir()) == []


def test_a_config_is_written_by_the_trainer_only(scene: Path, tmp_path: Path):
    """nerfstudio calls save_config before anything is known of the run."""
    config = tiny_config(scene, Path("prior"), tmp_path / "outputs")
    config.save_config()
    assert not (tmp_path / "outputs").exists()
    assert config.pipeline.run_folder == tmp_path / "outputs/floor/pgsd-weather/now"
    config.write_config()
    assert (config.pipeline.run_folder / "config.yml").is_file()


def eval_setup(config_path: Path) -> WeatherTrainerConfig:
    """What nerfstudio's function of this name does with the file."""
    return yaml.load(config_path.read_text(), Loader=yaml.Loader)


def test_a_saved_config_comes_back_and_knows_where_its_run_lies(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    config = tiny_config(scene, Path("prior"), Path("outputs"))
    config.write_config()
    (tmp_path / "outputs/floor/pgsd-weather/now").rename(tmp_path / "mine")
    monkeypatch.chdir(scene.parent)
    monkeypatch.setitem(globals(), "__name__", "nerfstudio.utils.eval_utils")
    loaded = eval_setup(tmp_path / "mine/config.yml")
    assert loaded.pipeline.options == config.pipeline.options
    assert loaded.get_base_dir() == loaded.pipeline.run_folder == tmp_path / "mine"
    assert loaded.get_checkpoint_dir() == tmp_path / "mine/nerfstudio_models"
    assert "_opened_in" not in yaml.dump(loaded)


@pytest.mark.parametrize(
    ("words", "asked", "host"),
    [
        ([], "0.0.0.0", "127.0.0.1"),  # nerfstudio's default
        (["--viewer.websocket-host", "0.0.0.0"], "0.0.0.0", "0.0.0.0"),
        (["--viewer.websocket_host=0.0.0.0"], "0.0.0.0", "0.0.0.0"),
        ([], "192.0.2.7", "192.0.2.7"),
    ],
)
def test_a_viewer_listens_on_this_machine_unless_told_otherwise(scene: Path, monkeypatch, words, asked: str, host: str):
    config = tiny_config(scene, Path("prior"), Path("outputs"))
    assert config.viewer.websocket_host == "127.0.0.1"
    monkeypatch.setattr("sys.argv", ["ns-viewer", *words])
    # As nerfstudio.scripts.viewer.run_viewer does it.
    config.viewer = ViewerConfig(websocket_host=asked, jpeg_quality=50)
    assert (config.viewer.websocket_host, config.viewer.jpeg_quality) == (host, 50)


def test_a_run_keeps_the_address_it_was_given(scene: Path):
    told = parse("--load-scene", scene, "--data", scene.parent, "--viewer.websocket-host", "192.0.2.7")
    assert told.viewer.websocket_host == "192.0.2.7"
    told.viewer = ViewerConfig()
    assert told.viewer.websocket_host == "192.0.2.7"


@pytest.mark.parametrize("version", ["version: 0.0.9", ""])
def test_the_config_of_another_version_is_refused_in_a_sentence(scene: Path, tmp_path: Path, version: str):
    config = tiny_config(scene, Path("prior"), tmp_path / "outputs")
    config.write_config()
    text = (config.get_base_dir() / "config.yml").read_text().replace(f"version: {config.run.version}", version)
    with pytest.raises(RunError, match=r"written by pgsd_nerfstudio .* installed is .*train the run again"):
        yaml.load(text, Loader=yaml.Loader)


# Words for the weather.


def test_words_are_read_once_and_the_saved_config_says_what_they_mean(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    config = tiny_config(scene, Path("prior"), tmp_path / "outputs", intensity=None, weather="heavy purple blorp rain")
    config.print_to_terminal()
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("understood rain = rainfall; heavy = amount 2; purple = colour") == 1 and "Ignored: blorp" in said
    config.write_config()
    loaded = yaml.load((config.get_base_dir() / "config.yml").read_text(), Loader=yaml.Loader)
    options = loaded.pipeline.options
    assert options == config.pipeline.options == loaded.run
    assert options.chosen_effect() == applied(read("heavy purple blorp rain").request)
    # What is kept is what counts, even if words should be read otherwise one day; of other words it says nothing.
    options.understood["request"]["size"] = 3.0
    assert options.chosen_effect() == applied(replace(read("heavy purple blorp rain").request, size=3.0))
    assert grouped(options, {"weather": "thin fog"}).chosen_effect() == applied(read("thin fog").request)
    assert grouped(options, {"weather": None}).chosen_effect() == RunOptions().chosen_effect()


@needs_library
def test_a_language_model_is_asked_once_for_a_run_and_never_when_it_is_opened(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "cache"))
    with serving("openai", json.dumps(GOOD)) as server:
        words = ("--weather", "lilac wonders", "--llm", server.model, "--llm-url", server.url)
        config = parse("--load-scene", scene, "--data", scene.parent, "--output-dir", tmp_path / "outputs", *words)
        config.set_timestamp()
        config.write_config()
        assert len(server.asked) == 1
    assert [path.name[:8] for path in (tmp_path / "cache/requests").iterdir()] == ["request-"]
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "elsewhere"))
    text = (config.get_base_dir() / "config.yml").read_text()
    options = yaml.load(text, Loader=yaml.Loader).pipeline.options
    assert options.chosen_effect().prompt == GOOD["prompt"]  # and no server listens any more
    assert options.remarks()[0].startswith("openai:test-model was asked what 'lilac wonders' means: snowfall")


@pytest.mark.mistyped
def test_the_video_prior_is_told_what_the_words_say_unless_there_is_a_prompt(scene: Path):
    class Deaf:
        def encode_prompt(self, texts: list[str]) -> torch.Tensor:
            return torch.zeros(len(texts), 1, 1)

    words = parse("--load-scene", scene, "--data", scene.parent, "--weather", "purple snow").run
    assert Distiller.of(Deaf(), words, "a yard").wanted.startswith("Purple snow falling in a yard, accumulating")  # type: ignore[arg-type]
    told = grouped(words, {"prompt": "A purple day"})
    assert Distiller.of(Deaf(), told, "a yard").wanted == "A purple day"  # type: ignore[arg-type]


# The command that makes a run again.


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--effect", "fog", "--everything", "True", "--intensity", "100"],
        ["--weather", "purple snow, 'quoted'", "--amount", "1.5", "--size", "0.1e1", "--accumulation", "False"],
        ["--wind", "3", "--wind-direction", "-45.5", "--color", "#204060", "--haze", "0.5", "--haze-color", "dusty rose"],
        ["--onset", "2", "--ends", "8", "--ambience", "False", "--accumulation-speedup", "20", "--exposure", "0.01"],
        ["--weather-seed", "3", "--seconds", "2", "--fps", "10", "--max-particles", "77", "--metres-per-unit", "2.5"],
    ],
)
def test_the_command_of_a_run_makes_the_same_weather_again(scene: Path, flags: list[str]):
    config = parse("--load-scene", scene, "--data", scene.parent, *flags)
    program, method, *words = shlex.split(config.run.command())
    assert (program, method) == ("ns-train", "pgsd-weather")
    assert parse(*words).run == config.run


def test_the_command_names_a_language_model(scene: Path):
    options = grouped(
        RunOptions(),
        {"load_scene": scene, "weather": "lilac wonders", "llm": "openai:x", "llm_url": "http://127.0.0.1:1/v1"},
    )
    assert "--weather 'lilac wonders' --llm openai:x --llm-url http://127.0.0.1:1/v1" in options.command()


def test_a_config_from_before_a_flag_was_added_has_its_default(scene: Path, tmp_path: Path):
    config = tiny_config(scene, Path("prior"), tmp_path / "outputs")
    config.write_config()
    new = {knob.name for knob in fields(EffectOptions)} - {"effect", "intensity", "exposure"}
    text = (config.get_base_dir() / "config.yml").read_text()
    # Names of options stand within their group, deeper than the names of groups.
    lines = [line for line in text.splitlines() if not (line.startswith(8 * " ") and line.strip().partition(":")[0] in new)]
    assert len(text.splitlines()) - len(lines) == len(new)  # trainer, pipeline, data manager and model share one record
    loaded = yaml.load("\n".join(lines), Loader=yaml.Loader)
    assert loaded.run == loaded.pipeline.options == config.pipeline.options
    assert loaded.pipeline.options.chosen_effect() == config.pipeline.options.chosen_effect()
    assert grouped(loaded.pipeline.options, {"size": 2.0}).weather.size == 2.0


def test_the_bundled_prior_teaches_snow_only_unless_it_is_told_to_try(scene):
    snow, rain = parse("--load-scene", scene), parse("--load-scene", scene, "--effect", "rainfall")
    purple = parse("--load-scene", scene, "--weather", "purple snow")
    tried = parse("--load-scene", scene, "--effect", "rainfall", "--steps", 4)
    other = parse("--load-scene", scene, "--effect", "rainfall", "--prior", scene.parent)

    def learns(config) -> bool:
        rates = [group["optimizer"].lr for group in config.optimizers.values()]
        assert all(rates) or not any(rates)
        return all(rates)

    assert [learns(each) for each in (snow, rain, purple, tried, other)] == [True, False, True, True, True]
    assert [each.max_num_iterations for each in (snow, rain, tried)] == [snow.run.training_steps, 1, 4]
    assert snow.run.training_steps > 1
