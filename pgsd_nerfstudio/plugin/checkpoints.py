"""The checkpoints of a run, read as tensors and plain values, and only where they are whole."""

from __future__ import annotations

import zipfile
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from pgsd_nerfstudio.plugin.environment import RunError, allow_numpy_scalars

FOLDER = "nerfstudio_models"
"""Name of the folder of checkpoints in that of a run."""


def checkpoint_in(folder: Path, step: int | None = None) -> Path:
    """The checkpoint of a step, or the newest.

    Args:
        folder: of checkpoints.
        step: of training; None: the last.

    Raises:
        RunError: there is none.
    """
    if not folder.is_dir():
        raise RunError(f"checkpoints lie in the folder {FOLDER} of a run, found no folder at {folder}")
    names = f"step-{step:09d}.ckpt" if step is not None else "step-*.ckpt"
    found = sorted(folder.glob(names))
    if not found:
        inside = folder / FOLDER
        hint = f"use {inside}" if inside.is_dir() else "training leaves it there"
        raise RunError(f"there is no checkpoint {names} in {folder}: {hint}")
    return found[-1]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What nerfstudio's trainer has stored. Nothing in the file is run; its checksums, which torch ignores, are compared.

    Args:
        path: of the file.

    Raises:
        RunError: it is missing, damaged, or no checkpoint of this method.
    """
    allow_numpy_scalars()
    try:
        with zipfile.ZipFile(path) as file:
            broken = file.testzip()
        stored = torch.load(path, map_location="cpu", weights_only=True)
        names = list(stored["pipeline"])
        int(stored["step"])
    except FileNotFoundError as error:
        raise RunError(f"there is no checkpoint at {path}") from error
    except UnpicklingError as error:
        raise RunError(f"{path} is not opened: it holds something else than tensors and numbers, or is damaged") from error
    except Exception as error:  # whatever zipfile, torch and pickle meet in bytes that are not theirs
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RunError(f"the checkpoint {path} is damaged ({reason}): take an older one or train anew") from error
    if broken is not None:
        raise RunError(f"the checkpoint {path} is damaged: its part {broken} has changed; take an older one or train anew")
    if not any(str(name).startswith("_model.look.") for name in names):
        raise RunError(f"{path} is no checkpoint of pgsd-weather: it holds no learned look")
    return stored
