"""Every kind of file gives the same scene, and every unusable one gives one sentence."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.capture import in_run, read_capture
from pgsd_nerfstudio.scene.loading import load_scene
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.splats.checkpoint import read_checkpoint
from pgsd_nerfstudio.scene.splats.ply import read_ply


def write_ply(path: Path, n: int = 5, degree: int = 0, drop: str = "", **values) -> np.ndarray:
    """A small splat; returns its structured array."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros(n, [(name, "f4") for name in names if name != drop])
    generator = np.random.default_rng(1)
    for name in table.dtype.names:
        table[name] = values.get(name, generator.normal(size=n))
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return table


def write_capture(path: Path, **changes) -> Path:
    """transforms.json of four cameras around the origin; `changes` replace its entries."""
    frames = []
    for index, angle in enumerate(np.arange(4) * np.pi / 2):
        back = np.array([np.cos(angle), np.sin(angle), 0.0])  # OpenGL cameras look along -z
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 3 * back], axis=1)
        frames.append({"file_path": f"images/{index}.jpg", "transform_matrix": pose.tolist()})
    meta = {"camera_model": "OPENCV", "fl_x": 100.0, "fl_y": 90.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "frames": frames}
    path.write_text(json.dumps({name: value for name, value in (meta | changes).items() if value is not None}))
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_keeps_every_field(tmp_path, degree):
    table = write_ply(tmp_path / "a.ply", degree=degree)
    read = read_ply(tmp_path / "a.ply")
    coefficients = (degree + 1) ** 2
    assert read.sh_degree == degree
    assert read.means[:, 1].numpy() == pytest.approx(table["y"])
    assert read.scales[:, 2].numpy() == pytest.approx(np.exp(table["scale_2"]), rel=1e-6)
    assert read.opacities.numpy() == pytest.approx(1 / (1 + np.exp(-table["opacity"])), rel=1e-6)
    rotation = np.stack([table[f"rot_{i}"] for i in range(4)], 1)
    assert read.quats.numpy() == pytest.approx(rotation / np.linalg.norm(rotation, axis=1, keepdims=True), rel=1e-5)
    assert read.colors[:, 0, 2].numpy() == pytest.approx(table["f_dc_2"])
    for channel in range(3):
        for k in range(1, coefficients):
            field = f"f_rest_{channel * (coefficients - 1) + k - 1}"
            assert read.colors[:, k, channel].numpy() == pytest.approx(table[field]), field


def test_a_ply_without_data_asks_for_it(tmp_path):
    write_ply(tmp_path / "a.ply")
    with pytest.raises(SceneError, match="pass --data"):
        load_scene(tmp_path / "a.ply")


def test_a_point_cloud_is_no_splat(tmp_path):
    table = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "cloud.ply"))
    with pytest.raises(SceneError, match=r"no 3D Gaussian splat: it lacks the fields f_dc_0, .*ns-train splatfacto"):
        load_scene(tmp_path / "cloud.ply", write_capture(tmp_path / "transforms.json"))


def test_unusable_plys_say_why(tmp_path):
    data = write_capture(tmp_path / "transforms.json")
    write_ply(tmp_path / "empty.ply", n=0)
    write_ply(tmp_path / "nan.ply", scale_1=[0, np.nan, np.inf, 0, 0])
    write_ply(tmp_path / "huge.ply", scale_1=100.0)
    write_ply(tmp_path / "unturned.ply", rot_0=0.0, rot_1=0.0, rot_2=0.0, rot_3=0.0)
    write_ply(tmp_path / "odd.ply", degree=1, drop="f_rest_4")
    write_ply(tmp_path / "whole.ply", n=100)
    (tmp_path / "cut.ply").write_bytes((tmp_path / "whole.ply").read_bytes()[:-100])
    (tmp_path / "text.ply").write_text("hello")
    expected = {
        "empty": "empty scene: it holds 0 Gaussians",
        "nan": r"2 values of its log scales \(scale_\*\) are NaN or infinite",
        "huge": "scales are NaN or infinite once activated",
        "unturned": "5 of its rotations are quaternions of length 0",
        "odd": "has 8 f_rest fields",
        "cut": "cannot be read as a .ply",
        "text": "cannot be read as a .ply",
        "missing": "no scene at",
    }
    for name, sentence in expected.items():
        with pytest.raises(SceneError, match=sentence) as refusal:
            load_scene(tmp_path / f"{name}.ply", data)
        assert f"{name}.ply" in str(refusal.value) and "\n" not in str(refusal.value)


