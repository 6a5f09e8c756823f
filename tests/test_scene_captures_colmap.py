"""Reconstructions of COLMAP are read as COLMAP and nerfstudio read them, and cameras.json as Inria's trainer wrote it."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import ring, write_photographs

from pgsd_nerfstudio.scene.captures.colmap import read_colmap
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.errors import SceneError

COLMAP = Path(__file__).parent / "colmap"  # two cameras of a rig, three frames, by COLMAP 4.2.1: see colmap_truth.py
TRUTH = json.loads((COLMAP / "truth.json").read_text())


def capture_folder(folder: Path, kind: str, place: str = "sparse/0") -> Path:
    shutil.copytree(COLMAP / kind, folder / place, dirs_exist_ok=True)
    write_photographs(folder, [f"images/{name}" for name in TRUTH["images"]], (620, 500))
    return folder


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_views_are_those_of_colmap(kind, tmp_path):
    capture = read_capture(capture_folder(tmp_path, kind))
    names = sorted(TRUTH["images"])
    assert [photograph.path for photograph in capture.photographs] == [tmp_path / "images" / name for name in names]
    expected = np.array([TRUTH["images"][name]["world_to_camera"] for name in names])
    assert torch.linalg.inv(capture.poses).numpy() == pytest.approx(np.diag([1, -1, -1, 1]) @ expected, abs=1e-12)
    assert capture.cameras().viewmats.numpy() == pytest.approx(expected, abs=1e-6)
    kinds = {1: "perspective", 2: "fisheye"}
    cameras = [TRUTH["images"][name]["camera"] for name in names]
    assert [photograph.lens.projection for photograph in capture.photographs] == [kinds[number] for number in cameras]


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_views_are_those_of_nerfstudio_s_colmap_dataparser(kind, tmp_path):
    """Its own parser reads neither rigs nor two kinds of cameras, so the fisheyes become those of the first kind here."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    folder = capture_folder(tmp_path, kind)
    if kind == "text":
        lines = (folder / "sparse/0/cameras.txt").read_text().replace("OPENCV_FISHEYE", "OPENCV")
        (folder / "sparse/0/cameras.txt").write_text(lines)
        # It cuts names at their first space in text files.
        (folder / "sparse/0/images.txt").write_text((folder / "sparse/0/images.txt").read_text().replace("cam ", "cam"))
        for number in (1, 2):
            (folder / f"images/cam {number}").rename(folder / f"images/cam{number}")
    else:
        data = bytearray((folder / "sparse/0/cameras.bin").read_bytes())
        assert data[8 + 88 + 4] == 5  # OPENCV_FISHEYE, which has as many parameters as OPENCV
        data[8 + 88 + 4] = 4
        (folder / "sparse/0/cameras.bin").write_bytes(data)
    still = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    still |= {"assume_colmap_world_coordinate_convention": False, "load_3D_points": False, "eval_mode": "all"}
    outputs = ColmapDataParserConfig(data=folder, colmap_path=Path("sparse/0"), **still).setup().get_dataparser_outputs("train")
    capture = read_capture(folder)
    order = [outputs.image_filenames.index(photograph.path) for photograph in capture.photographs]
    assert capture.poses[:, :3].numpy() == pytest.approx(outputs.cameras.camera_to_worlds[order].numpy(), abs=1e-6)
    Ks = outputs.cameras.get_intrinsics_matrices()[order]
    assert capture.cameras().Ks.numpy() == pytest.approx(Ks.numpy(), rel=1e-6)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_reconstructions_are_found_where_people_keep_them(place, tmp_path):
    folder = capture_folder(tmp_path, "binary", place)
    assert len(read_capture(folder)) == 6
    if place != ".":
        capture = read_capture(folder / place)  # the reconstruction itself
        assert all(photograph.path.is_file() for photograph in capture.photographs)
        assert len(read_capture(folder / place / "cameras.bin")) == 6


def test_a_transforms_json_beside_a_reconstruction_is_preferred(tmp_path):
    from captures import write_transforms

    folder = capture_folder(tmp_path, "binary", "colmap/sparse/0")
    write_transforms(folder / "transforms.json")
    assert len(read_capture(folder)) == 4


