"""Read SOG, PlayCanvas's splats as pictures: a .sog (zip) or a folder with meta.json and lossless WebP files.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/ (version 2) and, for files without a
version, read-sog-v1.ts of splat-transform. A pixel is a Gaussian: 16 bits for each log of its centre, three parts of its
quaternion, and bytes that are looked up in a codebook (version 2) or lie between a least and a largest value (version 1).
Harmonics are those of one entry of a palette.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from PIL import Image

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.bounds import FREE, check_size
from pgsd_nerfstudio.scene.splats.quaternions import with_largest

META = "meta.json"
PALETTE_ROW = 64  # entries of the palette in a row of its picture
REST = (0, 3, 8, 15)  # coefficients beyond the constant, by degree
Bytes = Callable[[str], bytes]
"""Function from the name of a file of the scene to what it holds."""


class _Fault(ValueError):
    """What is wrong with the scene, without its name."""


def read_sog(path: Path) -> Gaussians:
    """Gaussians of a .sog, of a meta.json beside its pictures, or of their folder; not yet checked.

    Raises:
        SceneError: a file of it is missing or damaged, or its version is not known.
    """
    try:
        if path.is_dir() or path.name.lower() == META:
            folder = path if path.is_dir() else path.parent
            size = sum(file.stat().st_size for file in folder.glob("*.webp"))
            return _decoded(path, size, lambda name: (folder / _plain(name)).read_bytes())
        return _decoded(path, path.stat().st_size, lambda name: _unzipped(path, _plain(name)))
    except OSError as error:
        raise SceneError(f"{path} lacks a file or cannot be opened ({error.strerror or error}): download it again") from error
    except _Fault as error:
        raise SceneError(f"{path} cannot be read as SOG ({error}): write or download it again") from error


def _unzipped(path: Path, name: str) -> bytes:
    """A file of the archive, from the folder that holds meta.json."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {PurePosixPath(entry.filename): entry for entry in archive.infolist()}
            metas = [entry for entry in entries if entry.name == META]
            if not metas:
                raise _Fault("it holds no meta.json")
            entry = entries.get(min(metas, key=lambda meta: len(meta.parts)).parent / name)
            if entry is None:
                raise _Fault(f"{name} is missing")
            if entry.file_size > max(FREE, 2 * entry.compress_size):  # pictures are packed already
                raise _Fault(f"{name} says that it unpacks to {entry.file_size:,} bytes")
            return archive.read(entry)
    except (_Fault, OSError):
        raise
    except Exception as error:  # a damaged archive raises whatever its bytes lead to: BadZipFile, zlib.error, struct.error, ...
        raise _Fault(f"its archive is damaged: {str(error)[:80]}") from error


def _plain(name: str) -> str:
    if not name or PurePosixPath(name).name != name or "\\" in name:
        raise _Fault(f"{name[:80]!r} is no name of a file in the same folder")
    return name


def _decoded(path: Path, size: int, read: Bytes) -> Gaussians:
    try:
        meta = json.loads(read(META))
    except (ValueError, RecursionError) as error:
        raise _Fault(f"meta.json is no JSON: {str(error)[:80]}") from error
    if not isinstance(meta, dict) or not isinstance(meta.get("means"), dict):
        raise _Fault("meta.json describes no means")
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise _Fault(f"version {str(version)[:20]}; 1 and 2 are known")
    count = _whole(meta.get("count") if version == 2 else (_entry(meta, "means", "shape", list) or [None])[0], "count")

    def picture(part: str, number: int = 0) -> np.ndarray:
        """[pixels, 4] bytes."""
        files = _entry(meta, part, "files", list)
        if len(files) <= number or not isinstance(files[number], str):
            raise _Fault(f"{part} names no file {number + 1}")
        return _pixels(path, size, read(files[number]), files[number])

    def pixels(part: str, number: int = 0) -> np.ndarray:
        """[count, 4] bytes, one pixel for each Gaussian."""
        rgba = picture(part, number).reshape(-1, 4)
        if len(rgba) < count:
            raise _Fault(f"{part} has {len(rgba):,} pixels for {count:,} Gaussians")
        return rgba[:count]

    low, high = pixels("means", 0)[:, :3], pixels("means", 1)[:, :3]
    least, most = _numbers(meta, "means", "mins", 3), _numbers(meta, "means", "maxs", 3)
    log = _between(least, most, (low.astype(np.uint16) | high.astype(np.uint16) << 8) / 65535.0)
    quats, scales, sh0 = pixels("quats"), pixels("scales"), pixels("sh0")
    if version == 2:
        log_scales, constant = _codebook(meta, "scales")[scales[:, :3]], _codebook(meta, "sh0")[sh0[:, :3]]
        opacities = torch.from_numpy(sh0[:, 3] / np.float32(255))
    else:
        log_scales = _between(_numbers(meta, "scales", "mins", 3), _numbers(meta, "scales", "maxs", 3), scales[:, :3] / 255)
        raw = _between(_numbers(meta, "sh0", "mins", 4), _numbers(meta, "sh0", "maxs", 4), sh0 / 255)
        constant, opacities = raw[:, :3], torch.from_numpy(raw[:, 3].astype(np.float32)).sigmoid()
    rest = _rest(meta, version, picture, pixels) if meta.get("shN") else np.zeros((count, 0, 3), np.float32)
    return Gaussians(
        torch.from_numpy((np.sign(log) * np.expm1(np.abs(log))).astype(np.float32)),
        torch.from_numpy(_rotations(quats)),
        torch.from_numpy(log_scales.astype(np.float32)).exp(),
        opacities,
        torch.from_numpy(np.concatenate([constant[:, None].astype(np.float32), rest], axis=1)),
        antialiased=meta.get("model") == "antialiased",
    )


