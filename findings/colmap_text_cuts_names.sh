#!/usr/bin/env bash
# COLMAP 4.2.1 (pycolmap): a reconstruction written as text and read again has lost what follows the first space in a photograph's
# name; written as binary it has not.
#
# Guess before the run: both forms of one reconstruction hold the same names, since the name is the last entry of its line in
# images.txt and is written there whole ("IMG 0001.jpg").
# Seen: the reader takes the name up to the first space, so that photographs are looked for under half a name, and several images
# get the same one without a word. Whoever reads images.txt for photographs has to take the rest of the line. (nerfstudio 1.1.5
# cuts names of text files in the same way.)
#
# Needs python3 (3.10-3.12), the network, and about 300 MB in $TMPDIR. Exits non-zero if the behaviour changes.
set -euo pipefail
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
"${PYTHON:-python3}" -m venv "$made/venv"
"$made/venv/bin/pip" -q install pycolmap==4.2.1 numpy==1.26.4
cd "$made"
"$made/venv/bin/python" - <<'PYTHON_END'
from pathlib import Path

import numpy as np
import pycolmap

reconstruction = pycolmap.Reconstruction()
reconstruction.add_camera_with_trivial_rig(
    pycolmap.Camera(camera_id=1, model="PINHOLE", width=64, height=48, params=[100, 100, 32, 24])
)
for number in (1, 2):
    image = pycolmap.Image(name=f"IMG {number}.jpg", camera_id=1, image_id=number)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0, 0, 1])), np.zeros(3))
    reconstruction.add_image_with_trivial_frame(image, pose)
found = {}
for form in ("text", "binary"):
    Path(form).mkdir()
    getattr(reconstruction, f"write_{form}")(form)
    again = pycolmap.Reconstruction(form)
    found[form] = sorted(image.name for image in again.images.values())
    print(f"COLMAP {pycolmap.__version__}: IMG 1.jpg and IMG 2.jpg, written and read as {form}: {', '.join(found[form])}")
written = Path("text/images.txt").read_text()
assert "IMG 1.jpg" in written and "IMG 2.jpg" in written, "the behaviour has changed"
assert found == {"text": ["IMG", "IMG"], "binary": ["IMG 1.jpg", "IMG 2.jpg"]}, "the behaviour has changed"
PYTHON_END
