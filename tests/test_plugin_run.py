"""A run from training to video, through nerfstudio's own classes; trained once, in three steps."""

import importlib
import json
import shutil
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
import yaml
from nerfstudio.cameras.camera_paths import get_path_from_json
from PIL import Image
from plugin_scene import HEIGHT, VIEWS, WIDTH, grouped, tiny_config, train, write_scene
from wan_tiny import tiny_wan

from pgsd_nerfstudio.dynamics import FieldConfig, RegularizationWeights
from pgsd_nerfstudio.guidance.distillation import DistillationConfig
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.known_errors import explained
from pgsd_nerfstudio.plugin.opening import _opened
from pgsd_nerfstudio.plugin.resuming import resumed
from pgsd_nerfstudio.plugin.run_cameras import to_nerfstudio

FRAMES = 20


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("prior"))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, prior: Path) -> Path:
    """config.yml of the run."""
    folder = tmp_path_factory.mktemp("scene")
    return train(tiny_config(write_scene(folder), prior, folder / "outputs"))


@pytest.fixture
def run(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, in a process that must not simulate nor open a video prior."""

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("only training may do this")

    simulation = importlib.import_module("pgsd_nerfstudio.physics.motion_prior")
    monkeypatch.setattr(simulation, "simulate_metric", forbidden)
    monkeypatch.setattr(simulation, "motion_prior", forbidden)
    monkeypatch.setattr("pgsd_nerfstudio.response.exposure.Exposure.of", forbidden)
    monkeypatch.setattr("pgsd_nerfstudio.guidance.video_prior.VideoPrior.load", forbidden)
    return trained


def opened(config: Path, mode: str = "test"):
    from nerfstudio.utils.eval_utils import eval_setup

    return eval_setup(config, test_mode=mode)[1]  # type: ignore[arg-type]


def at(pipeline, time: float | None) -> torch.Tensor:
    """The picture of the first view at a time."""
    camera = to_nerfstudio(pipeline.model.prepared.scene.cameras[0], None if time is None else torch.tensor([time]))
    return pipeline.model.get_outputs_for_camera(camera)["rgb"]


def test_training_leaves_a_config_a_checkpoint_and_the_motion_prior(trained: Path):
    left = {path.relative_to(trained.parent).as_posix() for path in trained.parent.rglob("*") if path.is_file()}
    assert {
        "config.yml",
        "motion_prior.safetensors",
        "answer.safetensors",
        "dataparser_transforms.json",
        "nerfstudio_models/step-000000002.ckpt",
    } <= left
    config = yaml.load(trained.read_text(), Loader=yaml.Loader)
    clips = config.run.clips
    assert (clips.clip_frames, clips.clip_height, clips.clip_width) == (5, 32, 48), "settled defaults are saved"
    assert config.pipeline.options.clips.clip_width == 48


def test_only_what_is_learned_lies_in_the_checkpoint(run: Path):
    state = torch.load(next(run.parent.glob("nerfstudio_models/*.ckpt")))["pipeline"]
    assert {key.split(".")[1] for key in state} == {"field", "look", "device_indicator_param", "_extra_state"}
    pipeline = opened(run)
    moved = [value for key, value in state.items() if "look" in key]
    assert all(bool(value.any()) for value in moved), "the learned look has left its start"
    for key, value in pipeline.state_dict().items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, state[key])


def test_the_picture_follows_the_time_of_the_camera(run: Path):
    pipeline = opened(run)
    first, middle, last = (at(pipeline, time) for time in (0.0, 0.5, 1.0))
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert float((first - middle).abs().max()) > 0.05 and float((middle - last).abs().max()) > 0.05
    torch.testing.assert_close(at(pipeline, 0.0), first, atol=1e-6, rtol=0)
    torch.testing.assert_close(at(pipeline, 0.4 / (FRAMES - 1)), first, atol=1e-6, rtol=0)


def test_renders_without_a_time_advance_frame_by_frame_and_start_over(run: Path):
    pipeline = opened(run)
    timed = [at(pipeline, frame / (FRAMES - 1)) for frame in range(FRAMES)]
    untimed = [at(pipeline, None) for _ in range(FRAMES + 1)]
    for a, b in zip([*timed, timed[0]], untimed, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)


def test_the_knobs_change_the_picture(run: Path):
    pipeline = opened(run)
    panel, snowed = pipeline.model.weather, at(pipeline, 0.5)
    panel.size.value = 3.0
    assert float((at(pipeline, 0.5) - snowed).abs().max()) > 0.02
    panel.shown.value = False
    frozen = pipeline.model.render(pipeline.model.prepared.scene.cameras[0], None).rgb[0].clamp(0, 1)
    torch.testing.assert_close(at(pipeline, 0.5), frozen)


def test_surfaces_and_haze_of_the_panel_change_the_scene_and_not_the_flakes(run: Path):
    pipeline = opened(run)
    panel, answered = pipeline.model.weather, at(pipeline, 1.0)
    panel.surfaces.value = False
    bare = at(pipeline, 1.0)
    assert float((bare - answered).abs().mean()) > 0.02
    panel.surfaces.value, panel.haze.value = True, 0.0
    clear = at(pipeline, 1.0)
    panel.haze.value = 4.0
    hazy = at(pipeline, 1.0)
    assert 0 < float((clear - answered).abs().mean()) < float((hazy - clear).abs().mean())
    panel.haze.value = 1.0
    torch.testing.assert_close(at(pipeline, 1.0), answered)


def test_training_clips_show_the_answer_unless_the_bundled_prior_looks_at_them(prior: Path, tmp_path: Path, monkeypatch):
    seen = []

    def spy(prepared, views, weather, background, moments):
        seen.append([moment is not None for moment in moments])
        return render(prepared, views, weather, background, moments)

    module = importlib.import_module("pgsd_nerfstudio.plugin.pipeline")
    render = module.render_clip
    monkeypatch.setattr(module, "render_clip", spy)
    for asked in (None, False):
        train(tiny_config(write_scene(tmp_path), prior, tmp_path / str(asked), steps=1, surfaces_in_clips=asked))
    assert [all(one) for one in seen] == [True, False] and not any(seen[1])
    config = tiny_config(write_scene(tmp_path), Path("bundled"), tmp_path / "o")
    assert not config.run.answering_clips


def test_depth_and_accumulation_come_along(run: Path):
    pipeline = opened(run)
    outputs = pipeline.model.get_outputs_for_camera(to_nerfstudio(pipeline.model.prepared.scene.cameras[0], torch.zeros(1)))
    assert {name: tuple(value.shape) for name, value in outputs.items()} == {
        "rgb": (HEIGHT, WIDTH, 3),
        "depth": (HEIGHT, WIDTH, 1),
        "accumulation": (HEIGHT, WIDTH, 1),
        "background": (HEIGHT, WIDTH, 3),
    }
    depth = outputs["depth"][HEIGHT - 1, WIDTH // 2, 0]
    assert 1.0 < float(depth) < 4.0, "the floor before the camera"


def test_the_crop_box_of_the_viewer_cuts_scene_and_weather(run: Path):
    from nerfstudio.data.scene_box import OrientedBox

    pipeline = opened(run)
    camera = to_nerfstudio(pipeline.model.prepared.scene.cameras[0], torch.ones(1))
    box = OrientedBox(R=torch.eye(3), T=torch.tensor([0.0, 0, 0.8]), S=torch.tensor([2.0, 2, 0.4]))
    cut = pipeline.model.get_outputs_for_camera(camera, obb_box=box)["accumulation"]
    whole = pipeline.model.get_outputs_for_camera(camera)["accumulation"]
    assert 0.01 < float(cut.mean()) < 0.6 * float(whole.mean())
    prepared = pipeline.model._inside(box)[1].views
    held = len(prepared)
    pipeline.model.get_outputs_for_camera(camera, obb_box=box)
    assert len(prepared) == held, "the same view of the same moment is prepared once"


def test_a_run_is_found_wherever_it_and_its_scene_were_moved(prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A project of relative paths, opened after a move from a folder that has nothing to do with it."""
    old, new = tmp_path / "old", tmp_path / "new"
    (old / "data").mkdir(parents=True)
    write_scene(old / "data")
    monkeypatch.chdir(old)
    made = train(tiny_config(Path("data/floor.ply"), prior, old / "outputs", data=Path("data"), steps=1))
    before = at(opened(made), 1.0)
    shutil.copytree(old, new)
    (old / "data").rename(old / "away")
    monkeypatch.chdir("/")
    _opened.cache_clear()
    config = new / made.relative_to(old)
    torch.testing.assert_close(at(opened(config), 1.0), before, atol=0, rtol=0)
    (new / "data/floor.ply").unlink()
    with pytest.raises(RunError, match=r"scene of the run .* no longer at .*/old/data/floor\.ply, and no data/floor\.ply lies"):
        opened(config)


def test_a_run_without_its_motion_prior_names_the_command_that_makes_it(run: Path, tmp_path: Path):
    copy = copied(run, tmp_path)
    (copy.parent / "motion_prior.safetensors").unlink()
    with pytest.raises(RunError, match=r"motion prior .* missing or damaged.*ns-train pgsd-weather --load-scene .*floor\.ply"):
        opened(copy)


def test_a_run_without_its_answer_names_the_command_too(run: Path, tmp_path: Path):
    copy = copied(run, tmp_path)
    (copy.parent / "answer.safetensors").unlink()
    with pytest.raises(
        RunError, match=r"answer .*answer\.safetensors is missing or damaged; .*ns-train pgsd-weather --load-scene"
    ):
        opened(copy)


def test_a_scene_that_changed_since_is_refused(run: Path, tmp_path: Path):
    copy = copied(run, tmp_path)
    config = yaml.load(copy.read_text(), Loader=yaml.Loader)
    config.pipeline.share(grouped(config.pipeline.options, {"load_scene": write_scene(tmp_path, table=0.7)}))
    copy.write_text(yaml.dump(config))
    with pytest.raises(RunError, match=r"is not the scene for which .* was made"):
        opened(copy)


def test_a_run_keeps_the_metric_frame_it_was_trained_in(run: Path, tmp_path: Path):
    copy = copied(run, tmp_path)
    copy.write_text(copy.read_text().replace("metres_per_unit: null", "metres_per_unit: 2.0"))
    torch.testing.assert_close(at(opened(copy), 1.0), at(opened(run), 1.0))


def test_a_checkpoint_that_lacks_a_tensor_is_refused(run: Path, tmp_path: Path):
    copy = copied(run, tmp_path)
    path = next(copy.parent.glob("nerfstudio_models/*.ckpt"))
    stored = torch.load(path)
    del stored["pipeline"]["_model.look.active"]
    torch.save(stored, path)
    with pytest.raises(RunError, match=r"does not fit this version.*look\.active"):
        opened(copy)


def test_a_checkpoint_with_a_flipped_bit_is_refused(run: Path, tmp_path: Path):
    """torch reads it without a word: the file's checksums are not compared."""
    copy = copied(run, tmp_path)
    path = next(copy.parent.glob("nerfstudio_models/*.ckpt"))
    whole = path.read_bytes()
    weights = max((value for value in torch.load(path)["pipeline"].values() if torch.is_tensor(value)), key=torch.numel)
    weights = weights.numpy().tobytes()
    place = whole.index(weights) + len(weights) // 2
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    torch.load(path)
    with pytest.raises(RunError, match=r"the checkpoint is damaged"):
        opened(copy)
    with pytest.raises(RunError, match=r"the checkpoint .*step-000000002\.ckpt is damaged: its part .* has changed"):
        resumed(yaml.load(run.read_text(), Loader=yaml.Loader).run, path.parent, None, None)


# Going on.


def test_training_goes_on_from_a_checkpoint(trained: Path, prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With the weather that the run keeps: nothing is simulated, even where the cache is empty."""
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    monkeypatch.setattr("pgsd_nerfstudio.plugin.pipeline.prepare_weather", None)
    models = trained.parent / "nerfstudio_models"
    (models / ".DS_Store").touch()
    more = train(tiny_config(scene, prior, tmp_path, steps=4, load_dir=models))
    (models / ".DS_Store").unlink()
    assert [path.name for path in (more.parent / "nerfstudio_models").iterdir()] == ["step-000000003.ckpt"]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ({"steps": 2}, r"nothing is left to train: .*step-000000002\.ckpt has done 3 steps, .* ends at 2; .*--steps 6"),
        ({"steps": 3}, r"nothing is left to train"),
        (
            {"effect": "fog", "intensity": None},
            r"was begun for something else: --effect is fog, was snowfall, --intensity is None, was",
        ),
        ({"seconds": 2.0}, r"--seconds is 2\.0, was 0\.8"),
        ({"metres_per_unit": 2.0}, r"--metres-per-unit is 2\.0, was None"),
        ({"dynamics": FieldConfig(velocity=False)}, r"--dynamics\.velocity is False, was True"),
        ({"motion": "field"}, r"--motion is field, was particle"),
    ],
)
def test_a_training_does_not_go_on_for_something_else(trained: Path, prior: Path, tmp_path: Path, flags, sentence: str):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    with pytest.raises(RunError, match=sentence):
        tiny_config(scene, prior, tmp_path, **{"steps": 9, "load_dir": trained.parent / "nerfstudio_models", **flags})
    assert not list(tmp_path.iterdir())


def test_a_training_does_not_go_on_in_another_scene(trained: Path, prior: Path, tmp_path: Path):
    (tmp_path / "other").mkdir()
    other = write_scene(tmp_path / "other", table=0.6)
    with pytest.raises(RunError, match=r"--load-scene is .*other/floor\.ply, was .*floor\.ply"):
        tiny_config(other, prior, tmp_path / "outputs", steps=9, load_dir=trained.parent / "nerfstudio_models")
    # Where the same file holds another scene now, only its content tells.
    own = write_scene(tmp_path)
    models = train(tiny_config(own, prior, tmp_path / "own", steps=1)).parent / "nerfstudio_models"
    write_scene(tmp_path, table=0.6)
    _opened.cache_clear()
    with pytest.raises(RunError, match=r"is not the scene for which .* was made.*; training cannot go on from there"):
        train(tiny_config(own, prior, tmp_path / "outputs", steps=9, load_dir=models))
    assert not (tmp_path / "outputs").exists()


def test_what_may_change_on_the_way_is_said(trained: Path, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    models = trained.parent / "nerfstudio_models"
    tiny_config(scene, prior, tmp_path, steps=9, load_dir=models)
    assert capsys.readouterr().err == ""
    tiny_config(scene, prior, tmp_path, steps=9, lr=0.5, load_dir=models)
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("goes on with other options than before: --lr is 0.5, was 0.00")


def test_where_there_is_no_checkpoint_is_said_before_anything_is_done(trained: Path, prior: Path, tmp_path: Path):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    (tmp_path / "cut.ckpt").write_bytes(next(trained.parent.glob("nerfstudio_models/*.ckpt")).read_bytes()[:5000])
    for flags, sentence in (
        ({"load_dir": tmp_path / "nothing"}, r"found no folder at"),
        ({"load_dir": trained.parent}, r"no checkpoint step-\*\.ckpt in .*: use .*nerfstudio_models"),
        ({"load_dir": trained.parent / "nerfstudio_models", "load_step": 7}, r"no checkpoint step-000000007\.ckpt"),
        ({"load_checkpoint": tmp_path / "no.ckpt"}, r"there is no checkpoint at"),
        ({"load_checkpoint": tmp_path / "cut.ckpt"}, r"cut\.ckpt is damaged"),
    ):
        with pytest.raises(RunError, match=sentence):
            tiny_config(scene, prior, tmp_path / "outputs", steps=9, **flags)


def test_the_same_seed_learns_the_same(trained: Path, prior: Path, tmp_path: Path):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    again = train(tiny_config(scene, prior, tmp_path))
    ours, theirs = (torch.load(next(p.parent.glob("nerfstudio_models/*.ckpt")))["pipeline"] for p in (trained, again))
    for key, value in ours.items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, theirs[key], atol=1e-5, rtol=1e-4, msg=key)


@pytest.mark.parametrize("broken_at", [1, 3, 4])
def test_a_run_that_was_broken_off_goes_on_to_the_same_bits(trained: Path, prior: Path, tmp_path: Path, monkeypatch, broken_at):
    """Kept states are made every second step, so that they are older than the weights at an odd one; long enough for clips to
    start far from frame 0, where all states are the same."""
    from pgsd_nerfstudio.plugin.pipeline import WeatherPipeline

    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    whole = train(tiny_config(scene, prior, tmp_path / "whole", steps=6, seconds=2.4))
    step_before = WeatherPipeline.get_train_loss_dict

    def interrupted(self: WeatherPipeline, step: int):
        if step == broken_at:
            raise KeyboardInterrupt
        return step_before(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(WeatherPipeline, "get_train_loss_dict", interrupted)
        with pytest.raises(SystemExit, match="130"):
            train(tiny_config(scene, prior, tmp_path / "part", steps=6, seconds=2.4))
    part = tmp_path / "part/floor/pgsd-weather/now/config.yml"
    rest = train(tiny_config(scene, prior, tmp_path / "rest", steps=6, seconds=2.4, load_dir=part.parent / "nerfstudio_models"))
    ends = [torch.load(config.parent / "nerfstudio_models" / "step-000000005.ckpt") for config in (whole, rest)]
    for key, value in ends[0]["pipeline"].items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, ends[1]["pipeline"][key]), key
    for key, value in ends[0]["optimizers"]["field"]["state"].items():
        other = ends[1]["optimizers"]["field"]["state"][key]
        assert all(torch.equal(moment, other[name]) for name, moment in value.items())


@pytest.mark.parametrize(
    "flags",
    [
        {"distillation": DistillationConfig(variant="nfsd")},
        {"distillation": DistillationConfig(variant="bridge", omega="paper_code")},
        {"dynamics": FieldConfig(velocity=False, rotation=False)},
        {"dynamics": FieldConfig(appearance="fixed")},
        {"motion": "field", "gradient_frames": 1, "begin": "simulation"},
        {"motion": "deformation", "regularization": RegularizationWeights(without=("xyz", "vel", "rot"))},
        {"collisions": False, "weights": "cosine"},
        {"regularization": RegularizationWeights(without=("app",), times=0.1), "weights": "constant"},
    ],
    ids=["nfsd", "bridge", "w/o PG", "w/o App", "paper's code", "w/o Motion", "w/o CH", "w/o L_app"],
)
def test_every_ablation_of_the_paper_trains_and_opens(trained: Path, prior: Path, tmp_path: Path, flags):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    pipeline = opened(train(tiny_config(scene, prior, tmp_path, steps=2, **flags)))
    model = pipeline.model
    assert any(bool(p.any()) for name, p in model.field.named_parameters() if "heads" in name), "something was learned"
    assert at(pipeline, 1.0).isfinite().all()
    if flags.get("collisions") is False:
        assert not model.history.collided.any()
    if flags.get("dynamics") == FieldConfig(velocity=False, rotation=False):
        offsets = [instant.offset.abs().max() for instant in model.rollout.frames() if len(instant.offset)]
        assert max(offsets) == 0


def test_an_interrupted_training_keeps_what_it_has_learned(
    trained: Path, prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    from pgsd_nerfstudio.plugin.pipeline import WeatherPipeline

    step_before = WeatherPipeline.get_train_loss_dict

    def interrupted(self: WeatherPipeline, step: int):
        if step == 2:
            raise KeyboardInterrupt
        return step_before(self, step)

    monkeypatch.setattr(WeatherPipeline, "get_train_loss_dict", interrupted)
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    with pytest.raises(SystemExit, match="130"):
        train(tiny_config(scene, prior, tmp_path))
    config = tmp_path / "floor/pgsd-weather/now/config.yml"
    assert "--load-dir" in capsys.readouterr().out
    assert [path.name for path in (config.parent / "nerfstudio_models").iterdir()] == ["step-000000001.ckpt"]
    opened(config)


def test_ctrl_c_before_training_leaves_nothing_and_ends_with_130(
    prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pgsd_nerfstudio.plugin.pipeline.prepare_weather", interrupted)
    with pytest.raises(SystemExit, match="130"):
        train(tiny_config(write_scene(tmp_path), prior, tmp_path / "outputs"))
    assert "Interrupted before training began" in capsys.readouterr().out
    assert not (tmp_path / "outputs").exists()


def test_a_full_disk_is_said_in_a_sentence(prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from pgsd_nerfstudio.physics.record.history import ParticleHistory

    def full(self: ParticleHistory, path: Path) -> None:
        raise OSError(f"could not write {path}: No space left on device")

    monkeypatch.setattr(ParticleHistory, "save", full)
    with pytest.raises(
        RunError, match=r"could not be stored with the run: could not write .*motion_prior\.safetensors: No space"
    ):
        train(tiny_config(write_scene(tmp_path), prior, tmp_path / "outputs"))
    assert not (tmp_path / "outputs").exists(), "a run that is refused leaves no folder"


def test_a_prior_that_predicts_nan_skips_its_step_and_is_given_up_after_three_with_a_checkpoint(
    trained: Path, prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from pgsd_nerfstudio.guidance import CogVideoXPrior

    whole, calls = CogVideoXPrior.predict_v, []

    def broken_at_first(self: CogVideoXPrior, noisy: torch.Tensor, timestep: int, text: torch.Tensor) -> torch.Tensor:
        calls.append(timestep)
        return whole(self, noisy, timestep, text) * (float("nan") if len(calls) == 1 or forever else 1.0)

    monkeypatch.setattr(CogVideoXPrior, "predict_v", broken_at_first)
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    forever = False
    opened(train(tiny_config(scene, prior, tmp_path / "once")))
    forever = True
    with pytest.raises(RunError, match=r"3 steps in a row gave nothing: .* NaN"):
        train(tiny_config(scene, prior, tmp_path / "forever", steps=9))
    assert list((tmp_path / "forever").rglob("step-*.ckpt")), "what was learned before is kept"


def test_weather_shorter_than_a_clip_is_refused(prior: Path, tmp_path: Path):
    with pytest.raises(RunError, match=r"the weather has 3 frames .* a training clip 5"):
        train(tiny_config(write_scene(tmp_path), prior, tmp_path / "outputs", seconds=0.12))
    assert not (tmp_path / "outputs").exists()


def test_a_folder_that_is_no_video_prior_is_refused_before_anything_is_simulated(tmp_path: Path):
    (tmp_path / "outputs/mine").mkdir(parents=True)
    with pytest.raises(RunError, match="CogVideoX"):
        train(tiny_config(write_scene(tmp_path), tmp_path, tmp_path / "outputs"))
    assert [path.name for path in (tmp_path / "outputs").rglob("*")] == ["mine"], "what was there stays, and nothing else"


def test_ns_eval_writes_plain_numbers(run: Path, tmp_path: Path):
    from nerfstudio.scripts.eval import ComputePSNR

    ComputePSNR(run, tmp_path / "eval.json", tmp_path / "pictures").main()
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert {"fps", "changed_by_weather", "drift_m"} <= set(results) and all(isinstance(v, float) for v in results.values())
    assert 0 < results["drift_m"] < 0.1 and results["changed_by_weather"] > 0
    assert len(list((tmp_path / "pictures").iterdir())) == VIEWS


def test_ns_export_writes_scene_and_weather_as_one_splat(run: Path, tmp_path: Path):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    from pgsd_nerfstudio.response.baked import baked
    from pgsd_nerfstudio.scene.splats.reading import read_splat

    ExportGaussianSplat(load_config=run, output_dir=tmp_path).main()
    pipeline = opened(run)
    scene, weather = pipeline.model.prepared.scene.gaussians, pipeline.model.weather_at(FRAMES - 1)
    stored = read_splat(tmp_path / "splat.ply").gaussians
    visible = weather.opacities > 1 / 255
    assert len(stored) == len(scene) + int(visible.sum()) and len(weather) > 50
    torch.testing.assert_close(stored.means[: len(scene)], scene.means)
    answered = baked(pipeline.model.moment(FRAMES - 1), scene)
    assert float((answered.colors - scene.colors).abs().max()) > 0.1
    torch.testing.assert_close(stored.colors[: len(scene), 0], answered.colors[:, 0], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(stored.scales[len(scene) :], weather.scales[visible], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(stored.opacities[len(scene) :], weather.opacities[visible], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(0.5 + 0.28209479 * stored.colors[len(scene) :, 0], weather.colors[visible], rtol=1e-3, atol=1e-4)


def test_ns_render_writes_all_four_kinds_of_video(run: Path, tmp_path: Path):
    from nerfstudio.scripts.render import DatasetRender, RenderCameraPath, RenderInterpolated, SpiralRender

    # Odd sizes lose a row or column: videos of 4:4:4, which they would have, are shown by few players.
    RenderInterpolated(run, tmp_path / "interpolate.mp4", interpolation_steps=2, downscale_factor=48 / 33).main()
    SpiralRender(run, tmp_path / "spiral.mp4", seconds=0.25).main()
    keyframes = [{**one_frame(run), "render_time": time} for time in (0.0, 0.5, 1.0)]
    path = {"render_width": 47, "render_height": 31, "seconds": 0.2, "camera_path": keyframes}
    (tmp_path / "path.json").write_text(json.dumps(path))
    RenderCameraPath(run, tmp_path / "path.mp4", camera_path_filename=tmp_path / "path.json").main()
    views = round(2.4 * 0.8)
    expected = {"interpolate.mp4": (2 * (views - 1), (32, 22)), "spiral.mp4": (6, (48, 32)), "path.mp4": (3, (46, 30))}
    for name, (frames, size) in expected.items():
        stream = media(tmp_path / name)
        assert (stream["pix_fmt"].split("(")[0], stream["size"], stream["frames"]) == ("yuv420p", size, frames), name
    DatasetRender(run, tmp_path / "dataset", image_format="png", downscale_factor=2).main()
    for name in ("rgb", "gt-rgb"):
        pictures = list((tmp_path / "dataset/test" / name).iterdir())
        assert len(pictures) == views and Image.open(pictures[0]).size == (WIDTH // 2, HEIGHT // 2)


def media(video: Path) -> dict:
    reader = imageio_ffmpeg.read_frames(str(video))
    return {**next(reader), "frames": sum(1 for _ in reader)}


def one_frame(run: Path) -> dict:
    """A frame of a camera path, without a time."""
    capture = yaml.load(run.read_text(), Loader=yaml.Loader).run.scene.load_scene.parent / "transforms.json"
    pose = json.loads(capture.read_text())["frames"][0]["transform_matrix"]
    return {"camera_to_world": np.ravel(pose).tolist(), "fov": 50, "aspect": 1.5}


def test_pictures_with_alpha_show_the_scene_alone(run: Path, tmp_path: Path):
    from nerfstudio.scripts.render import RenderCameraPath

    path = {"render_width": 48, "render_height": 32, "seconds": 0.2, "camera_path": [one_frame(run)]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    how = {"rendered_output_names": ["rgba"], "camera_path_filename": tmp_path / "path.json"}
    RenderCameraPath(run, tmp_path / "path", output_format="images", image_format="png", **how).main()
    rgba = np.asarray(Image.open(tmp_path / "path/00000.png"), dtype=float) / 255
    outputs = opened(run).model.get_outputs_for_camera(get_path_from_json(path))
    rgb, behind = outputs["rgb"].numpy(), outputs["background"].numpy()
    assert rgba[..., 3].min() < 0.9 < rgba[..., 3].max()
    assert np.abs(rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:]) - rgb).max() < 1.5 / 255
    with pytest.raises(ValueError) as failed:
        RenderCameraPath(run, tmp_path / "path.mp4", **how).main()
    assert explained(failed.value, failed.tb) == "a video has no alpha: for rgba add --output-format images --image-format png"


def copied(run: Path, tmp_path: Path) -> Path:
    """A copy of the run elsewhere; returns its config.yml."""
    folder = tmp_path / run.parent.relative_to(run.parents[4])
    shutil.copytree(run.parent, folder)
    return folder / "config.yml"


def test_a_training_says_how_much_drift_its_clips_do_not_see(prior, tmp_path, capsys):
    config = train(tiny_config(write_scene(tmp_path), prior, tmp_path / "outputs", lr=0.05))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Drift of clips")]
    found = opened(config).drift_gaps()
    assert len(lines) == 2 and list(found) == ["simulation", "rollout"]
    for line, name, gap in zip(lines, ("simulation", "roll-out"), found.values(), strict=True):
        numbers = (f"{1000 * value:.2f} mm" for value in (gap.clips, gap.rollout, gap.difference))
        assert line == "Drift of clips that begin at the {}: {}, of the whole video at the same frames {}: unseen {}".format(
            name, *numbers
        )
    assert found["simulation"].difference > 1e-4 and found["rollout"].difference == pytest.approx(0.0, abs=1e-6)


def test_a_model_of_another_family_teaches_too(tmp_path: Path):
    wan = tmp_path / "wan"
    tiny_wan().save_pretrained(wan)
    small = {"clip_frames": 5, "clip_height": 32, "clip_width": 48, "steps": 2}
    config = train(tiny_config(write_scene(tmp_path), wan, tmp_path / "outputs", **small))
    state = torch.load(next(config.parent.glob("nerfstudio_models/*.ckpt")))["pipeline"]
    assert all(bool(value.any()) for key, value in state.items() if "_model.look" in key), "the learned look has left its start"
