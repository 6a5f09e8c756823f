#!/usr/bin/env bash
# nerfstudio 1.1.5: ns-render interpolate --frame-rate 24 writes fewer frames per second: 12 with two views, 22 with twelve.
#
# Guess before the run: the video has the frame rate of its flag.
# Seen: the number of pictures counts the ways between the views (one fewer than views), the length of the video counts the
# views, and the rate written is the quotient: frame rate * (views - 1) / views. What is rendered for 24 per second is slowed down.
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
from types import SimpleNamespace

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.scripts import render

written = []
# A run in place of a trained one, and the video's writer in place of ffmpeg: what lies between them is nerfstudio's.
render._render_trajectory_video = lambda pipeline, cameras, seconds, **_: written.append((len(cameras), seconds))
render.install_checks.check_ffmpeg_installed = lambda: None
for views in (2, 12):
    poses = torch.eye(4)[:3].repeat(views, 1, 1)
    poses[:, 0, 3] = torch.arange(views)
    cameras = Cameras(poses, 50.0, 50.0, 24.0, 16.0)
    pipeline = SimpleNamespace(datamanager=SimpleNamespace(eval_dataset=SimpleNamespace(cameras=cameras)))
    render.eval_setup = lambda *_, **__: (None, pipeline, None, None)
    render.RenderInterpolated(load_config=None, frame_rate=24, interpolation_steps=10).main()
rates = []
for views, (pictures, seconds) in zip((2, 12), written):
    rates.append(round(pictures / seconds, 6))
    print(f"--frame-rate 24 with {views} views: {pictures} pictures in {seconds:.3f} s, {rates[-1]:g} per second")
assert rates == [12.0, 22.0], "the behaviour has changed"
PYTHON_END
