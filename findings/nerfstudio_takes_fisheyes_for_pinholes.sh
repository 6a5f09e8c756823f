#!/usr/bin/env bash
# nerfstudio 1.1.5: a camera_model that stands with each frame of a transforms.json is not read: fisheyes count as pinholes.
#
# Guess before the run: a frame may name its model as it may name its focal lengths and distortion, all of which are read; or else
# it is refused.
# Seen: only the model of the whole file counts, and without one every camera is a pinhole. The fisheye's k1 to k4 are then taken
# for Brown's polynomial, and nothing is said. Files with intrinsics for each frame put camera_model there.
#
# Needs python3 (3.10-3.12), the network, and about 6 GB in $TMPDIR. Exits non-zero if the behaviour changes.
set -euo pipefail
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
"${PYTHON:-python3}" -m venv "$made/venv"
"$made/venv/bin/pip" -q install uv==0.13.9
VIRTUAL_ENV="$made/venv" "$made/venv/bin/uv" pip install -q nerfstudio==1.1.5 numpy==1.26.4 "setuptools<81" opencv-python-headless==4.10.0.84
cd "$made"
"$made/venv/bin/python" - <<'PYTHON_END'
import json
from pathlib import Path

from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

lens = {"w": 64, "h": 48, "cx": 32.0, "cy": 24.0, "fl_x": 30.0, "fl_y": 30.0, "k1": 0.1, "camera_model": "OPENCV_FISHEYE"}
frames = []
for name, x in (("0.png", -1), ("1.png", 1)):
    Image.new("RGB", (64, 48)).save(name)
    pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    frames.append({"file_path": name, "transform_matrix": pose, **lens})
kinds = {}
for where, whole in (("each frame", {}), ("the whole file", {"camera_model": "OPENCV_FISHEYE"})):
    Path("transforms.json").write_text(json.dumps({**whole, "frames": frames}))
    cameras = NerfstudioDataParserConfig(data=Path(), eval_mode="all").setup().get_dataparser_outputs("train").cameras
    kinds[where] = CameraType(int(cameras.camera_type[0])).name
    print(f"camera_model OPENCV_FISHEYE with {where}: nerfstudio makes {kinds[where]} cameras of it")
assert kinds == {"each frame": "PERSPECTIVE", "the whole file": "FISHEYE"}, "the behaviour has changed"
PYTHON_END