def test_unusable_data_says_why(tmp_path):
    write_ply(tmp_path / "a.ply")
    data = tmp_path / "transforms.json"
    nan_pose = {"file_path": "a.jpg", "transform_matrix": np.full((4, 4), np.nan).tolist()}
    for changes, sentence in [
        ({"frames": []}, "has no cameras"),
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE cameras; undistort"),
        ({"fl_x": None}, "fl_x must be positive pixel numbers"),
        ({"w": 0}, "w must be positive pixel numbers"),
        ({"frames": [{"file_path": "a.jpg"}]}, "a.jpg needs a 4x4 transform_matrix"),
        ({"frames": [nan_pose]}, "transform_matrix of a.jpg holds a NaN"),
    ]:
        with pytest.raises(SceneError, match=sentence):
            load_scene(tmp_path / "a.ply", write_capture(data, **changes))
    data.write_text("{")
    with pytest.raises(SceneError, match="cannot be read as JSON"):
        load_scene(tmp_path / "a.ply", data)
    with pytest.raises(SceneError, match="no data at"):
        load_scene(tmp_path / "a.ply", tmp_path / "nowhere")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SceneError, match=r"no cameras at .*ns-process-data"):
        load_scene(tmp_path / "a.ply", tmp_path / "folder")


def test_the_scale_given_must_be_positive(tmp_path):
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(SceneError, match="positive number"):
            load_scene("demo", metres_per_unit=wrong)


def test_capture_poses_are_opengl_and_sorted_by_name(tmp_path):
    frames = json.loads(write_capture(tmp_path / "transforms.json").read_text())["frames"]
    cameras, images = read_capture(write_capture(tmp_path / "transforms.json", frames=frames[::-1]))
    assert [image.name for image in images] == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    assert images[0].parent == tmp_path / "images"
    assert cameras.centers[1].tolist() == pytest.approx([0, 3, 0], abs=1e-6)
    seen = cameras.viewmats @ torch.tensor([0.0, 0.0, 1.0, 1.0])  # one unit above what all look at
    assert seen[:, :3].numpy() == pytest.approx(np.tile([0, -1, 3], (4, 1)), abs=1e-5)
    assert cameras.Ks[0].tolist() == [[100, 0, 32], [0, 90, 24], [0, 0, 1]]


def test_intrinsics_of_single_frames_and_of_other_image_sizes(tmp_path):
    meta = json.loads(write_capture(tmp_path / "transforms.json").read_text())
    own = {name: meta.pop(name) for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for frame in meta["frames"]:
        frame.update(own)
    meta["frames"][2].update({name: 2 * value for name, value in own.items()})
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    cameras, _ = read_capture(tmp_path)
    assert (cameras.width, cameras.height) == (64, 48)
    assert torch.equal(cameras.Ks, torch.tensor([[100.0, 0, 32], [0, 90, 24], [0, 0, 1]]).expand(4, 3, 3))


def test_cameras_follow_the_dataparser_of_a_run(tmp_path):
    """A dataparser that undoes the transform and scale which ns-process-data applied gives back the original poses."""
    applied = np.array([[0.0, 0, 2, 1], [1, 0, 0, 2], [0, 1, 0, 3]]) / [[2, 2, 2, 1], [1, 1, 1, 1], [1, 1, 1, 1]]
    data = write_capture(tmp_path / "transforms.json", applied_transform=applied.tolist(), applied_scale=4.0)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 2.0}))
    saved, _ = read_capture(data)
    found = in_run(saved, data, tmp_path / "dataparser_transforms.json")
    original = np.linalg.solve(applied[:, :3], saved.centers.numpy().T - applied[:, 3:]).T
    assert found.centers.numpy() == pytest.approx(original * 2.0 / 4.0, abs=1e-5)
    looked_at = np.linalg.solve(applied[:, :3], -applied[:, 3]) * 2.0 / 4.0  # where the saved origin is in the run
    seen = found.viewmats @ torch.tensor([*looked_at, 1.0], dtype=torch.float32)
    assert seen[:, :3].numpy() == pytest.approx(np.tile([0, 0, 1.5], (4, 1)), abs=1e-5)


def test_a_checkpoint_that_would_run_code_is_not_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "sprung",)

    torch.save({"pipeline": Trap()}, tmp_path / "trap.ckpt")
    (tmp_path / "pickle.ckpt").write_bytes(pickle.dumps(Trap()))
    (tmp_path / "text.ckpt").write_text("hello")
    for name in ("trap", "pickle", "text"):
        with pytest.raises(SceneError, match=f"{name}.ckpt"):
            load_scene(tmp_path / f"{name}.ckpt")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("prefix", ["_model.gauss_params.", "_model.", "module._model.", "_model.module.gauss_params."])
