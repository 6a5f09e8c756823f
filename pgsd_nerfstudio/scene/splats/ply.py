"""Read 3DGS .ply files.

Fields of Kerbl et al. (2023): x y z, f_dc_0..2, f_rest_* channel by channel, opacity, scale_0..2, rot_0..3 (wxyz).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.splats.activation import activated

PLY_FIELDS = (*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in "012"), *(f"rot_{i}" for i in "0123"))


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS .ply with spherical harmonics of any degree.

    Raises:
        SceneError: the file is not a readable .ply, has no Gaussians or lacks a field, or a field holds a NaN or infinity.
    """
    from plyfile import PlyData, PlyParseError

    try:
        elements = PlyData.read(str(path), mmap="r")  # without mapping, plyfile reads vertex by vertex
        vertices = elements["vertex"].data
    except (PlyParseError, KeyError, OSError, ValueError, UnicodeDecodeError, EOFError) as error:
        raise SceneError(f"{path} cannot be read as a .ply with vertices ({error}): write or download it again") from error
    names = vertices.dtype.names or ()
    missing = [name for name in PLY_FIELDS if name not in names]
    if missing:
        raise SceneError(
            f"{path} is no 3D Gaussian splat: it lacks the field{'s'[: len(missing) > 1]} {', '.join(missing)}; "
            "a point cloud or mesh must be trained to a splat first (ns-train splatfacto)"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    wanted = [*PLY_FIELDS, *(f"f_rest_{i}" for i in range(rest))]
    columns = {name: np.array(vertices[name], dtype=np.float32) for name in wanted if name in names}
    return activated(
        path,
        {
            "means (x, y, z)": _columns(columns, "x", "y", "z"),
            "rotations (rot_*)": _columns(columns, *(f"rot_{i}" for i in range(4))),
            "log scales (scale_*)": _columns(columns, *(f"scale_{i}" for i in range(3))),
            "opacity logits (opacity)": torch.from_numpy(columns["opacity"]),
            "colours (f_dc_*)": _columns(columns, "f_dc_0", "f_dc_1", "f_dc_2")[:, None],
            "colours (f_rest_*)": _channel_major(path, columns, rest, len(vertices)),
        },
    )


def _columns(columns: Mapping[str, np.ndarray], *names: str) -> Float[Tensor, "n k"]:
    return torch.from_numpy(np.stack([columns[name] for name in names], axis=1))


def _channel_major(path: Path, columns: Mapping[str, np.ndarray], rest: int, n: int) -> Float[Tensor, "n k 3"]:
    """f_rest in splatfacto's order; the .ply lists all coefficients of red, then of green, then of blue."""
    if rest % 3 or math.isqrt(rest // 3 + 1) ** 2 != rest // 3 + 1 or any(f"f_rest_{i}" not in columns for i in range(rest)):
        raise SceneError(
            f"{path} has {rest} f_rest fields; spherical harmonics of degree 0, 1, 2, 3 have 0, 9, 24, 45, numbered from 0"
        )
    if rest == 0:
        return torch.zeros(n, 0, 3)
    return _columns(columns, *(f"f_rest_{i}" for i in range(rest))).reshape(n, 3, rest // 3).transpose(1, 2)
