"""Pictures and videos on disk: frames in 0..1 to H.264 mp4 and PNG, never a half-written file."""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from pgsd_nerfstudio.storage import atomic_write


def to_bytes(picture: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colours in 0..1, clipped and rounded to 8 bits."""
    return (picture.detach().cpu().clamp(0.0, 1.0) * 255.0 + 0.5).byte().contiguous().numpy()


def write_picture(path: Path, picture: Float[Tensor, "h w 3"]) -> None:
    """Write one picture as PNG.

    Raises:
        OSError: it could not be written; nothing is left behind.
    """
    with atomic_write(path) as unfinished:
        Image.fromarray(to_bytes(picture)).save(unfinished)


def write_video(path: str | Path, frames: Iterable[Float[Tensor, "h w 3"]], fps: float) -> int:
    """Write frames as they come as an H.264 mp4; returns how many.

    H.264 wants even sizes: odd ones lose their last row or column.

    Raises:
        ValueError: there are no frames, or the frames per second are not a positive number.
        OSError: it could not be written; nothing is left behind.
    """
    count, path = 0, Path(path).expanduser()
    if not 0 < fps < math.inf:
        raise ValueError(f"a video needs a positive number of frames per second, got {fps:g}")
    with atomic_write(path) as unfinished, ExitStack() as stack:
        send: Callable[[bytes], object] | None = None
        for frame in frames:
            even = to_bytes(frame)[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
            if send is None:
                send = stack.enter_context(_encoder(unfinished, even.shape[1], even.shape[0], fps))
            send(np.ascontiguousarray(even).tobytes())
            count += 1
        if count == 0:
            raise ValueError(f"no frames to write to {path}")
        stack.close()  # before the file takes its name, since ffmpeg writes most of it at the end
    return count


@contextmanager
def _encoder(path: Path, width: int, height: int, fps: float) -> Iterator[Callable[[bytes], object]]:
    """A running ffmpeg that takes RGB frames.

    imageio_ffmpeg's own writer does not ask how ffmpeg ended: on a full disk it would hand on a damaged file.
    """
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    # crf 17 keeps single flakes, which the default of 23 smears; faststart lets browsers play while loading.
    command += ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "17", "-movflags", "+faststart", "-f", "mp4", str(path)]
    with tempfile.TemporaryFile() as said, subprocess.Popen(command, stdin=subprocess.PIPE, stderr=said) as ffmpeg:
        assert ffmpeg.stdin is not None
        try:
            yield ffmpeg.stdin.write
            ffmpeg.stdin.close()
            broken = ffmpeg.wait() != 0
        except BrokenPipeError:
            broken = True
            with suppress(BrokenPipeError):  # closing tries once more to send what ffmpeg no longer takes
                ffmpeg.stdin.close()
        except BaseException:
            ffmpeg.kill()
            raise
        if broken:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
            raise OSError(lines[-1] if lines else f"ffmpeg ended with status {ffmpeg.wait()}")
