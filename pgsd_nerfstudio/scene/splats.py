"""Read Gaussians from 3DGS .ply files and splatfacto checkpoints.

Both store the variables of the optimizer (log scales, opacity logits); `Gaussians` holds the activated values. The .ply fields
are those of Kerbl et al. (2023): x y z, f_dc_0..2, f_rest_* channel by channel, opacity, scale_0..2, rot_0..3 (wxyz).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError

PLY_FIELDS = (*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in "012"), *(f"rot_{i}" for i in "0123"))
CHECKPOINT_FIELDS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
# Prefixes of splatfacto's parameters in a state dict: since nerfstudio 1.1, before, and both under DistributedDataParallel.
CHECKPOINT_PREFIXES = (
    "_model.gauss_params.",
    "_model.",
    *(f"{p}{q}" for p in ("_model.module.", "module._model.") for q in ("gauss_params.", "")),
)


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
    return _activated(
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


def read_checkpoint(path: Path) -> Gaussians:
    """Read a splatfacto checkpoint. Only tensors and plain values are read; no code in the file is executed.

    Raises:
        SceneError: the file is not a readable checkpoint, is not splatfacto's or is empty, or a field holds a NaN or infinity.
    """
    # Checkpoints of schedules with decay hold NumPy scalars, saved under the module names of NumPy 1 or 2.
    from numpy.core.multiarray import scalar  # pyright: ignore[reportAttributeAccessIssue]

    dtypes = [np.dtype, *{type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)}]
    allowed: list[Any] = [scalar, (scalar, "numpy._core.multiarray.scalar"), *dtypes]
    allowed_before = torch.serialization.get_safe_globals()
    try:
        with torch.serialization.safe_globals(allowed):
            stored = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except UnpicklingError as error:
        raise SceneError(f"{path} is not opened: it holds more than tensors and numbers ({_first_line(error)})") from error
    except (RuntimeError, OSError, EOFError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as a checkpoint ({_first_line(error)}): copy or train it again") from error
    finally:
        # When the context ends, torch forgets of those that it allowed also that they were allowed before.
        torch.serialization.add_safe_globals(allowed_before)
    state = stored.get("pipeline", stored) if isinstance(stored, Mapping) else {}
    prefix = next((p for p in CHECKPOINT_PREFIXES if f"{p}means" in state), None)
    missing = CHECKPOINT_FIELDS if prefix is None else [name for name in CHECKPOINT_FIELDS if f"{prefix}{name}" not in state]
    if prefix is None or missing:
        raise SceneError(
            f"{path} holds no Gaussians ({', '.join(missing)} not found): expected a checkpoint of ns-train splatfacto"
        )
    raw = {name: state[f"{prefix}{name}"].float().clone() for name in CHECKPOINT_FIELDS}
    n = raw["means"].shape[0]
    return _activated(
        path,
        {
            "means": raw["means"],
            "quats": raw["quats"],
            "log scales": raw["scales"],
            "opacity logits": raw["opacities"].reshape(n),
            "features_dc": raw["features_dc"].reshape(n, 1, 3),
            "features_rest": raw["features_rest"].reshape(n, -1, 3),
        },
    )


def _activated(path: Path, raw: Mapping[str, Tensor]) -> Gaussians:
    """Check the raw fields and activate them; they come in the order of `Gaussians`, with the colours in two parts."""
    means, quats, log_scales, logits, dc, rest = raw.values()
    if means.shape[0] == 0:
        raise SceneError(f"{path} is an empty scene: it holds 0 Gaussians")
    for name, values in raw.items():
        if bad := int((~torch.isfinite(values)).sum()):
            raise SceneError(f"{path}: {bad} values of its {name} are NaN or infinite; clean or retrain the splat")
    if zero := int((quats.norm(dim=1) == 0).sum()):
        raise SceneError(f"{path}: {zero} of its rotations are quaternions of length 0; clean or retrain the splat")
    gaussians = Gaussians(
        means,
        torch.nn.functional.normalize(quats, dim=1),
        log_scales.exp(),
        logits.sigmoid(),
        torch.cat([dc, rest], dim=1).contiguous(),
    )
    try:
        gaussians.check_finite()
    except ValueError as error:
        raise SceneError(f"{path}: {error} once activated (log scales reach {float(log_scales.max()):.3g})") from error
    return gaussians


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


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
