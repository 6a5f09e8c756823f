"""The bytes of a file, and how much a packed one may unpack to, so that a few bytes cannot ask for all memory."""

from __future__ import annotations

import zlib
from pathlib import Path

import zstandard

from pgsd_nerfstudio.scene.errors import SceneError

FREE = 1 << 24  # bytes that any file may unpack to
RATIO = 100  # times its own size; splats shrink to a quarter
WINDOW = 1 << 27  # bytes that a frame of zstd may look back


def contents(path: Path) -> bytes:
    """All bytes of a file.

    Raises:
        SceneError: it cannot be opened.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be opened ({error.strerror})") from error


def largest(packed: int) -> int:
    """Bytes that `packed` bytes may unpack to."""
    return max(FREE, RATIO * packed)


def check_size(path: Path, packed: int, unpacked: int) -> None:
    """Refuse before anything is allocated.

    Raises:
        SceneError: the file unpacks to more than it may.
    """
    if unpacked > largest(packed):
        raise SceneError(
            f"{path} says that its {packed:,} bytes unpack to {unpacked:,}, more than {RATIO} times as much: it is damaged"
        )


def gunzipped(path: Path, data: bytes) -> bytes:
    """A gzip stream unpacked.

    Raises:
        SceneError: it is damaged or cut off, or unpacks to more than it may.
    """
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    limit = largest(len(data))
    try:
        out = stream.decompress(data, limit + 1)
    except zlib.error as error:
        raise SceneError(f"{path} cannot be unpacked ({error}): copy or download it again") from error
    check_size(path, len(data), len(out))
    if not stream.eof or stream.unused_data:
        raise SceneError(f"{path} is {'damaged' if stream.eof else 'cut off'}: copy or download it again")
    return out


def unzstd(path: Path, data: bytes, size: int) -> bytes:
    """A frame of zstd of known size unpacked.

    Raises:
        SceneError: it is damaged, or does not unpack to `size` bytes.
    """
    try:
        with zstandard.ZstdDecompressor(max_window_size=WINDOW).stream_reader(data) as stream:
            out = stream.read(size)
            more = stream.read(1)
    except zstandard.ZstdError as error:
        raise SceneError(f"{path} cannot be unpacked ({error}): copy or download it again") from error
    if len(out) != size or more:
        raise SceneError(f"{path} unpacks to another size than the {size:,} bytes that it announces: copy or download it again")
    return out