def _rotations(pixels: np.ndarray) -> np.ndarray:
    """[n, 4] wxyz: alpha says which part is the largest, 252 for w; others are within sqrt(1/2)."""
    largest = pixels[:, 3].astype(np.int64) - 252
    if (largest < 0).any():
        raise _Fault(f"{int((largest < 0).sum()):,} of its quaternions do not say which part is the largest")
    return with_largest((pixels[:, :3].astype(np.float32) / 255 * 2 - 1) * np.float32(0.5**0.5), largest)


def _rest(meta: dict, version: int, picture: Callable, pixels: Callable) -> np.ndarray:
    """[n, k, 3] coefficients beyond the constant, of the palette's entry of each Gaussian."""
    palette = picture("shN", 0)
    each = palette.shape[1] // PALETTE_ROW
    if each not in REST[1:] or palette.shape[1] % PALETTE_ROW:
        raise _Fault(f"shN has a palette {palette.shape[1]} wide; degrees 1 to 3 have 192, 512, 960")
    if version == 2:
        values = _codebook(meta, "shN")
    else:
        values = _between(
            _number(meta["shN"].get("mins"), "mins"), _number(meta["shN"].get("maxs"), "maxs"), np.arange(256) / 255
        )
    entries = values[palette[..., :3].reshape(-1, each, 3)].astype(np.float32)
    labels = pixels("shN", 1).astype(np.int64)
    labels = labels[:, 0] | labels[:, 1] << 8
    if len(labels) and labels.max() >= len(entries):
        raise _Fault(f"shN asks for entry {labels.max():,} of {len(entries):,}")
    return entries[labels]


def _pixels(path: Path, size: int, data: bytes, name: str) -> np.ndarray:
    """[height, width, 4] bytes of a lossless picture."""
    try:
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
            check_size(path, size, 4 * image.width * image.height)
            return np.array(image.convert("RGBA"))
    except SceneError:
        raise
    except Exception as error:  # a damaged picture raises whatever its decoder meets: OSError, SyntaxError, struct.error, ...
        raise _Fault(f"{name} is no WebP: {str(error)[:80]}") from error


def _between(least: Any, most: Any, part: np.ndarray) -> np.ndarray:
    low, high = np.asarray(least, np.float64), np.asarray(most, np.float64)
    return low + (high - low) * part


def _codebook(meta: dict, part: str) -> np.ndarray:
    """[256] values that a byte stands for."""
    stored = _entry(meta, part, "codebook", list)
    if len(stored) == 256 and stored[0] is None:
        # A fault of early writers; PlayCanvas's engine puts this in its place.
        first, last = _number(stored[1], f"{part}.codebook"), _number(stored[255], f"{part}.codebook")
        meta[part]["codebook"] = [first + (first - last) / 255, *stored[1:]]
    return np.asarray(_numbers(meta, part, "codebook", 256), np.float32)


def _entry(meta: dict, part: str, name: str, kind: type) -> Any:
    if not isinstance(meta.get(part), dict) or not isinstance(meta[part].get(name), kind):
        raise _Fault(f"meta.json lacks {part}.{name}")
    return meta[part][name]


def _numbers(meta: dict, part: str, name: str, count: int) -> list[float]:
    values = _entry(meta, part, name, list)
    if len(values) != count:
        raise _Fault(f"{part}.{name} has {len(values)} numbers, not {count}")
    return [_number(value, f"{part}.{name}") for value in values]


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e30 or not math.isfinite(value):
        raise _Fault(f"{name} holds {str(value)[:40]}, which is no number to go by")
    return float(value)


def _whole(value: Any, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 32:
        raise _Fault(f"{name} is {str(value)[:40]}, not a number of Gaussians")
    return value
