#!/usr/bin/env bash
# open3d-cpu 0.20.0: VoxelBlockGrid raises errors where a depth image has little in it, instead of returning nothing.
#
# Guess before the run: a depth image with one valid pixel touches the blocks around it, and a grid that holds no surface gives an
# empty mesh.
# Seen: compute_unique_block_coordinates looks only at every fourth pixel of a row and of a column. If none of those has depth, it
# raises RuntimeError "No block is touched in TSDF volume", whatever the other pixels hold. extract_triangle_mesh of a grid without
# colours whose voxels hold no crossing raises RuntimeError in SetVertexColors ("Tensor has shape {0}"). It matters where views
# of a capture see little: the fusion of all views ends for the sake of one.
#
# Needs python3 (3.10-3.12), the network, and about 1 GB in $TMPDIR. Exits non-zero if the behaviour changes.
set -euo pipefail
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
"${PYTHON:-python3}" -m venv "$made/venv"
"$made/venv/bin/pip" -q install uv==0.13.9
VIRTUAL_ENV="$made/venv" "$made/venv/bin/uv" pip install -q open3d-cpu==0.20.0 numpy==1.26.4
cd "$made"
"$made/venv/bin/python" - <<'PYTHON_END'
import numpy as np
import open3d as o3d

core = o3d.core
intrinsics = core.Tensor(np.array([[30.0, 0, 16], [0, 30.0, 16], [0, 0, 1]]))
pose = core.Tensor(np.eye(4))


def grid():
    names, types = ("tsdf", "weight"), (core.float32, core.float32)
    return o3d.t.geometry.VoxelBlockGrid(names, types, ((1), (1)), 0.04, 8, 1000, core.Device("CPU:0"))


def image(*pixels):
    depth = np.zeros((32, 32, 1), np.float32)
    for row, column in pixels:
        depth[row, column] = 2.0
    return o3d.t.geometry.Image(core.Tensor(depth))


def said(call):
    try:
        return call()
    except RuntimeError as error:
        return str(error)


def touched(*pixels):
    return said(lambda: grid().compute_unique_block_coordinates(image(*pixels), intrinsics, pose, 1.0, 10.0, 8.0))


on, off = touched((16, 16)), touched((17, 17), (18, 18), (19, 19), (1, 2))
volume = grid()
blocks = volume.compute_unique_block_coordinates(image((16, 16)), intrinsics, pose, 1.0, 10.0, 8.0)
far = o3d.t.geometry.Image(core.Tensor(np.full((32, 32, 1), 100.0, np.float32)))  # all of the blocks are free space
volume.hashmap().activate(blocks)
volume.integrate(blocks, far, intrinsics, pose, 1.0, 1000.0, 8.0)
mesh = said(lambda: volume.extract_triangle_mesh(0.5))
print(f"open3d {o3d.__version__}")
print(f"one pixel in row and column 16: {len(on)} blocks")
print(f"four pixels elsewhere: {'No block is touched' in off and 'RuntimeError: No block is touched' or off}")
print(f"mesh of free space: {'SetVertexColors' in str(mesh) and 'RuntimeError in SetVertexColors' or mesh}")
assert len(on) > 0 and "No block is touched" in off and "SetVertexColors" in mesh, "the behaviour has changed"
PYTHON_END
