"""Read splats from .ply files as trainers and editors write them.

Fields of Kerbl et al. (2023): x y z, f_dc_0..2, f_rest_* channel by channel, opacity, scale_0..2, rot_0..3 (wxyz). Besides:
- red, green, blue in place of f_dc_* (colours without harmonics);
- no scale_2: the flat Gaussians of Huang et al., "2D Gaussian Splatting" (2024);
- filter_3D: the smoothing of Mip-Splatting, kept apart from scales and opacities;
- comments of Brush ("SplatRenderMode: mip") and Postshot ("antialiased 1"): opacities are those before the blur of a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.activation import harmonics, smoothed
from pgsd_nerfstudio.scene.splats.ply_file import PlyFile, unreadable

POSITION, ROTATION, SCALE = ("x", "y", "z"), ("rot_0", "rot_1", "rot_2", "rot_3"), ("scale_0", "scale_1", "scale_2")
CONSTANT, RGB = ("f_dc_0", "f_dc_1", "f_dc_2"), ("red", "green", "blue")
FLAT = "scale_2"
MOVING = ("trbf_center", "motion_0", "scale_t", "scaling_t", "rot_r_0")
"""Columns of splats that move: Spacetime Gaussians (trbf_center, motion_0) and 4D Gaussians (the others)."""


def uncompressed(ply: PlyFile) -> Gaussians:
    """Gaussians of an opened .ply, not yet checked; centres are float64 where the file's are.

    Raises:
        SceneError: it holds a mesh, a point cloud or moving Gaussians, or is not whole.
    """
    vertex = ply.element("vertex")
    if vertex is None:
        raise unreadable(ply.path, f"it has no vertices but {', '.join(e.name for e in ply.elements)[:80] or 'nothing'}")
    columns = vertex.columns
    _refuse_others(ply, columns)
    table = ply.table("vertex")
    scales = _columns(table, [name for name in SCALE if name in columns]).exp()
    if FLAT not in columns:
        scales = torch.cat([scales, torch.zeros_like(scales[:, :1])], dim=1)
    opacities = _columns(table, ["opacity"])[:, 0].sigmoid()
    if "filter_3D" in columns:
        scales, opacities = smoothed(scales, opacities, _columns(table, ["filter_3D"])[:, 0])
    rest = rest_names(ply.path, columns)
    if set(CONSTANT) <= columns.keys():
        colors = _columns(table, [*CONSTANT, *rest]).unflatten(1, (-1, 3))
    else:
        beyond = _columns(table, rest).reshape(vertex.count, len(rest) // 3, 3)
        colors = torch.cat([harmonics(_rgb(ply.path, table)), beyond], dim=1)
    exact = np.float64 if "f8" in {columns[name] for name in POSITION} else np.float32
    return Gaussians(
        _columns(table, POSITION, exact),
        _columns(table, ROTATION),
        scales,
        opacities,
        colors,
        antialiased=antialiased(ply.comments),
    )


def rest_names(path: Path, columns: Iterable[str]) -> list[str]:
    """The columns f_rest_* in splatfacto's order, coefficient by coefficient; their numbers go channel by channel.

    Args:
        path: the file, for messages.
        columns: names of all columns.

    Raises:
        SceneError: no degree from 0 to 4 has as many.
    """
    rest = {name for name in columns if name.startswith("f_rest_")}
    each = len(rest) // 3
    whole = len(rest) == 3 * each and math.isqrt(each + 1) ** 2 == each + 1 and each < 25
    if not whole or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        raise SceneError(
            f"{path} has {len(rest)} f_rest fields; spherical harmonics of degree 0, 1, 2, 3, 4 have 0, 9, 24, 45, 72, "
            "numbered from 0"
        )
    return [f"f_rest_{channel * each + i}" for i in range(each) for channel in range(3)]


def antialiased(comments: tuple[str, ...]) -> bool:
    """What the last comment that speaks of it says; False if none does."""
    said = False
    for comment in comments:
        match comment.split():
            case ["SplatRenderMode:", mode]:
                said = mode == "mip"
            case ["antialiased", "0" | "1" as value]:
                said = value == "1"
    return said


def _refuse_others(ply: PlyFile, columns: dict[str, str]) -> None:
    """Say what a .ply is that has vertices and yet is no splat at rest."""
    moving = [name for name in MOVING if name in columns]
    moving += [element.name for element in ply.elements if element.name.startswith("delta_vertex")]
    if moving:
        raise SceneError(f"{ply.path} holds Gaussians that move ({moving[0]}): export one moment of it as a .ply of its own")
    missing = [name for name in (*POSITION, "opacity", *SCALE[:2], *ROTATION) if name not in columns]
    if not set(CONSTANT) <= columns.keys() and not set(RGB) <= columns.keys():
        missing += [name for name in CONSTANT if name not in columns]
    if missing:
        kind = "a mesh" if ply.element("face") else "a point cloud" if len(missing) > 6 else "no whole 3D Gaussian splat"
        raise SceneError(
            f"{ply.path} is {kind}: it lacks the field{'s'[: len(missing) > 1]} {', '.join(missing)}; "
            "a point cloud or mesh must be trained to a splat first (ns-train splatfacto)"
        )


def _columns(table: np.ndarray, names: Sequence[str], kind: type = np.float32) -> Float[Tensor, "n k"]:
    """Columns side by side."""
    return torch.from_numpy(side_by_side(table, names).astype(kind, copy=False))


def side_by_side(table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """[n, k] columns of a table, in its own type if all of its columns have one: then each row is read once."""
    held = table.dtype.names or ()
    if len({table.dtype[name] for name in held}) == 1:
        rows = table.view(table.dtype[0]).reshape(len(table), len(held))
        return np.take(rows, [held.index(name) for name in names], axis=1)
    return np.stack([table[name] for name in names], axis=1) if names else np.empty((len(table), 0))


def _rgb(path: Path, table: np.ndarray) -> Float[Tensor, "n 3"]:
    """Colours in 0..1 of red, green, blue; whole numbers count from 0 to the largest of their type."""
    rgb = _columns(table, RGB)
    if (kind := table.dtype["red"]).kind in "iu":
        return rgb / float(np.iinfo(kind).max)
    if len(rgb) and not float(rgb.max()) <= 2.0:
        raise SceneError(
            f"{path}: red, green, blue are fractions up to {float(rgb.max()):.3g}; expected 0 to 1, or whole numbers"
        )
    return rgb
