"""Every kind of file gives the same scene, and every unusable one gives one sentence."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import ring, transforms, write_transforms
from plyfile import PlyData, PlyElement

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.captures.placements import run_placement
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.loading import read_scene
from pgsd_nerfstudio.scene.scene import SceneError


def write_ply(path: Path, n: int = 5, degree: int = 0, drop: str = "", double: bool = False, **values) -> np.ndarray:
    """A small splat; returns its structured array."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    kinds = {name: "f8" if double and name in "xyz" else "f4" for name in names}
    table = np.zeros(n, [(name, kinds[name]) for name in names if name != drop])
    generator = np.random.default_rng(1)
    for name in table.dtype.names:
        table[name] = values.get(name, generator.normal(size=n))
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return table


def test_a_ply_without_data_asks_for_it(tmp_path):
    write_ply(tmp_path / "a.ply")
    with pytest.raises(SceneError, match=r"holds no cameras: pass data= with .*or camera='orbit'.* up="):
        read_scene(tmp_path / "a.ply")


@pytest.mark.mistyped
def test_arguments_that_cannot_be_what_they_are(tmp_path):
    """Sentences speak of arguments, since Python knows no flags."""
    write_ply(tmp_path / "a.ply")
    ply, data = tmp_path / "a.ply", write_transforms(tmp_path / "transforms.json")
    scene = read_scene(ply, data)
    for arguments, sentence in [
        ((None,), "path must be the path of a file or folder, got NoneType"),
        ((scene,), "path must be the path of a file or folder, got Scene"),
        ((7,), "path must be the path of a file or folder, got int"),
        ((ply, scene), "data must be the path of a file or folder, got Scene"),
        ((ply, 1.5), "data must be the path of a file or folder, got float"),
    ]:
        with pytest.raises(TypeError, match=sentence):
            read_scene(*arguments)
    for wrong in (True, "2"):
        with pytest.raises(TypeError, match="metres_per_unit must be a number"):
            read_scene(ply, data, metres_per_unit=wrong)
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SceneError, match="positive number"):
            read_scene("demo", metres_per_unit=wrong)
    for wrong in ("w", "+z", "", (0, 0, 0), (1, 2), (0, 0, float("nan")), 7):
        with pytest.raises(SceneError, match="up must be one of x, y, z, -x, -y, -z, or three numbers"):
            read_scene(ply, data, up=wrong)
    for arguments, named, sentence in [
        (("",), {}, "path is empty"),
        (("  ",), {}, "path is empty"),
        ((ply, ""), {}, "data= is empty"),
        (("nowhere.ply",), {}, "no scene at nowhere.ply: expected a splatfacto run folder"),
        ((str(ply) + 5000 * "a",), {}, "no scene at"),
        (("a\0b",), {}, "no scene at a[?]b"),
        ((ply, tmp_path / "nowhere"), {}, "no data at .*transforms.json, a COLMAP folder, or a cameras.json"),
        ((ply, ply), {}, "data= must lead to cameras, got the splat"),
        (("demo", data), {}, "the demo has cameras of its own: leave data= and camera= out"),
        (("demo",), {"camera": "orbit"}, "the demo has cameras of its own"),
        ((ply, data), {"camera": "orbit"}, "leave one of the two out"),
        ((ply,), {"camera": "dolly"}, "camera must be 'orbit'"),
        ((data,), {}, "holds no splat: if these are its cameras, pass the splat with data="),
    ]:
        with pytest.raises(SceneError, match=sentence) as refusal:
            read_scene(*arguments, **named)
        assert "--" not in str(refusal.value)
    (tmp_path / "capture").mkdir()
    write_transforms(tmp_path / "capture" / "transforms.json")
    (tmp_path / "capture" / "sparse_pc.ply").touch()
    (tmp_path / "splats").mkdir()
    write_ply(tmp_path / "splats" / "b.ply")
    with pytest.raises(SceneError, match=r"is a folder: pass the splat in it, such as .*b\.ply, with data="):
        read_scene(tmp_path / "splats")
    with pytest.raises(
        SceneError, match=r"holds cameras, .* pass a splat that was trained on them, with data=.*ns-train splatfacto"
    ):
        read_scene(tmp_path / "capture")
    write_ply(tmp_path / "capture" / "b.ply")
    with pytest.raises(SceneError, match=r"pass a splat that was trained on them, such as .*/capture/b\.ply, with data="):
        read_scene(tmp_path / "capture")


def test_commands_speak_of_flags(tmp_path):
    from pgsd_nerfstudio.weather.options import SceneOptions

    write_ply(tmp_path / "data=.ply")
    for options, sentence in [
        (
            SceneOptions(load_scene=tmp_path / "data=.ply"),
            r"/data=\.ply holds no cameras: pass --data with .* or --camera orbit",
        ),
        (SceneOptions(load_scene=Path("demo"), data=tmp_path), "leave --data and --camera out"),
        (SceneOptions(load_scene=Path("demo"), camera="orbit", data=tmp_path), "leave --data and --camera out"),
    ]:
        with pytest.raises(SceneError, match=sentence):
            options.check()
            options.open()


