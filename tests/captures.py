"""A ring of views, and files of cameras that describe it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 64, 48


def ring(count: int = 4) -> np.ndarray:
    """Camera to world, OpenGL axes, of cameras that look at the origin from a circle of radius 3 around z."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, 2 * np.pi * np.arange(count) / count, strict=True):
        back = np.array([np.cos(angle), np.sin(angle), 0.0])  # OpenGL cameras look along -z
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        pose[:3] = np.stack([right, np.cross(back, right), back, 3 * back], axis=1)
    return poses


def transforms(count: int = 4, **changes: Any) -> dict[str, Any]:
    """Content of a transforms.json of the ring; `changes` replace its entries, None takes them out."""
    frames = [{"file_path": f"images/{i}.jpg", "transform_matrix": pose.tolist()} for i, pose in enumerate(ring(count))]
    meta = {"camera_model": "OPENCV", "fl_x": 100.0, "fl_y": 90.0, "cx": 32.0, "cy": 24.0, "w": WIDTH, "h": HEIGHT}
    return {name: value for name, value in ({**meta, "frames": frames} | changes).items() if value is not None}


def write_transforms(path: Path, count: int = 4, **changes: Any) -> Path:
    path.write_text(json.dumps(transforms(count, **changes)))
    return path


def write_photographs(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    for number, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, (10 * number, 0, 0)).save(path)
