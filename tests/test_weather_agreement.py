"""Cameras and splat in different coordinates are found by renders and photographs, and put right where files tell how."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import roma
import torch
from captures import ring, transforms
from PIL import Image
from plyfile import PlyData, PlyElement

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.weather.loading import load_scene
from pgsd_nerfstudio.weather.making import simulate
from pgsd_nerfstudio.weather.prepared_scene import prepare_scene

VIEWS, SIDE = 8, 96
# A world that is neither level nor at the origin, as COLMAP leaves it.
TILT = torch.eye(4, dtype=torch.float64)
TILT[:3, :3] = roma.rotvec_to_rotmat(torch.tensor([1.9, 0.3, -0.4], dtype=torch.float64))
TILT[:3, 3] = torch.tensor([0.7, -0.4, 0.2])
CONVENTION = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]  # applied_transform of ns-process-data


def blobs(count: int = 400) -> Gaussians:
    """Blobs of many colours in a ball."""
    draw = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1) * torch.rand(count, 1, generator=draw)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=draw), dim=1)
    scales = 0.05 + 0.1 * torch.rand(count, 3, generator=draw)
    return Gaussians(means, quats, scales, torch.full((count,), 0.95), torch.randn(count, 1, 3, generator=draw))


def moved(gaussians: Gaussians, move: torch.Tensor) -> Gaussians:
    """The same splat in other coordinates; its colours are the same from everywhere."""
    size = float(torch.linalg.det(move[:3, :3])) ** (1 / 3)
    turn = roma.rotmat_to_unitquat(move[:3, :3] / size).float()
    quats = roma.quat_product(turn.expand(len(gaussians), 4), roma.quat_wxyz_to_xyzw(gaussians.quats))
    means = (gaussians.means.double() @ move[:3, :3].T + move[:3, 3]).float()
    return replace(gaussians, means=means, quats=roma.quat_xyzw_to_wxyz(quats), scales=gaussians.scales * size)


def write_splat(path: Path, gaussians: Gaussians) -> Path:
    columns = {
        **dict(zip("xyz", gaussians.means.T, strict=True)),
        **{f"f_dc_{i}": gaussians.colors[:, 0, i] for i in range(3)},
        "opacity": torch.logit(gaussians.opacities),
        **{f"scale_{i}": gaussians.scales[:, i].log() for i in range(3)},
        **{f"rot_{i}": gaussians.quats[:, i] for i in range(4)},
    }
    table = np.zeros(len(gaussians), [(name, "f4") for name in columns])
    for name, values in columns.items():
        table[name] = values.numpy()
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a capture in the original world: transforms.json and photographs that are renders of the blobs."""
    folder = tmp_path_factory.mktemp("capture")
    poses = TILT.numpy() @ ring(VIEWS)
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    lens = {"fl_x": 110.0, "fl_y": 110.0, "cx": SIDE / 2, "cy": SIDE / 2, "w": SIDE, "h": SIDE}
    (folder / "transforms.json").write_text(json.dumps(transforms(frames=frames, **lens)))
    (folder / "images").mkdir()
    cameras = read_capture(folder).cameras()
    splat = moved(blobs(), TILT)
    write_splat(folder / "splat.ply", splat)
    rasterizer = choose_rasterizer(splat, "cpu")
    for index in range(VIEWS):
        rgb = rasterizer.render(cameras[index]).rgb[0].clamp(0, 1)
        Image.fromarray((255 * rgb + 0.5).byte().numpy()).save(folder / "images" / f"{index}.png")
    return folder


