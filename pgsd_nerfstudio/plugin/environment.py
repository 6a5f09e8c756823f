"""What nerfstudio 1.1.5 needs of the process before any of its commands can run this method.

Loaded with the entry point, so by every ns-* command: it stays cheap, and does nothing where nothing is missing.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from types import TracebackType

import numpy as np
import torch

from pgsd_nerfstudio.refusal import Refusal
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.storage import cache_dir


class RunError(Refusal):
    """A run that cannot be trained or opened, in one sentence: what was expected, what was found and what to do."""


def prepare() -> None:
    """Allow nerfstudio's own checkpoints, offer an ffmpeg, show bad input as a sentence."""
    allow_numpy_scalars()
    _offer_ffmpeg()
    _show_sentences()


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


def _show_sentences() -> None:
    """Errors that are sentences for the user leave a process as such, without the traceback of nerfstudio's launcher."""
    shown_before = sys.excepthook
    if getattr(shown_before, "shows_sentences", False):
        return

    def show(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, KeyboardInterrupt) and not os.environ.get("PGSD_TRACEBACK"):
            # Python then ends the process with 130, unless anything is imported here: that makes it forget the interruption.
            print("interrupted", file=sys.stderr)
            return
        from pgsd_nerfstudio.plugin.known_errors import explained

        sentence = str(error) if isinstance(error, SceneError | RunError) else explained(error, traceback)
        if sentence is None or os.environ.get("PGSD_TRACEBACK"):
            shown_before(kind, error, traceback)
        else:
            print(f"pgsd-weather: {sentence}", file=sys.stderr)

    show.shows_sentences = True  # type: ignore[attr-defined]
    sys.excepthook = show