def test_up_that_is_given_is_up(tmp_path):
    write_ply(tmp_path / "a.ply", n=200)
    data = write_transforms(tmp_path / "transforms.json")
    for up, direction in (("-y", [0, -1, 0]), ((0, 3, 4), [0, 0.6, 0.8])):
        frame = read_scene(tmp_path / "a.ply", data, up=up).frame
        assert (frame.rotation @ torch.tensor(direction, dtype=torch.float32)).tolist() == pytest.approx([0, 0, 1], abs=1e-6)
        assert "up is taken as" in frame.source
    assert read_scene("demo", up="x").frame.rotation[2].tolist() == pytest.approx([1, 0, 0], abs=1e-6)


def test_a_scale_that_puts_the_cameras_where_nobody_stands_is_doubted(tmp_path):
    """Drones fly at 100 m; no camera is at 1,000 m or at a millimetre. What is said gives the scale of a camera in the hand."""
    write_ply(tmp_path / "a.ply", n=200)
    data = write_transforms(tmp_path / "transforms.json")
    plain = read_scene(tmp_path / "a.ply", data)
    assert not any("is the scale right" in remark for remark in plain.remarks)
    per_metre = plain.frame.metres_per_unit / 1.5
    for height in (100.0, 0.05):
        scene = read_scene(tmp_path / "a.ply", data, metres_per_unit=height * per_metre)
        (remark,) = [remark for remark in scene.remarks if "is the scale right" in remark]
        assert f"the cameras stand {height:.3g} m above the ground" in remark
        assert f"at {plain.frame.metres_per_unit:.3g} m per unit they would stand 1.5 m above it" in remark
    for height, said in ((3000.0, "3,000"), (0.001, "0.001")):
        with pytest.raises(SceneError, match=rf"the cameras stand {said} m above the ground, where no camera can be"):
            read_scene(tmp_path / "a.ply", data, metres_per_unit=height * per_metre)
    with pytest.raises(SceneError, match="where no camera can be"):
        read_scene("demo", metres_per_unit=1e5)


def test_photographs_that_are_missing_are_counted(tmp_path):
    from captures import write_photographs

    write_ply(tmp_path / "a.ply")
    data = write_transforms(tmp_path / "transforms.json")
    (remark,) = read_scene(tmp_path / "a.ply", data).remarks
    assert remark.startswith(f"none of the 4 photographs is there, such as {tmp_path / 'images' / '0.jpg'}")
    write_photographs(tmp_path, ["images/0.jpg", "images/1.jpg", "images/3.jpg"])
    scene = read_scene(tmp_path / "a.ply", data)
    assert scene.remarks == (f"1 of the 4 photographs are missing, such as {tmp_path / 'images' / '2.jpg'}",)
    assert scene.photographed() == [0, 1, 3]


@pytest.mark.parametrize("far", ["both", "only the cameras"])
def test_georeferenced_scenes_lose_nothing(far, tmp_path):
    """Splat and cameras at UTM coordinates, in doubles, give the scene that lies at the origin, to a millimetre's hundredth."""
    place = np.array([500_123.25, 5_400_678.5, 312.25])
    generator = np.random.default_rng(4)
    centres = {axis: generator.normal(size=500).astype("f4").astype("f8") for axis in "xyz"}
    small = {f"scale_{i}": -5.0 for i in range(3)}
    write_ply(tmp_path / "near.ply", n=500, **centres, **small)
    near = read_scene(tmp_path / "near.ply", write_transforms(tmp_path / "near.json"))
    moved = {axis: centre + shift for (axis, centre), shift in zip(centres.items(), place, strict=True)}
    write_ply(tmp_path / "far.ply", n=500, double=True, **moved, **small)
    frames = transforms()["frames"]
    for frame, pose in zip(frames, ring(), strict=True):
        pose[:3, 3] += place
        frame["transform_matrix"] = pose.tolist()
    data = write_transforms(tmp_path / "far.json", frames=frames)
    found = read_scene(tmp_path / ("far.ply" if far == "both" else "near.ply"), data)
    seen = [s.cameras.viewmats[:, :3, :3] @ s.gaussians.means.T + s.cameras.viewmats[:, :3, 3:] for s in (near, found)]
    if far == "both":
        assert (seen[0] - seen[1]).abs().max() < 1e-5
        assert (found.cameras.centers.double() + found.offset).numpy() == pytest.approx(ring()[:, :3, 3] + place, abs=1e-5)
        assert "are moved to the origin" in found.remarks[0]
    else:  # nothing tells by how much a trainer has moved the splat: the middle of the cameras is taken, in whole units
        assert found.cameras.centers.abs().max() < 10 and "far from the splat" in found.remarks[0]


