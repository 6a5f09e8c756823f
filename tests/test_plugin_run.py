"""A run from training to video, through nerfstudio's own classes; trained once, in three steps."""

import importlib
import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from plugin_scene import HEIGHT, VIEWS, WIDTH, grouped, tiny_config, train, write_scene
from wan_tiny import tiny_wan

from pgsd_nerfstudio.dynamics import FieldConfig, RegularizationWeights
from pgsd_nerfstudio.guidance.distillation import DistillationConfig
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny
from pgsd_nerfstudio.plugin.environment import RunError
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
    assert float((at(pipeline, 0.5) - snowed).abs().max()) > 0.05
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


def test_training_goes_on_from_a_checkpoint(trained: Path, prior: Path, tmp_path: Path):
    scene = yaml.load(trained.read_text(), Loader=yaml.Loader).run.scene.load_scene
    more = train(tiny_config(scene, prior, tmp_path, steps=1, load_dir=trained.parent / "nerfstudio_models"))
    assert [path.name for path in (more.parent / "nerfstudio_models").iterdir()] == ["step-000000003.ckpt"]


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
        part = train(tiny_config(scene, prior, tmp_path / "part", steps=6, seconds=2.4))
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
    config = train(tiny_config(scene, prior, tmp_path))
    assert "--load-dir" in capsys.readouterr().out
    assert [path.name for path in (config.parent / "nerfstudio_models").iterdir()] == ["step-000000001.ckpt"]
    opened(config)


def test_a_full_disk_is_said_in_a_sentence(prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from pgsd_nerfstudio.physics.record.history import ParticleHistory

    def full(self: ParticleHistory, path: Path) -> None:
        raise OSError(f"could not write {path}: No space left on device")

    monkeypatch.setattr(ParticleHistory, "save", full)
    with pytest.raises(RunError, match=r"could not be made: could not write .*motion_prior\.safetensors: No space left"):
        train(tiny_config(write_scene(tmp_path), prior, tmp_path))


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
        train(tiny_config(write_scene(tmp_path), prior, tmp_path, seconds=0.12))


def test_a_folder_that_is_no_video_prior_is_refused_before_anything_is_simulated(tmp_path: Path):
    with pytest.raises(RunError, match="CogVideoX"):
        train(tiny_config(write_scene(tmp_path), tmp_path, tmp_path / "outputs"))


def test_ns_eval_writes_plain_numbers(run: Path, tmp_path: Path):
    from nerfstudio.scripts.eval import ComputePSNR

    ComputePSNR(run, tmp_path / "eval.json", tmp_path / "pictures").main()
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert {"fps", "changed_by_weather", "drift_m"} <= set(results) and all(isinstance(v, float) for v in results.values())
    assert 0 < results["drift_m"] < 0.1 and results["changed_by_weather"] > 0
    assert len(list((tmp_path / "pictures").iterdir())) == VIEWS


def test_ns_export_writes_scene_and_weather_as_one_splat(run: Path, tmp_path: Path):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    from pgsd_nerfstudio.response.answer import baked
    from pgsd_nerfstudio.scene.splats.ply import read_ply

    ExportGaussianSplat(load_config=run, output_dir=tmp_path).main()
    pipeline = opened(run)
    scene, weather = pipeline.model.prepared.scene.gaussians, pipeline.model.weather_at(FRAMES - 1)
    stored = read_ply(tmp_path / "splat.ply")
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
    import imageio_ffmpeg
    from nerfstudio.scripts.render import DatasetRender, RenderCameraPath, RenderInterpolated, SpiralRender

    RenderInterpolated(run, tmp_path / "interpolate.mp4", interpolation_steps=2).main()
    SpiralRender(run, tmp_path / "spiral.mp4", seconds=0.25).main()
    matrix = opened(run).model.prepared.scene.cameras.opengl()[0].flatten().tolist()
    keyframes = [{"camera_to_world": matrix, "fov": 50, "aspect": 1.5, "render_time": time} for time in (0.0, 0.5, 1.0)]
    path = {"render_width": 48, "render_height": 32, "seconds": 0.2, "camera_path": keyframes}
    (tmp_path / "path.json").write_text(json.dumps(path))
    RenderCameraPath(run, tmp_path / "path.mp4", camera_path_filename=tmp_path / "path.json").main()
    frames = {path.name: imageio_ffmpeg.count_frames_and_secs(str(path))[0] for path in tmp_path.glob("*.mp4")}
    assert frames == {"interpolate.mp4": 2 * (VIEWS - 1), "spiral.mp4": 6, "path.mp4": 3}
    DatasetRender(run, tmp_path / "dataset", image_format="png").main()
    assert (
        len(list((tmp_path / "dataset/test/rgb").iterdir())) == len(list((tmp_path / "dataset/test/gt-rgb").iterdir())) == VIEWS
    )


def copied(run: Path, tmp_path: Path) -> Path:
    """A copy of the run elsewhere; returns its config.yml."""
    folder = tmp_path / run.parent.relative_to(run.parents[4])
    shutil.copytree(run.parent, folder)
    config = folder / "config.yml"
    loaded = yaml.load(config.read_text(), Loader=yaml.Loader)
    loaded.output_dir = folder.parents[2]
    config.write_text(yaml.dump(loaded))
    return config


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