def test_reconstructions_that_cannot_be_used_say_why(tmp_path):
    with pytest.raises(SceneError, match=r"no cameras at .*transforms\.json.*sparse/0.*cameras\.json"):
        read_capture(tmp_path)
    with pytest.raises(SceneError, match="no COLMAP reconstruction in"):
        read_colmap(tmp_path)
    for change, sentence in {
        ("cameras.txt", "OPENCV 620", "EQUIRECTANGULAR 620"): "the lens of camera 1 was taken with a EQUIRECTANGULAR camera",
        ("cameras.txt", "1 OPENCV", "9 OPENCV"): r"the camera of cam 1/1\.jpg is not in cameras\.txt",
        ("cameras.txt", "OPENCV 620", "OPENCV 0"): "expected w from 1 to",
        ("cameras.txt", "OPENCV 620 500 500", "OPENCV 620 500"): "has 7 parameters; OPENCV has 8",
        ("cameras.txt", "OPENCV 620 500 500", "OPENCV 620 500 nan"): "expected fl_x",
        ("images.txt", "3 -0.60", "3 nan -0.60"): "holds no cameras that can be read",
        ("images.txt", "3 -0.60677197002209771 0.28686842373858373 0.73732472824087381 0.076723718508455968", "3 0 0 0 0"): (
            r"the pose of cam 1/1\.jpg holds a NaN"
        ),
    }.items():
        folder = tmp_path / str(abs(hash(change)))
        capture_folder(folder, "text")
        path = folder / "sparse/0" / change[0]
        text = path.read_text()
        assert change[1] in text
        path.write_text(text.replace(change[1], change[2], 1))
        with pytest.raises(SceneError, match=sentence) as refusal:
            read_capture(folder)
        assert "\n" not in str(refusal.value)
    empty = tmp_path / "empty"
    capture_folder(empty, "text")
    (empty / "sparse/0/images.txt").write_text("# nothing\n")
    with pytest.raises(SceneError, match="has no images: the reconstruction is empty"):
        read_capture(empty)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_mutated_reconstructions_are_read_or_refused(kind, tmp_path):
    draw, suffix = random.Random(5), {"binary": ".bin", "text": ".txt"}[kind]
    folder = capture_folder(tmp_path, kind)
    read = 0
    for _ in range(200):
        path = folder / "sparse/0" / (draw.choice(("cameras", "images")) + suffix)
        whole = path.read_bytes()
        damaged = bytearray(whole)
        at = draw.randrange(len(whole))
        how = draw.choice(("cut", "flip", "overwrite"))
        if how == "cut":
            del damaged[at:]
        elif how == "flip":
            damaged[at] ^= 1 << draw.randrange(8)
        else:
            damaged[at : at + 8] = draw.randbytes(8)
        path.write_bytes(damaged)
        try:
            read += len(read_capture(folder).cameras()) > 0
        except SceneError as refusal:
            assert str(folder) in str(refusal) and "\n" not in str(refusal)
        path.write_bytes(whole)
    assert 20 < read < 180


def inria_output(folder: Path, **changes) -> Path:
    """What gaussian-splatting's camera_to_JSON writes: centre and camera-to-world rotation with OpenCV's axes."""
    cameras = []
    for index, pose in enumerate(ring()):
        opencv = pose @ np.diag([1, -1, -1, 1])
        camera = {"id": index, "img_name": f"frame_{index}", "width": 64, "height": 48, "fx": 70.0, "fy": 71.0}
        cameras.append({**camera, "position": opencv[:3, 3].tolist(), "rotation": [row.tolist() for row in opencv[:3, :3]]})
    cameras[2] = {name: value for name, value in (cameras[2] | changes).items() if value is not None}
    (folder / "cameras.json").write_text(json.dumps(cameras[::-1]))
    return folder


def test_cameras_json_of_inria_s_trainer(tmp_path):
    source = tmp_path / "garden"
    write_photographs(source / "images", [f"frame_{i}.png" for i in range(4)])
    output = tmp_path / "output"
    output.mkdir()
    said = f"Namespace(data_device='cuda', eval=False, images='images', model_path='{output}', source_path='{source}')"
    (output / "cfg_args").write_text(said)
    for data in (inria_output(output), output / "cameras.json"):
        capture = read_capture(data)
        assert capture.poses.numpy() == pytest.approx(ring(), abs=1e-12)
        assert [p.path for p in capture.photographs] == [source / "images" / f"frame_{i}.png" for i in range(4)]
        assert capture.cameras().Ks[0].tolist() == [[70, 0, 32], [0, 71, 24], [0, 0, 1]]
    source.rename(output / "garden")
    assert not any(p.path.exists() for p in read_capture(output).photographs)
    (output / "cfg_args").write_text("Namespace(source_path=__import__('os').system('touch sprung'))")
    assert len(read_capture(output)) == 4 and not (Path("sprung").exists())


def test_entries_of_cameras_json_that_are_no_cameras_are_refused_by_name(tmp_path):
    for changes, sentence in [
        ({"rotation": None}, r"the camera of frame_2 lacks rotation"),
        ({"rotation": [[1, 2], [3, 4]]}, r"the camera of frame_2 needs 3 numbers of position, 3x3 of rotation"),
        ({"position": "here"}, r"the camera of frame_2 needs 3 numbers"),
        ({"position": [0, 0, float("nan")]}, r"the pose of frame_2 holds a NaN"),
        ({"rotation": [[0, 0, 0]] * 3}, r"the pose of frame_2 has axes of no length"),
        ({"width": 0}, r"the camera of frame_2 cannot be that of a camera: expected w"),
        ({"fx": "wide"}, r"the camera of frame_2 needs"),
        ({"fx": 0}, r"expected fl_x from"),
    ]:
        with pytest.raises(SceneError, match=sentence) as refusal:
            read_capture(inria_output(tmp_path, **changes))
        assert "cameras.json" in str(refusal.value) and "\n" not in str(refusal.value)