def in_other_coordinates(capture: Path, folder: Path, **changes: Any) -> Path:
    """A transforms.json of the same photographs, with other poses or entries."""
    meta = json.loads((capture / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["file_path"] = str(capture / frame["file_path"])
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(meta | changes))
    return folder


def poses_of(capture: Path) -> torch.Tensor:
    return read_capture(capture).poses


def as_frames(capture: Path, poses: torch.Tensor) -> dict[str, Any]:
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    names = [str(capture / frame["file_path"]) for frame in frames]
    return {"frames": [{"file_path": n, "transform_matrix": p.tolist()} for n, p in zip(names, poses, strict=True)]}


def looks_right(scene, capture: Path) -> float:
    """PSNR of a render of a view against its photograph, in dB."""
    picture = choose_rasterizer(scene.gaussians, "cpu").render(scene.cameras[3]).rgb[0].clamp(0, 1)
    truth = torch.from_numpy(np.asarray(Image.open(scene.images[3]))).float() / 255
    return float(-10 * (picture - truth).square().mean().log10())


def test_cameras_that_fit_are_left_as_they_are(capture):
    began = time.perf_counter()
    scene = load_scene(capture / "splat.ply", capture)
    assert time.perf_counter() - began < 20  # with a first compilation
    assert scene.trusted and looks_right(scene, capture) > 40
    (remark,) = scene.remarks
    assert remark.startswith("renders of 5 views look like their photographs (PSNR 5")
    assert torch.equal(scene.cameras.viewmats, read_capture(capture).cameras().viewmats)


def test_a_splat_of_nerfstudio_with_the_original_transforms_is_put_right(capture, tmp_path):
    """The poses and the transform are those of nerfstudio's own dataparser; ns-export writes splats in its coordinates."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    outputs = NerfstudioDataParserConfig(data=capture, eval_mode="all").setup().get_dataparser_outputs("train")
    move = torch.eye(4, dtype=torch.float64)
    move[:3] = outputs.dataparser_transform.double() * outputs.dataparser_scale
    ply = write_splat(tmp_path / "exported.ply", moved(moved(blobs(), TILT), move))
    scene = load_scene(ply, capture)
    assert "are oriented, centred and scaled as nerfstudio's dataparser does by default" in scene.remarks[-1]
    assert scene.cameras.opengl()[:, :3].numpy() == pytest.approx(outputs.cameras.camera_to_worlds.numpy(), abs=1e-5)
    assert looks_right(scene, capture) > 30
    assert prepare_scene(scene, "cpu").scene is scene  # compared once
    # With other options of the dataparser only its own file tells.
    options = {"orientation_method": "vertical", "center_method": "focus", "auto_scale_poses": False, "scale_factor": 3.0}
    outputs = NerfstudioDataParserConfig(data=capture, eval_mode="all", **options).setup().get_dataparser_outputs("train")
    move[:3] = outputs.dataparser_transform.double() * outputs.dataparser_scale
    (tmp_path / "run").mkdir()
    ply = write_splat(tmp_path / "run" / "exported.ply", moved(moved(blobs(), TILT), move))
    with pytest.raises(SceneError, match="do not fit the splat"):
        load_scene(ply, capture)
    outputs.save_dataparser_transform(tmp_path / "run" / "dataparser_transforms.json")
    scene = load_scene(ply, capture)
    assert "are moved as" in scene.remarks[-1] and looks_right(scene, capture) > 30


def test_a_splat_of_inria_s_trainer_with_what_ns_process_data_wrote_is_put_right(capture, tmp_path):
    """ns-process-data turns COLMAP's world, and says so by applied_transform; older versions say nothing."""
    applied = torch.eye(4, dtype=torch.float64)
    applied[:3] = torch.tensor(CONVENTION, dtype=torch.float64)
    turned = as_frames(capture, applied @ poses_of(capture))
    for changes, said in (
        ({"applied_transform": CONVENTION}, "turned back by applied_transform"),
        ({}, "turned back, as ns-process-data turns COLMAP's world"),
    ):
        scene = load_scene(capture / "splat.ply", in_other_coordinates(capture, tmp_path / "data", **turned, **changes))
        assert f"they are {said}" in scene.remarks[-1] and looks_right(scene, capture) > 40
        assert scene.cameras.viewmats.numpy() == pytest.approx(read_capture(capture).cameras().viewmats.numpy(), abs=1e-5)
    # The frame follows from where the cameras are.
    assert scene.frame.rotation.numpy() == pytest.approx(
        load_scene(capture / "splat.ply", capture).frame.rotation.numpy(), abs=1e-5
    )
    # The other way round: a splat in the turned world, cameras as COLMAP has them.
    ply = write_splat(tmp_path / "turned.ply", moved(moved(blobs(), TILT), applied))
    data = in_other_coordinates(capture, tmp_path / "colmap", applied_transform=CONVENTION)
    scene = load_scene(ply, data)
    assert "turned by applied_transform once more" in scene.remarks[-1] and looks_right(scene, capture) > 40


def test_cameras_that_are_slightly_off_are_doubted(capture, tmp_path):
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64))
    poses = TILT @ turn @ torch.linalg.inv(TILT) @ poses_of(capture)
    scene = load_scene(capture / "splat.ply", in_other_coordinates(capture, tmp_path / "data", **as_frames(capture, poses)))
    assert scene.remarks[-1].endswith("but not quite: are these the cameras that the splat was trained on?")


