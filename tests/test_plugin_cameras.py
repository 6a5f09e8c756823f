"""Cameras between nerfstudio and us, and those of a splatfacto run."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.cameras.cameras import CameraType

from pgsd_nerfstudio.plugin.run_cameras import DATAPARSERS, from_nerfstudio, run_cameras, to_nerfstudio
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.weather.loading import load_scene


def some_cameras() -> Cameras:
    generator = torch.Generator().manual_seed(0)
    c2w = torch.eye(4).repeat(3, 1, 1)
    c2w[:, :3, :3] = torch.linalg.qr(torch.randn(3, 3, 3, generator=generator))[0]
    c2w[:, :3, 3] = torch.randn(3, 3, generator=generator)
    Ks = torch.tensor([[50.0, 0, 21], [0, 52, 17], [0, 0, 1]]).repeat(3, 1, 1)
    return Cameras.from_opengl(c2w, Ks, 40, 30)


def test_cameras_survive_the_way_to_nerfstudio_and_back():
    ours = some_cameras()
    back = from_nerfstudio(to_nerfstudio(ours, torch.linspace(0, 1, 3)))
    assert (back.width, back.height) == (40, 30)
    torch.testing.assert_close(back.viewmats, ours.viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.Ks, ours.Ks)


def test_a_ray_of_nerfstudio_hits_the_same_pixel():
    ours = some_cameras()
    bundle = to_nerfstudio(ours).generate_rays(camera_indices=1)
    point = bundle.origins[7, 11] + 2.5 * bundle.directions[7, 11]
    local = ours.viewmats[1] @ torch.cat([point, torch.ones(1)])
    x, y, depth = ours.Ks[1] @ local[:3]
    torch.testing.assert_close(torch.stack([x / depth, y / depth]), torch.tensor([11.5, 7.5]), atol=1e-3, rtol=0)


def test_cameras_of_several_sizes_take_the_most_frequent_one():
    c2w = torch.eye(4)[:3].repeat(3, 1, 1)
    sizes = torch.tensor([40, 80, 40]), torch.tensor([30, 60, 30])
    focal = torch.tensor([50.0, 100, 50])
    mixed = NerfstudioCameras(c2w, focal, focal, sizes[0] / 2, sizes[1] / 2, *sizes)
    ours = from_nerfstudio(mixed)
    assert (ours.width, ours.height) == (40, 30)
    torch.testing.assert_close(ours.Ks[1], ours.Ks[0])


def test_a_panorama_is_refused_in_a_sentence():
    panorama = NerfstudioCameras(torch.eye(4)[None, :3], 50.0, 50.0, 20.0, 15.0, camera_type=CameraType.EQUIRECTANGULAR)
    with pytest.raises(SceneError, match="perspective"):
        from_nerfstudio(panorama)


def test_the_cameras_of_a_run_look_at_its_splat(splatfacto_run: Path, garden_ply: Path, garden_data: Path):
    scene, bare = load_scene(splatfacto_run), load_scene(garden_ply, garden_data)
    photographs = {path.name: i for i, path in enumerate(bare.images)}
    same = torch.tensor([photographs[path.name] for path in scene.images])
    # In their own camera's axes both splats are the same, up to the run's scale.
    size = (scene.gaussians.means[1] - scene.gaussians.means[0]).norm() / (
        bare.gaussians.means[1] - bare.gaussians.means[0]
    ).norm()

    def seen(which, index: int) -> torch.Tensor:
        viewmat = which.cameras.viewmats[index]
        return which.gaussians.means[::500] @ viewmat[:3, :3].T + viewmat[:3, 3]

    for index in (0, len(same) // 2):
        torch.testing.assert_close(seen(scene, index), size * seen(bare, int(same[index])), atol=2e-3, rtol=1e-3)


def test_after_a_checkpoint_was_read_nerfstudios_own_can_be_loaded_still(splatfacto_run: Path, tmp_path: Path):
    torch.save({"lr": np.float64(0.25)}, tmp_path / "step.ckpt")
    load_scene(splatfacto_run)
    assert torch.load(tmp_path / "step.ckpt")["lr"] == 0.25


def rewritten(run: Path, config_path: Path, *changes: tuple[str, str]) -> Path:
    """A copy of a run's config.yml with some of its text replaced, each piece where it stands first."""
    text = (run / "config.yml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    config_path.parent.mkdir(parents=True, exist_ok=True)
    config_path.write_text(text)
    return config_path


def saved_data(path: Path) -> str:
    """How PyYAML writes a path."""
    return "!!python/object/apply:pathlib.PosixPath\n" + "\n".join(f"- {part}" for part in path.parts)


def test_a_run_whose_photographs_moved_says_so(splatfacto_run: Path, garden_data: Path, tmp_path: Path):
    gone = (saved_data(garden_data), saved_data(tmp_path / "gone"))
    with pytest.raises(SceneError, match=r"photographs of .* no longer at .*gone.*data="):
        run_cameras(rewritten(splatfacto_run, tmp_path / "config.yml", gone))


@pytest.mark.parametrize("saved", ["captures/garden", "/elsewhere/project/captures/garden"])
def test_data_is_found_relative_to_a_folder_above_the_run(splatfacto_run: Path, garden_data: Path, tmp_path: Path, saved: str):
    run = rewritten(
        splatfacto_run, tmp_path / "outputs" / "run" / "config.yml", (saved_data(garden_data), saved_data(Path(saved)))
    )
    (tmp_path / "captures" / "garden").mkdir(parents=True)
    shutil.copy(garden_data / "transforms.json", tmp_path / "captures" / "garden")
    (tmp_path / "captures" / "garden" / "images").symlink_to(garden_data / "images")
    capture = run_cameras(run)
    assert len(capture) == len(capture.photographs) > 100
    assert capture.photographs[0].path.is_relative_to(tmp_path)


PARSER = "nerfstudio.data.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig"


def test_a_config_from_anybody_runs_nothing_but_a_dataparser_that_reads_cameras(splatfacto_run: Path, tmp_path: Path):
    """nerfstudio's reader would make the folder as it reads the file; a target, as it makes what it has read."""
    evidence = tmp_path / "evidence"
    call = f"!!python/object/apply:os.mkdir [{evidence}]"
    target = "dataparser: !!python/object:" + PARSER + "\n      _target: "
    hostile = rewritten(
        splatfacto_run,
        tmp_path / "config.yml",
        ("experiment_name: garden", f"experiment_name: {call}"),
        (
            f"{target}!!python/name:nerfstudio.data.dataparsers.nerfstudio_dataparser.Nerfstudio ''",
            f"{target}!!python/name:os.mkdir ''",
        ),
    )
    assert len(run_cameras(hostile)) > 100
    assert not evidence.exists()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            PARSER,
            "nerfstudio.data.dataparsers.minimal_dataparser.MinimalDataParserConfig",
            "asks for the dataparser nerfstudio",
        ),
        (PARSER, "os.path.Nothing", r"asks for the dataparser os\.path\.Nothing, which is not run .*pass data="),
        ("center_method: poses", "center_method: !!python/object:os.PathLike {}", "center_method of its dataparser"),
        ("      scale_factor: 1.0", "      scale_factor: many", r"could not read .*pass data="),
        ("eval_mode: fraction", "eval_mode: nothing", r"could not read .*pass data="),
    ],
)
def test_what_no_dataparser_can_be_made_of_is_refused_in_a_sentence(splatfacto_run: Path, tmp_path: Path, old, new, sentence):
    with pytest.raises(SceneError, match=sentence):
        run_cameras(rewritten(splatfacto_run, tmp_path / "config.yml", (old, new)))


@pytest.mark.parametrize(
    "text", ["just words", "- [", "!!python/object:nowhere.Config {}", "!!python/object:a.B {pipeline: 1}"]
)
def test_what_is_no_config_is_refused_in_a_sentence(text: str, tmp_path: Path):
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(SceneError, match=r"config\.yml"):
        run_cameras(tmp_path / "config.yml")


def test_all_dataparsers_that_are_run_exist():
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    offered = {f"{type(config).__module__}.{type(config).__name__}" for config in all_dataparsers.values()}
    assert offered >= DATAPARSERS
