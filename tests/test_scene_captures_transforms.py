"""A transforms.json is read as nerfstudio's own dataparsers read it, and one that cannot be used is refused in a sentence."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from captures import HEIGHT, WIDTH, ring, transforms, write_photographs, write_transforms

from pgsd_nerfstudio.scene.captures.capture import Capture
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.errors import SceneError

NAMES = [f"images/{i}.jpg" for i in range(4)]


def read(folder: Path, **changes: Any) -> Capture:
    return read_capture(write_transforms(folder / "transforms.json", **changes))


def same_as_nerfstudio(capture: Capture, outputs: Any) -> None:
    """Poses, intrinsics, sizes and photographs are those of a dataparser that moves nothing."""
    theirs, cameras = outputs.cameras, capture.cameras()
    assert capture.poses[:, :3].float().numpy() == pytest.approx(theirs.camera_to_worlds.numpy(), abs=1e-6)
    assert cameras.opengl()[:, :3].numpy() == pytest.approx(theirs.camera_to_worlds.numpy(), abs=1e-5)
    assert cameras.Ks.numpy() == pytest.approx(theirs.get_intrinsics_matrices().numpy(), rel=1e-6)
    assert [photograph.path.resolve() for photograph in capture.photographs] == [p.resolve() for p in outputs.image_filenames]
    if theirs.width is not None:
        assert (theirs.width == cameras.width).all() and (theirs.height == cameras.height).all()
    if theirs.distortion_params is not None:
        k = [(*photograph.lens.radial, 0, 0, 0, 0)[:4] + photograph.lens.tangential for photograph in capture.photographs]
        assert np.array(k) == pytest.approx(theirs.distortion_params.numpy(), abs=1e-7)


def by_nerfstudio(data: Path) -> Any:
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    still = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    return NerfstudioDataParserConfig(data=data, eval_mode="all", **still).setup().get_dataparser_outputs("train")


def own_intrinsics(frame: dict[str, Any], index: int) -> dict[str, Any]:
    return {**frame, "fl_x": 100 + index, "fl_y": 90.5, "cx": 32.5, "cy": 23.0, "w": WIDTH, "h": HEIGHT, "k1": 0.01 * index}


OWN = [own_intrinsics(frame, i) for i, frame in enumerate(transforms()["frames"])]
MASKED = [{**frame, "mask_path": f"masks/{i}.png"} for i, frame in enumerate(transforms()["frames"])]
CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "reversed": {"frames": transforms()["frames"][::-1]},
    "distorted": {"k1": 0.1, "k2": -0.02, "p1": 0.001, "p2": -0.002},
    "listed": {"distortion_params": [0.1, -0.02, 0.003, 0.0, 0.001, -0.002]},
    "each its own": {"frames": OWN, **dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))},
    "the file's before the frame's": {
        "frames": [own_intrinsics(frame, i) for i, frame in enumerate(transforms()["frames"])],
        "k1": 0.2,
    },
    "strings": {"fl_x": "100", "cx": "32.0", "w": "64"},
    "masks": {"frames": MASKED},
    "no model": {"camera_model": None},
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01},
}


@pytest.mark.parametrize("name", CASES)
def test_views_are_those_of_nerfstudio_s_dataparser(name, tmp_path):
    write_photographs(tmp_path, NAMES)
    capture = read(tmp_path, **CASES[name])
    same_as_nerfstudio(capture, by_nerfstudio(tmp_path))
    masks = by_nerfstudio(tmp_path).mask_filenames or [None] * 4
    assert [photograph.mask for photograph in capture.photographs] == masks


ANGLES = [{"camera_angle_x": 0.9}, {"camera_angle_x": 0.9, "camera_angle_y": 0.7}, {"x_fov": 52.0}]


@pytest.mark.parametrize("angles", ANGLES)
def test_angles_of_view_as_instant_ngp_and_blender_write_them(angles, tmp_path):
    """No focal lengths, no principal point, no size, and photographs named without their suffix."""
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
    from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig

    write_photographs(tmp_path, [f"train/r_{i}.png" for i in range(4)], (80, 60))
    frames = [{"file_path": f"./train/r_{i}", "transform_matrix": pose.tolist()} for i, pose in enumerate(ring())]
    meta = {**angles, "frames": frames}
    for name in ("transforms.json", "transforms_train.json"):
        (tmp_path / name).write_text(json.dumps(meta))
    ngp = InstantNGPDataParserConfig(data=tmp_path, scene_scale=1.0, eval_mode="all").setup()
    outputs, capture = ngp.get_dataparser_outputs("train"), read_capture(tmp_path)
    if len(angles) == 2:  # nerfstudio's parser overlooks the second, instant-ngp itself does not
        assert capture.photographs[0].lens.fy == pytest.approx(30 / math.tan(0.35))
        outputs.cameras.fy[:] = capture.photographs[0].lens.fy
    same_as_nerfstudio(capture, outputs)
    (tmp_path / "transforms.json").unlink()
    if len(angles) == 1 and "camera_angle_x" in angles:  # the one angle that Blender's dataparser knows
        blender = BlenderDataParserConfig(data=tmp_path).setup().get_dataparser_outputs("train")
        blender.cameras.distortion_params = None
        same_as_nerfstudio(read_capture(tmp_path), blender)
    (tmp_path / "train" / "r_2.png").unlink()
    with pytest.raises(SceneError, match=r"the lens of \./train/r_2 needs w and h.*no photograph"):
        read_capture(tmp_path)


def test_fisheyes_are_known_by_their_own_frame(tmp_path):
    frames = transforms()["frames"]
    frames[2] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}
    frames[3] |= {"is_fisheye": True, "k2": 0.3}
    capture = read(tmp_path, frames=frames, camera_model=None, k1=0.02)
    lenses = [photograph.lens for photograph in capture.photographs]
    assert [lens.projection for lens in lenses] == ["perspective", "perspective", "fisheye", "fisheye"]
    assert [lens.radial for lens in lenses] == [(0.02,), (0.02,), (0.1,), (0.0, 0.3)]
    own = read(tmp_path, frames=frames, camera_model="SIMPLE_RADIAL")  # against that of the whole file
    assert [photograph.lens.projection for photograph in own.photographs][2:] == ["fisheye", "fisheye"]
    whole = read(tmp_path, camera_model=None, is_fisheye=True)
    assert {photograph.lens.projection for photograph in whole.photographs} == {"fisheye"}
    for model in ("EQUIRECTANGULAR", "FISHEYE624"):
        with pytest.raises(SceneError, match=rf"the lens of images/0\.jpg was taken with a {model} camera"):
            read(tmp_path, camera_model=model)


def test_intrinsics_of_other_image_sizes_are_cropped_to_the_most_frequent(tmp_path):
    frames = [own_intrinsics(frame, 0) for frame in transforms()["frames"]]
    frames[2] |= {name: 2 * frames[2][name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    capture = read(tmp_path, frames=frames, **dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h")))
    cameras = capture.cameras()
    assert (cameras.width, cameras.height) == (WIDTH, HEIGHT)
    assert torch.equal(cameras.Ks[2], cameras.Ks[0]) and capture.photographs[2].lens.width == 2 * WIDTH


@pytest.mark.parametrize("kind", ["3x4", "strings", "flat", "rounded", "scaled", "scaled and rounded"])
def test_poses_in_the_ways_people_write_them(kind, tmp_path):
    frames = transforms()["frames"]
    for frame in frames:
        matrix = np.array(frame["transform_matrix"])
        if "scaled" in kind:  # Blender's matrix_world of a scaled camera
            matrix[:3, :3] *= 0.37
        if "rounded" in kind:
            matrix = matrix.round(3)
        rows = matrix.tolist()
        written = {
            "3x4": rows[:3],
            "strings": [[str(x) for x in row] for row in rows],
            "flat": [x for row in rows for x in row],
        }
        frame["transform_matrix"] = written.get(kind, rows)
    poses = read(tmp_path, frames=frames).poses.numpy()
    assert poses == pytest.approx(ring(), abs=2e-3 if "rounded" in kind else 1e-12)
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(1, abs=1e-9)


def pose(**changes: float) -> dict[str, Any]:
    """Frames of which the third has a changed pose; entries are named by row and column."""
    frames = transforms()["frames"]
    for place, value in changes.items():
        frames[2]["transform_matrix"][int(place[1])][int(place[2])] = value
    return {"frames": frames}


def frame(**changes: Any) -> dict[str, Any]:
    frames = transforms()["frames"]
    frames[2] = {name: value for name, value in (frames[2] | changes).items() if value is not None}
    return {"frames": frames}


def nested(depth: int) -> Any:
    deep: Any = 1.0
    for _ in range(depth):
        deep = [deep]
    return deep


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"frames": []}, r"has no cameras: expected a list"),
    ({"frames": None}, r"has no cameras: expected a list"),
    ({"frames": {"0": 1}}, r"has no cameras: expected a list"),
    ({"frames": [1, 2]}, r"has no cameras: expected a list"),
    (frame(transform_matrix=None), r"images/2\.jpg needs a transform_matrix of 4x4 numbers: there is none"),
    (frame(transform_matrix="up"), r"images/2\.jpg needs a transform_matrix of 4x4 numbers"),
    (frame(transform_matrix=[[1, 2], [3]]), r"images/2\.jpg needs a transform_matrix .*found 3"),
    (frame(transform_matrix=[[None] * 4] * 4), r"images/2\.jpg needs a transform_matrix"),
    (frame(transform_matrix=nested(30)), r"images/2\.jpg needs a transform_matrix"),
    (pose(p00=math.nan), r"the pose of images/2\.jpg holds a NaN or infinity"),
    (pose(p03=math.inf), r"the pose of images/2\.jpg holds a NaN or infinity"),
    (pose(p03=1e30), r"the pose of images/2\.jpg lies more than 1e\+12 units from the origin"),
    (pose(p00=1e300), r"the pose of images/2\.jpg has axes of no length or of too great a one"),
    (pose(p00=0.0, p10=0.0, p20=0.0), r"the pose of images/2\.jpg has axes of no length"),
    (
        {"frames": [{**f, "transform_matrix": np.ones((4, 4)).tolist()} for f in transforms()["frames"]]},
        r"\(and of 3 more\) is singular",
    ),
    (frame(transform_matrix=(ring()[2] @ np.diag([-1, 1, 1, 1])).tolist()), r"the pose of images/2\.jpg is mirrored"),
    (frame(transform_matrix=(ring()[2] @ np.diag([2, 1, 1, 1])).tolist()), r"the pose of images/2\.jpg is sheared"),
    ({"fl_x": None, "fl_y": None}, r"needs a focal length: fl_x in pixels, or camera_angle_x"),
    ({"fl_x": 0}, r"expected fl_x from 0\.001 to 1e\+07, found 0"),
    ({"fl_x": -100.0}, r"expected fl_x from"),
    ({"fl_x": math.nan}, r"expected fl_x from .* found nan"),
    ({"fl_x": None, "fl_y": None, "camera_angle_x": 3.2}, r"expected fl_x from"),
    ({"fl_x": "wide"}, r"needs a number for fl_x, found 'wide'"),
    ({"fl_x": True}, r"needs a number for fl_x, found 'True'"),
    ({"fl_x": [1, 2]}, r"needs a number for fl_x"),
    ({"w": 0}, r"expected w from 1 to 100000, found 0"),
    ({"h": 0.5}, r"expected h from 1 to"),
    ({"h": -48}, r"expected h from 1 to"),
    ({"w": 1e9}, r"expected w from 1 to 100000, found 1e\+09"),
    ({"w": 10**400}, r"needs a number for w"),
    ({"cx": math.inf}, r"expected cx from"),
    ({"k1": "much"}, r"needs a number for k1"),
    ({"k1": math.nan}, r"expected k1 from"),
    ({"camera_model": 7}, r"needs a camera_model such as OPENCV, found '7'"),
    ({"camera_model": "BOX"}, r"was taken with a BOX camera"),
    ({"camera_model": "FOV"}, r"is of the model FOV, which no transforms\.json describes: pass COLMAP's folder"),
    ({"applied_transform": [[1, 2]]}, r"applied_transform must be a 3x4 matrix"),
    ({"applied_transform": np.zeros((3, 4)).tolist()}, r"applied_transform must be invertible"),
    ({"applied_scale": "big"}, r"applied_scale a number"),
    ({"applied_scale": -1.0}, r"applied_scale positive"),
]


@pytest.mark.parametrize(("changes", "sentence"), REFUSED)
def test_what_cannot_be_a_camera_is_refused_in_a_sentence(changes, sentence, tmp_path):
    with pytest.raises(SceneError, match=sentence) as refusal:
        read(tmp_path, **changes)
    assert "transforms.json" in str(refusal.value) and "\n" not in str(refusal.value) and len(str(refusal.value)) < 500


def test_files_that_are_no_transforms_json_say_so(tmp_path):
    for content, sentence in {
        b"{": "cannot be read as JSON",
        b"": "cannot be read as JSON",
        b"\xff\xfe\x00": "cannot be read as JSON",
        b"[]": "has no cameras",
        b"null": "has no cameras",
        b"7": "has no cameras",
        b"[" * 100_000: "nested too deeply|cannot be read as JSON",
        b'{"frames":' * 100_000: "nested too deeply|cannot be read as JSON",
    }.items():
        (tmp_path / "transforms.json").write_bytes(content)
        with pytest.raises(SceneError, match=sentence) as refusal:
            read_capture(tmp_path)
        assert "\n" not in str(refusal.value)
    with_mark = "\ufeff" + json.dumps(transforms())  # as Windows' editors save it
    (tmp_path / "transforms.json").write_text(with_mark, "utf-8")
    assert len(read_capture(tmp_path)) == 4


def test_odd_names_of_photographs_are_names_of_photographs_that_are_missing(tmp_path):
    for odd in (7, None, "", ["a"], "a\0b", 5000 * "a"):
        capture = read(tmp_path, **frame(file_path=odd))
        assert len(capture) == 4 and sum(p.path.exists() for p in capture.photographs if len(p.path.name) < 100) == 0


def test_georeferenced_poses_keep_their_places(tmp_path):
    """A ring at UTM coordinates, in doubles: a millimetre is still a millimetre after the ring has been moved to the origin."""
    frames = transforms()["frames"]
    place = np.array([500_123.25, 5_400_678.125, 312.5])
    for frame, pose in zip(frames, ring(), strict=True):
        pose[:3, 3] += place
        frame["transform_matrix"] = pose.tolist()
    capture = read(tmp_path, frames=frames)
    back = torch.eye(4, dtype=torch.float64)
    back[:3, 3] = -torch.from_numpy(place)
    assert capture.moved(back).cameras().centers.numpy() == pytest.approx(ring()[:, :3, 3], abs=1e-6)
