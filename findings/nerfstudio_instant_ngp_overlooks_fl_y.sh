#!/usr/bin/env bash
# nerfstudio 1.1.5: its parser for instant-ngp's transforms.json gives every camera square pixels, whatever fl_y or camera_angle_y says.
#
# Guess before the run: fl_y is the focal length of the rows, as instant-ngp itself and nerfstudio's other parsers read it.
# Seen: fl_y is read only where the file has both camera_angle_y and y_fov, which no tool writes; else fl_x takes its place, and a
# file without fl_x but with fl_y is refused as having no focal length. colmap2nerf.py of instant-ngp writes fl_x and fl_y.
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

from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

lens = {"w": 64, "h": 48, "cx": 32, "cy": 24, "fl_x": 100.0, "fl_y": 90.0}
frames = []
for name, x in (("0.png", -1), ("1.png", 1)):
    Image.new("RGB", (64, 48)).save(name)
    pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    frames.append({"file_path": name, "transform_matrix": pose})
Path("transforms.json").write_text(json.dumps({**lens, "frames": frames}))
found = {}
for kind, config in (("instant-ngp", InstantNGPDataParserConfig), ("nerfstudio", NerfstudioDataParserConfig)):
    cameras = config(data=Path(), eval_mode="all").setup().get_dataparser_outputs("train").cameras
    found[kind] = float(cameras.fx[0]), float(cameras.fy[0])
for kind, (fx, fy) in found.items():
    print(f"fl_x 100, fl_y 90: the {kind} parser of nerfstudio reads {fx:g} and {fy:g}")
assert found == {"instant-ngp": (100.0, 100.0), "nerfstudio": (100.0, 90.0)}, "the behaviour has changed"
PYTHON_END
