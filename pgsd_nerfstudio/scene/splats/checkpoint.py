"""Read splatfacto checkpoints.

Parameters are named as in nerfstudio 1.1 (gauss_params.*), 1.0 (means, features_dc, ...) or before (colors_all, or colors and
shs_rest, for the harmonics). What does not lie in the checkpoint is read from the run's config.yml beside its folder, as data.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.run_config import entry, read_run_config
from pgsd_nerfstudio.scene.splats.activation import harmonics

# Prefixes of splatfacto's parameters in a state dict: since nerfstudio 1.1, before, and both under DistributedDataParallel.
PREFIXES = (
    "_model.gauss_params.",
    "_model.",
    *(f"{p}{q}" for p in ("_model.module.", "module._model.") for q in ("gauss_params.", "")),
)
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,)}


def read_checkpoint(path: Path) -> Gaussians:
    """Gaussians of a splatfacto checkpoint, not yet checked. No code in the file, or in the run's config.yml, is executed.

    Raises:
        SceneError: the file is not a readable checkpoint, or not splatfacto's, or the config.yml is damaged.
    """
    stored = _loaded(path)
    state = stored.get("pipeline", stored) if isinstance(stored, Mapping) else {}
    state = {name: value for name, value in state.items() if isinstance(name, str)} if isinstance(state, Mapping) else {}
    prefix = next((p for p in PREFIXES if f"{p}means" in state), None)
    if prefix is None:
        raise SceneError(f"{path} holds no Gaussians (means not found): expected a checkpoint of ns-train splatfacto")
    held = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    if missing := [name for name in SHAPES if name not in held]:
        raise SceneError(
            f"{path} holds no Gaussians ({', '.join(missing)} not found): expected a checkpoint of ns-train splatfacto"
        )
    raw = {name: _numbers(path, held, name) for name in SHAPES}
    n = len(raw["means"])
    for name, shape in SHAPES.items():
        if tuple(raw[name].shape) not in {(n, *shape), (n,) * (shape == (1,))}:
            raise SceneError(f"{path}: its {name} are {list(raw[name].shape)}, expected [{n}, {shape[0]}]")
    return Gaussians(
        raw["means"],
        raw["quats"],
        raw["scales"].exp(),
        raw["opacities"].reshape(n).sigmoid(),
        _colors(path, held, n),
        antialiased=_antialiased(path),
    )


def _antialiased(path: Path) -> bool:
    """Whether the run of this checkpoint was rasterized antialiased; False where its config.yml is not beside its folder."""
    config = path.resolve().parent.parent / "config.yml"
    if not config.is_file():
        return False
    try:
        return entry(read_run_config(config), "pipeline", "model", "rasterize_mode") == "antialiased"
    except SceneError as error:
        raise SceneError(
            f"{config} says how the splat of {path.name} was rasterized, and cannot be read: restore it, or move it away"
        ) from error


def _loaded(path: Path) -> Any:
    """What the checkpoint holds, if that is tensors, numbers and words only."""
    # Checkpoints of schedules with decay hold NumPy scalars, saved under the module names of NumPy 1 or 2.
    from numpy.core.multiarray import scalar  # pyright: ignore[reportAttributeAccessIssue]

    dtypes = [np.dtype, *{type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64, np.int32, np.bool_)}]
    allowed: list[Any] = [scalar, (scalar, "numpy._core.multiarray.scalar"), *dtypes]
    allowed_before = torch.serialization.get_safe_globals()
    try:
        with torch.serialization.safe_globals(allowed):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except UnpicklingError as error:
        raise SceneError(f"{path} is not opened: it holds more than tensors and numbers ({_first_line(error)})") from error
    except Exception as error:  # a damaged pickle raises whatever its bytes happen to call for: KeyError, TypeError, ...
        raise SceneError(f"{path} cannot be read as a checkpoint ({_first_line(error)}): copy or train it again") from error
    finally:
        # When the context ends, torch forgets of those that it allowed also that they were allowed before.
        torch.serialization.add_safe_globals(allowed_before)


def _colors(path: Path, held: Mapping[str, Any], n: int) -> Tensor:
    """[n, k, 3] spherical harmonics."""
    if "features_dc" in held and "features_rest" in held:
        constant, rest = _numbers(path, held, "features_dc"), _numbers(path, held, "features_rest")
    elif "colors" in held and "shs_rest" in held:
        constant, rest = _numbers(path, held, "colors"), _numbers(path, held, "shs_rest")
    elif "colors_all" in held and (both := _numbers(path, held, "colors_all")).ndim == 3:
        constant, rest = both[:, :1], both[:, 1:]
    else:
        found = sorted(name for name in held if "color" in name or "feature" in name or "sh" in name)
        raise SceneError(
            f"{path}: its colours are {', '.join(found)[:80] or 'missing'}; expected features_dc and features_rest; "
            "open the run with the nerfstudio that trained it and ns-export gaussian-splat"
        )
    if tuple(constant.shape) not in {(n, 3), (n, 1, 3)} or rest.ndim != 3 or rest.shape[0] != n or rest.shape[2] != 3:
        raise SceneError(
            f"{path}: its colours are {list(constant.shape)} and {list(rest.shape)}, expected [{n}, 3] and [{n}, k, 3]"
        )
    constant = constant.reshape(n, 3)
    if rest.shape[1] == 0:  # with sh-degree 0 splatfacto shows the sigmoid of its colours
        return harmonics(constant.sigmoid())
    if rest.shape[1] not in (3, 8, 15, 24):
        raise SceneError(f"{path}: it has {rest.shape[1]} coefficients beyond the constant; degrees 1 to 4 have 3, 8, 15, 24")
    return torch.cat([constant[:, None], rest], dim=1)


def _numbers(path: Path, held: Mapping[str, Any], name: str) -> Tensor:
    """A parameter in float32, in memory of its own."""
    value = held[name]
    if not isinstance(value, Tensor) or not (value.is_floating_point() and value.layout == torch.strided) or value.ndim < 1:
        raise SceneError(f"{path}: its {name} are no tensor of fractions; copy or train it again")
    try:
        return value.float().clone()
    except RuntimeError as error:
        raise SceneError(f"{path}: its {name} cannot be read ({_first_line(error)}); copy or train it again") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