@pytest.mark.parametrize("how", ["turned", "scaled", "shifted", "mixed up"])
def test_cameras_that_fit_nowhere_are_refused_with_what_was_tried(capture, tmp_path, how):
    poses = poses_of(capture)
    if how == "mixed up":
        poses = poses.roll(3, dims=0)
    elif how == "scaled":
        poses[:, :3, 3] *= 4
    elif how == "shifted":
        poses[:, :3, 3] += 2.0
    else:
        poses = TILT @ poses
    data = in_other_coordinates(capture, tmp_path / "data", **as_frames(capture, poses))
    with pytest.raises(SceneError) as refusal:
        load_scene(capture / "splat.ply", data)
    said = str(refusal.value)
    assert "renders of 5 views do not look like their photographs (PSNR" in said and "expected at least 0.4" in said
    assert "nor with the cameras oriented, centred and scaled as nerfstudio's dataparser does by default" in said
    assert "trust_cameras=True" in said and "\n" not in said
    with pytest.raises(SceneError, match="do not fit the splat"):
        simulate(replace(load_scene(capture / "splat.ply", data, trust_cameras=True), trusted=False), device="cpu")
    assert load_scene(capture / "splat.ply", data, trust_cameras=True).trusted


def test_what_photographs_cannot_tell_is_not_asked(capture, tmp_path):
    """No photographs, or photographs of nothing: there is nothing to compare."""
    poses = TILT @ poses_of(capture)
    data = in_other_coordinates(capture, tmp_path / "data", **as_frames(capture, poses))
    grey = tmp_path / "grey"
    grey.mkdir()
    for index in range(VIEWS):
        Image.new("RGB", (SIDE, SIDE), (99, 120, 30)).save(grey / f"{index}.png")
    meta = json.loads((data / "transforms.json").read_text())
    for folder in (grey, tmp_path / "nowhere"):
        for index, frame in enumerate(meta["frames"]):
            frame["file_path"] = str(folder / f"{index}.png")
        (data / "transforms.json").write_text(json.dumps(meta))
        scene = load_scene(capture / "splat.ply", data)
        assert not any("look like" in remark for remark in scene.remarks)
        prepare_scene(scene, "cpu")


def test_exposure_masks_and_a_cut_out_splat_do_not_matter(capture, tmp_path):
    """Darker, bluish photographs with half of each masked out, and a splat of which only a part is left."""
    (tmp_path / "images").mkdir()
    for index in range(VIEWS):
        picture = np.asarray(Image.open(capture / "images" / f"{index}.png")) / 255
        darker = 0.1 + 0.5 * picture ** np.array([1.4, 1.2, 0.8])
        darker[: SIDE // 2] = np.random.default_rng(index).random((SIDE // 2, SIDE, 3))
        Image.fromarray((255 * darker).astype(np.uint8)).save(tmp_path / "images" / f"{index}.png")
    mask = np.zeros((SIDE, SIDE), np.uint8)
    mask[SIDE // 2 :] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    frames = as_frames(capture, poses_of(capture))["frames"]
    for index, frame in enumerate(frames):
        frame |= {"file_path": f"images/{index}.png", "mask_path": "mask.png"}
    meta = json.loads((capture / "transforms.json").read_text()) | {"frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    whole = moved(blobs(), TILT)
    part = whole.select(torch.arange(len(whole)) % 3 > 0)
    scene = load_scene(write_splat(tmp_path / "part.ply", part), tmp_path)
    assert "look like their photographs" in scene.remarks[-1]


def test_matted_photographs_of_a_splat_with_a_background_agree(capture, tmp_path):
    """What was cut out of the photographs tells nothing, whatever colour it has."""
    (tmp_path / "images").mkdir()
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    for index in range(VIEWS):
        picture = np.asarray(Image.open(capture / "images" / f"{index}.png"))
        inside = np.hypot(x, y) < 0.2 * SIDE
        matted = np.dstack([np.where(inside[..., None], picture, 0), np.where(inside, 255, 0)]).astype(np.uint8)
        Image.fromarray(matted, "RGBA").save(tmp_path / "images" / f"{index}.png")
    shutil.copy(capture / "transforms.json", tmp_path)
    scene = load_scene(capture / "splat.ply", tmp_path)
    assert "look like their photographs" in scene.remarks[-1]
    data = in_other_coordinates(tmp_path, tmp_path / "data", **as_frames(tmp_path, poses_of(tmp_path).roll(3, dims=0)))
    with pytest.raises(SceneError, match="do not fit the splat"):
        load_scene(capture / "splat.ply", data)


@pytest.mark.slow
def test_the_garden_agrees_and_its_wrong_cameras_do_not(garden_ply, garden_data, tmp_path):
    began = time.perf_counter()
    scene = load_scene(garden_ply, garden_data)
    assert "look like their photographs" in scene.remarks[-1]
    load_scene(garden_ply, garden_data, trust_cameras=True)
    assert time.perf_counter() - began < 60
    meta = json.loads((garden_data / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["file_path"] = str(garden_data / frame["file_path"])
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64))
    for frame in meta["frames"]:
        frame["transform_matrix"] = (turn @ torch.tensor(frame["transform_matrix"], dtype=torch.float64)).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(SceneError, match="do not fit the splat"):
        load_scene(garden_ply, tmp_path)
