"""What nerfstudio 1.1.5 raises about a run of ours before our code is asked, as sentences.

Its commands read config.yml, checkpoint and camera path by themselves, and meet what is damaged there with errors that do not
name the file. The traceback of such an error still holds which one was being read.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import check_version
from pgsd_nerfstudio.scene.run_config import entry, read_run_config
from pgsd_nerfstudio.scene.scene import SceneError

METHOD = "pgsd-weather"


def show_sentences() -> None:
    """Errors that are sentences for the user leave a process as such, without the traceback of nerfstudio's launcher."""
    shown_before = sys.excepthook
    if getattr(shown_before, "shows_sentences", False):
        return

    def show(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, KeyboardInterrupt) and not os.environ.get("PGSD_TRACEBACK"):
            # Python then ends the process with 130, unless anything is imported here: that makes it forget the interruption.
            print("interrupted", file=sys.stderr)
            return
        sentence = str(error) if isinstance(error, SceneError | RunError) else explained(error, traceback)
        if sentence is None or os.environ.get("PGSD_TRACEBACK"):
            shown_before(kind, error, traceback)
        else:
            print(f"pgsd-weather: {sentence}", file=sys.stderr)

    show.shows_sentences = True  # type: ignore[attr-defined]
    sys.excepthook = show


def explained(error: BaseException, traceback: TracebackType | None) -> str | None:
    """The sentence for an error of nerfstudio's about a run of this method; None for any other error.

    Args:
        error: what was raised.
        traceback: of the error.
    """
    frames = list(_frames(traceback))
    for frame in reversed(frames):
        explain = _KNOWN.get((str(frame.f_globals.get("__name__")).rpartition(".")[2], frame.f_code.co_name))
        sentence = None if explain is None else explain(error, frame, frames)
        if sentence is not None:
            return sentence
    return None


def _frames(traceback: TracebackType | None) -> Iterator[FrameType]:
    while traceback is not None:
        yield traceback.tb_frame
        traceback = traceback.tb_next


def _config(error: BaseException, frame: FrameType, frames: list[FrameType]) -> str | None:
    """eval_setup, where config.yml itself could not be read."""
    path = Path(frame.f_locals["config_path"])
    if "config" in frame.f_locals:
        return None
    if isinstance(error, OSError):
        missing = f"there is no run at {path} ({error.strerror}): expected the config.yml that ns-train {METHOD} wrote"
        return missing if METHOD in path.parts else None
    try:
        config = read_run_config(path)
        if entry(config, "method_name") != METHOD:
            return None
        check_version(entry(config, "run", "version"))
    except RunError as reason:
        return str(reason)
    except SceneError as reason:
        return str(reason) if METHOD in path.parts else None
    return f"{path} is damaged: nerfstudio cannot make a configuration of it ({_reason(error)}); train the run again"


def _checkpoint(error: BaseException, frame: FrameType, frames: list[FrameType]) -> str | None:
    """eval_load_checkpoint."""
    config = frame.f_locals["config"]
    if config.method_name != METHOD:
        return None
    path = frame.f_locals.get("load_path")
    if path is None:
        return (
            f"there is no checkpoint in {config.load_dir} ({_reason(error)}): expected step-*.ckpt, as training leaves it there"
        )
    return f"the checkpoint {path} is damaged or cut short ({_reason(error)}): copy it again, or train the run again"


def _render(error: BaseException, frame: FrameType, frames: list[FrameType]) -> str | None:
    """`main` of ns-render, once the run is open: a number of its flags, or the file of the camera path."""
    if not _ours(frame.f_locals.get("pipeline")):
        return None
    command = frame.f_locals["self"]
    zero = [
        name for name in ("downscale_factor", "frame_rate", "interpolation_steps", "seconds") if vars(command).get(name) == 0
    ]
    if zero:
        return f"--{zero[0].replace('_', '-')} must be positive, got 0"
    path = vars(command).get("camera_path_filename")
    rendering = any(inner.f_code.co_name == "_render_trajectory_video" for inner in frames)
    if path is None or (rendering and not isinstance(error, ZeroDivisionError)):
        return None
    if isinstance(error, OSError):
        return f"there is no camera path at {path} ({error.strerror}): draw one in ns-viewer or write one with pgsd path"
    return (
        f"{path} is no camera path that can be rendered ({_reason(error)}): expected seconds, render_width, render_height and "
        "at least one camera in camera_path; draw it anew in ns-viewer or write one with pgsd path"
    )


def _video(error: BaseException, frame: FrameType, frames: list[FrameType]) -> str | None:
    """mediapy's VideoWriter: pictures with alpha, or a rate that is none."""
    if not any(_ours(outer.f_locals.get("pipeline")) for outer in frames):
        return None
    image = frame.f_locals.get("image")
    if image is not None and image.shape[-1] == 4:
        return "a video has no alpha: for rgba add --output-format images --image-format png"
    return f"the video cannot be written ({_reason(error)})"


def _export(error: BaseException, frame: FrameType, frames: list[FrameType]) -> str | None:
    """`main` of ns-export, of a kind that wants another model."""
    if isinstance(error, AssertionError) and _ours(frame.f_locals.get("pipeline")):
        return "a weather can be exported with ns-export gaussian-splat only: the other kinds want a model of rays"
    return None


def _ours(pipeline: Any) -> bool:
    return type(pipeline).__module__.startswith("pgsd_nerfstudio.")


def _reason(error: BaseException) -> str:
    text = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


_KNOWN: dict[tuple[str, str], Callable[[BaseException, FrameType, list[FrameType]], str | None]] = {
    ("eval_utils", "eval_setup"): _config,
    ("eval_utils", "eval_load_checkpoint"): _checkpoint,
    ("render", "main"): _render,
    ("exporter", "main"): _export,
    ("mediapy", "add_image"): _video,
    ("mediapy", "__init__"): _video,
}