def test_checkpoints_of_older_and_parallel_runs(tmp_path, prefix):
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (4, 3), "scales": (4, 3), "quats": (4, 4), "features_dc": (4, 3), "features_rest": (4, 15, 3)}
    raw = {name: torch.randn(shape, generator=generator) for name, shape in {**shapes, "opacities": (4, 1)}.items()}
    torch.save({"pipeline": {f"{prefix}{name}": value for name, value in raw.items()}}, tmp_path / "a.ckpt")
    read = read_checkpoint(tmp_path / "a.ckpt")
    assert read.sh_degree == 3
    assert torch.equal(read.means, raw["means"]) and torch.equal(read.colors[:, 1:], raw["features_rest"])
    assert torch.equal(read.scales, raw["scales"].exp()) and torch.equal(read.opacities, raw["opacities"][:, 0].sigmoid())
    del raw["quats"]
    torch.save({"pipeline": {f"{prefix}{name}": value for name, value in raw.items()}}, tmp_path / "a.ckpt")
    with pytest.raises(SceneError, match=r"holds no Gaussians \(quats not found\)"):
        read_checkpoint(tmp_path / "a.ckpt")


def test_checkpoints_of_other_methods_and_untrained_runs_say_why(tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    torch.save({"pipeline": {"_model.field.mlp": torch.zeros(3)}}, tmp_path / "nerfstudio_models" / "nerf.ckpt")
    with pytest.raises(SceneError, match="holds no Gaussians"):
        load_scene(tmp_path / "nerfstudio_models" / "nerf.ckpt")
    (tmp_path / "config.yml").write_text("")
    with pytest.raises(SceneError, match="no trained run"):
        load_scene(tmp_path)
    with pytest.raises(SceneError, match="no scene: expected"):
        load_scene(Path(__file__))


def test_the_garden_from_its_ply(garden_ply, garden_data):
    scene = load_scene(garden_ply, garden_data)
    assert len(scene.gaussians) == 120_000 and scene.gaussians.sh_degree == 1
    assert len(scene.cameras) == len(scene.images) == 185 and scene.images[0].is_file()
    assert (scene.cameras.width, scene.cameras.height) == (512, 512)
    assert (scene.name, scene.description) == ("garden", "a garden")
    assert scene.content_key() == load_scene(garden_ply, garden_data / "transforms.json").content_key()
    assert scene.content_key() != load_scene(garden_ply, garden_data, metres_per_unit=1.0).content_key()


def test_a_run_shows_the_garden_where_its_ply_does(splatfacto_run, garden_ply, garden_data, tmp_path, monkeypatch):
    """The splat as seen from the cameras does not depend on the coordinates in which it was stored."""
    plain = load_scene(garden_ply, garden_data)
    for path in (splatfacto_run, splatfacto_run / "config.yml", next(splatfacto_run.glob("nerfstudio_models/*.ckpt"))):
        run = load_scene(path, garden_data)
        assert run.name == "garden" and run.images == plain.images
        assert run.gaussians.colors.shape == plain.gaussians.colors.shape
        scale = json.loads((splatfacto_run / "dataparser_transforms.json").read_text())["scale"]
        seen = _in_cameras(plain), _in_cameras(run) / scale
        assert (seen[0] - seen[1]).norm() < 1e-5 * seen[0].norm()
        assert (run.gaussians.colors[:, 0] - plain.gaussians.colors[:, 0]).abs().max() < 1e-6
        assert run.frame.metres_per_unit * scale == pytest.approx(plain.frame.metres_per_unit, rel=0.02)
    pictures = [
        choose_rasterizer(scene.gaussians, "cpu").render(scene.cameras[40].resized(96, 96)).rgb for scene in (plain, run)
    ]
    assert (pictures[0] - pictures[1]).norm() < 0.01 * pictures[0].norm()  # spherical harmonics turn with the scene
    moved = tmp_path / "moved"
    shutil.copytree(splatfacto_run, moved)
    (moved / "dataparser_transforms.json").unlink()
    with pytest.raises(SceneError, match=r"dataparser_transforms\.json is missing"):
        load_scene(moved, garden_data)
    # Without --data the run's own dataparser is asked, which an entry point names; where none is installed, that is said.
    assert len(load_scene(moved).cameras) == 167  # nine tenths of the photographs train
    monkeypatch.setattr("pgsd_nerfstudio.scene.loading.entry_points", lambda group: ())
    with pytest.raises(SceneError, match=r"only nerfstudio reads the cameras of .* pass --data"):
        load_scene(moved)


def _in_cameras(scene):
    """Where some Gaussians lie for some cameras, in scene units."""
    views, points = scene.cameras.viewmats[::40], scene.gaussians.means[::100]
    return torch.einsum("tij,nj->tni", views[:, :3, :3], points) + views[:, None, :3, 3]
