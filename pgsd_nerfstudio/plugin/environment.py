"""What nerfstudio 1.1.5 needs of the process before any of its commands can run this method.

Loaded with the entry point, so by every ns-* command: it stays cheap, and does nothing where nothing is missing.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import torch

from pgsd_nerfstudio.refusal import Refusal
from pgsd_nerfstudio.storage import cache_dir


class RunError(Refusal):
    """A run that cannot be trained or opened, in one sentence: what was expected, what was found and what to do."""


def prepare() -> None:
    """Allow nerfstudio's own checkpoints, offer an ffmpeg."""
    allow_numpy_scalars()
    _offer_ffmpeg()


def allow_numpy_scalars() -> None:
    """torch >= 2.6 refuses the NumPy scalars that the schedulers leave in every checkpoint of nerfstudio 1.1.5."""
    from numpy.core.multiarray import scalar  # type: ignore[attr-defined]

    dtypes = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))]
    torch.serialization.add_safe_globals([scalar, (scalar, "numpy._core.multiarray.scalar"), *dtypes])


def _offer_ffmpeg() -> None:
    """ns-render looks for a program named ffmpeg: where there is none, imageio's copy takes its place in a private folder."""
    if shutil.which("ffmpeg"):
        return
    import imageio_ffmpeg

    folder = cache_dir() / "bin"
    link = folder / "ffmpeg"
    try:
        program = Path(imageio_ffmpeg.get_ffmpeg_exe())
        if not link.exists() or link.resolve() != program.resolve():
            folder.mkdir(parents=True, exist_ok=True)
            beside = folder / f".ffmpeg.{os.getpid()}"
            beside.symlink_to(program)
            beside.replace(link)
    except (OSError, RuntimeError):
        return  # ns-render then says itself that it misses ffmpeg; nothing else needs it
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}{os.pathsep}{folder}"
