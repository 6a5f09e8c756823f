"""A dark floor of 6 x 6 m as a splat with eight views of it, for tests of commands."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

FIELDS = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]


def look_inward(azimuth: float) -> np.ndarray:
    """Camera to world (OpenGL) at 4 m from the middle and 1.5 m above the floor."""
    center = np.array([4 * math.cos(azimuth), 4 * math.sin(azimuth), 1.5])
    back = center / np.linalg.norm(center)
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, center], axis=1)
    return pose


def write_yard(folder: Path) -> tuple[Path, Path]:
    """The .ply, and the folder of its transforms.json."""
    side = np.linspace(-3, 3, 50, dtype=np.float32)
    points = np.zeros(side.size**2, dtype=[(name, "f4") for name in FIELDS])
    points["x"], points["y"] = (axis.ravel() for axis in np.meshgrid(side, side))
    points["f_dc_0"] = points["f_dc_1"] = points["f_dc_2"] = (0.1 - 0.5) / 0.28209479
    points["opacity"], points["rot_0"] = 6.0, 1.0
    points["scale_0"] = points["scale_1"] = math.log(0.08)
    points["scale_2"] = math.log(0.005)
    PlyData([PlyElement.describe(points, "vertex")]).write(str(folder / "yard.ply"))
    frames = [{"file_path": f"images/{i}.jpg", "transform_matrix": look_inward(i * math.pi / 4).tolist()} for i in range(8)]
    capture = {"w": 96, "h": 64, "fl_x": 80.0, "fl_y": 80.0, "cx": 48.0, "cy": 32.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(capture))
    return folder / "yard.ply", folder