def test_inria_s_output_folder_is_a_scene_and_a_place_of_cameras(tmp_path):
    from test_scene_captures_colmap import inria_output

    for iterations, n in ((7_000, 5), (30_000, 8)):
        folder = tmp_path / "flowers" / "point_cloud" / f"iteration_{iterations}"
        folder.mkdir(parents=True)
        write_ply(folder / "point_cloud.ply", n=n)
    inria_output(tmp_path / "flowers")
    scene = read_scene(tmp_path / "flowers")
    assert (scene.name, len(scene.gaussians), len(scene.cameras)) == ("flowers", 8, 4)
    other = read_scene(folder / "point_cloud.ply", tmp_path / "flowers")
    assert torch.equal(other.cameras.viewmats, scene.cameras.viewmats)
    with pytest.raises(SceneError, match=r"holds no cameras: .*or pass the folder .*flowers, which has them"):
        read_scene(folder / "point_cloud.ply")


def test_cameras_follow_the_dataparser_of_a_run(tmp_path):
    """A dataparser that undoes the transform and scale which ns-process-data applied gives back the original poses."""
    applied = np.array([[0.0, 0, 2, 1], [1, 0, 0, 2], [0, 1, 0, 3]]) / [[2, 2, 2, 1], [1, 1, 1, 1], [1, 1, 1, 1]]
    data = write_transforms(tmp_path / "transforms.json", applied_transform=applied.tolist(), applied_scale=4.0)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 2.0}))
    saved = read_capture(data)
    placement = run_placement(tmp_path / "dataparser_transforms.json", saved.applied, saved.applied_scale)
    found = saved.moved(placement.move).cameras()
    original = np.linalg.solve(applied[:, :3], ring()[:, :3, 3].T - applied[:, 3:]).T
    assert found.centers.numpy() == pytest.approx(original * 2.0 / 4.0, abs=1e-5)
    looked_at = np.linalg.solve(applied[:, :3], -applied[:, 3]) * 2.0 / 4.0  # where the saved origin is in the run
    seen = found.viewmats @ torch.tensor([*looked_at, 1.0], dtype=torch.float32)
    assert seen[:, :3].numpy() == pytest.approx(np.tile([0, 0, 1.5], (4, 1)), abs=1e-5)


def test_checkpoints_of_other_methods_and_untrained_runs_say_why(tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    torch.save({"pipeline": {"_model.field.mlp": torch.zeros(3)}}, tmp_path / "nerfstudio_models" / "nerf.ckpt")
    with pytest.raises(SceneError, match="holds no Gaussians"):
        read_scene(tmp_path / "nerfstudio_models" / "nerf.ckpt")
    (tmp_path / "config.yml").write_text("")
    with pytest.raises(SceneError, match="no trained run"):
        read_scene(tmp_path)
    with pytest.raises(SceneError, match="no splat: expected"):
        read_scene(Path(__file__))


def test_the_garden_from_its_ply(garden_ply, garden_data):
    scene = read_scene(garden_ply, garden_data)
    assert len(scene.gaussians) == 120_000 and scene.gaussians.sh_degree == 1
    assert len(scene.cameras) == len(scene.images) == 185 and scene.images[0].is_file()
    assert (scene.cameras.width, scene.cameras.height) == (512, 512)
    assert (scene.name, scene.description) == ("garden", "a garden")
    assert scene.content_key() == read_scene(garden_ply, garden_data / "transforms.json").content_key()
    assert scene.content_key() != read_scene(garden_ply, garden_data, metres_per_unit=1.0).content_key()


def test_a_run_shows_the_garden_where_its_ply_does(splatfacto_run, garden_ply, garden_data, tmp_path, monkeypatch):
    """The splat as seen from the cameras does not depend on the coordinates in which it was stored."""
    plain = read_scene(garden_ply, garden_data)
    for path in (splatfacto_run, splatfacto_run / "config.yml", next(splatfacto_run.glob("nerfstudio_models/*.ckpt"))):
        run = read_scene(path, garden_data)
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
        read_scene(moved, garden_data)
    # Without data the run's own dataparser is asked, which an entry point names; where none is installed, that is said.
    assert len(read_scene(moved).cameras) == 167  # nine tenths of the photographs train
    monkeypatch.setattr("pgsd_nerfstudio.scene.source_views.entry_points", lambda group: ())
    with pytest.raises(SceneError, match=r"only nerfstudio reads the cameras of .* pass data="):
        read_scene(moved)


def _in_cameras(scene):
    """Where some Gaussians lie for some cameras, in scene units."""
    views, points = scene.cameras.viewmats[::40], scene.gaussians.means[::100]
    return torch.einsum("tij,nj->tni", views[:, :3, :3], points) + views[:, None, :3, 3]
