"""Read splatfacto checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.splats.activation import activated

CHECKPOINT_FIELDS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
# Prefixes of splatfacto's parameters in a state dict: since nerfstudio 1.1, before, and both under DistributedDataParallel.
CHECKPOINT_PREFIXES = (
    "_model.gauss_params.",
    "_model.",
    *(f"{p}{q}" for p in ("_model.module.", "module._model.") for q in ("gauss_params.", "")),
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
    return activated(
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


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
