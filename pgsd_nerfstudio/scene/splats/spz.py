"""Read .spz, Niantic's packed splats: versions 1 to 3 in one gzip stream, version 4 in a zstd frame for each kind of value.

Format: https://github.com/nianticlabs/spz (README and src/cc/load-spz.cc, July 2026). Centres are 24-bit fixed point, log
scales and opacities bytes, colours bytes of 0.15 f_dc + 0.5, harmonics bytes over -1..1. The format asks for axes to the right,
up and back; converters store those of their .ply instead, and only the extension SPZ_ADOBE_coordinate_system says so.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.similarity import moved
from pgsd_nerfstudio.scene.splats.bounds import check_size, contents, gunzipped, unzstd
from pgsd_nerfstudio.scene.splats.quaternions import with_largest

MAGIC = b"NGSP"
COLOUR = 0.15  # of f_dc; leaves room beyond black and white
REST = (0, 3, 8, 15, 24)  # coefficients beyond the constant, by degree
ANTIALIASED, EXTENDED = 1, 2  # flags
AXES = 0xADBE0003  # the extension that names them
# By its number from 1: which way x, y and z point, right or left, up or down, front or back.
USUAL = "RUB"
"""Axes that the format asks for."""
SYSTEMS = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")


@dataclass(frozen=True)
class Header:
    """The first bytes of the unpacked file."""

    version: int
    count: int
    degree: int
    fraction: int
    """Bits of a centre that are behind the point."""
    flags: int

    def sizes(self) -> tuple[int, ...]:
        """Bytes of centres, opacities, colours, scales, rotations and harmonics."""
        each = (9 if self.version > 1 else 6, 1, 3, 3, 4 if self.version > 2 else 3, 3 * REST[self.degree])
        return tuple(self.count * size for size in each)


def read_spz(path: Path) -> Gaussians:
    """Gaussians of a .spz, not yet checked.

    Raises:
        SceneError: the file is damaged, or of a version or degree that is not known.
    """
    return unpacked(path, contents(path))


def unpacked(path: Path, data: bytes, axes: str | None = None) -> Gaussians:
    """Gaussians of the bytes of a .spz, which may lie within another file; not yet checked.

    Args:
        path: the file, for messages.
        data: the bytes.
        axes: those that are wanted, one of `SYSTEMS`; None: those of .ply (RDF) if the file names its own, else as they are.

    Raises:
        SceneError: as for `read_spz`.
    """
    if data.startswith(MAGIC):
        header, parts, extensions = _frames(path, data)
    else:
        header, parts, extensions = _stream(path, gunzipped(path, data))
    centres, opacities, colours, scales, rotations, rest = (np.frombuffer(part, np.uint8) for part in parts)
    n = header.count
    rgb = (colours.reshape(n, 1, 3) / np.float32(255) - np.float32(0.5)) / np.float32(COLOUR)
    rest = (rest.reshape(n, -1, 3).astype(np.float32) - 128) / 128
    gaussians = Gaussians(
        torch.from_numpy(_centres(centres, header)),
        torch.from_numpy(_rotations(rotations, header)),
        torch.from_numpy(scales.reshape(n, 3) / np.float32(16) - 10).exp(),
        torch.from_numpy(opacities / np.float32(255)),
        torch.from_numpy(np.concatenate([rgb, rest], axis=1)),
        antialiased=bool(header.flags & ANTIALIASED),
    )
    named = _named_axes(path, extensions) if header.flags & EXTENDED else None
    if named is None and axes is None:
        return gaussians
    return moved(gaussians, _between(named or USUAL, axes or "RDF"))


def _stream(path: Path, data: bytes) -> tuple[Header, list[bytes], bytes]:
    """Versions 1 to 3: a header of 16 bytes, the values one kind after the other, extensions."""
    if len(data) < 16 or not data.startswith(MAGIC):
        raise SceneError(f"{path} is packed with gzip and no .spz: unpack it first (gunzip), or download it again")
    header = _header(path, data, versions=(1, 2, 3))
    end = 16 + sum(header.sizes())
    if len(data) < end:
        raise SceneError(f"{path} is cut off: {header.count:,} Gaussians need {end:,} bytes, it unpacks to {len(data):,}")
    if len(data) > end and not header.flags & EXTENDED:
        raise SceneError(f"{path} is damaged: {header.count:,} Gaussians need {end:,} bytes, it unpacks to {len(data):,}")
    ends = 16 + np.cumsum((0, *header.sizes()))
    return header, [data[a:b] for a, b in pairwise(ends)], data[end:]


def _frames(path: Path, data: bytes) -> tuple[Header, list[bytes], bytes]:
    """Version 4: a header of 32 bytes, extensions, a table of contents, and a frame for each kind of value that there is."""
    if len(data) < 32:
        raise SceneError(f"{path} is cut off: a .spz has a header of 32 bytes")
    header = _header(path, data, versions=(4,))
    frames, (contents,) = data[15], struct.unpack_from("<I", data, 16)
    sizes = [size for size in header.sizes() if size]
    start = contents + 16 * frames
    if frames != len(sizes) or contents < 32 or start > len(data):
        raise SceneError(f"{path} is damaged: expected {len(sizes)} parts and their table, found {frames} at byte {contents:,}")
    check_size(path, len(data), sum(sizes))
    parts = []
    for i, size in enumerate(sizes):
        packed, announced = struct.unpack_from("<QQ", data, contents + 16 * i)
        if announced != size or packed > len(data) - start:
            raise SceneError(f"{path} is damaged or cut off: part {i + 1} has {announced:,} bytes, {size:,} are needed")
        parts.append(unzstd(path, data[start : start + packed], size))
        start += packed
    if start != len(data):
        raise SceneError(f"{path} is damaged: {len(data) - start:,} bytes follow its last part")
    whole = iter(parts)
    return header, [next(whole) if size else b"" for size in header.sizes()], data[32:contents]


def _header(path: Path, data: bytes, versions: tuple[int, ...]) -> Header:
    version, count, degree, fraction, flags = struct.unpack_from("<IIBBB", data, 4)
    if version not in versions:
        raise SceneError(f"{path} is a .spz of version {version}; versions 1 to 4 are read: write it again as one of them")
    if degree >= len(REST) or fraction > 24:
        raise SceneError(f"{path} is damaged: it has harmonics of degree {degree} and {fraction} bits of fraction")
    return Header(version, count, degree, fraction, flags)


def _centres(stored: np.ndarray, header: Header) -> np.ndarray:
    if header.version == 1:
        return stored.view("<f2").astype(np.float32).reshape(-1, 3)
    low, middle, high = (stored[i::3].astype(np.int32) for i in range(3))
    whole = low | middle << 8 | high << 16
    whole -= (whole >= 1 << 23).astype(np.int32) << 24
    return (whole / np.float32(1 << header.fraction)).astype(np.float32).reshape(-1, 3)


def _rotations(stored: np.ndarray, header: Header) -> np.ndarray:
    """[n, 4] wxyz of x, y and z as bytes (version 2), or of the three smaller parts in 10 bits (sign, size) each."""
    if header.version < 3:
        return with_largest(stored.reshape(-1, 3) / np.float32(127.5) - 1, np.zeros(header.count, np.int64))
    words = stored.view("<u4")
    fields = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    small = (fields & 511).astype(np.float32) * np.float32(0.5**0.5 / 511)
    small[fields >= 512] *= -1
    return with_largest(small, (words >> 30).astype(np.int64))[:, [3, 0, 1, 2]]  # xyzw in the file


def _named_axes(path: Path, extensions: bytes) -> str | None:
    """The axes of the file if an extension names them; the extensions of others are skipped."""
    at = 0
    while at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == AXES and length == 4 and at + 12 <= len(extensions):
            (system,) = struct.unpack_from("<I", extensions, at + 8)
            if not 1 <= system <= len(SYSTEMS):
                raise SceneError(f"{path}: its coordinate system has the number {system}; 1 to {len(SYSTEMS)} are known")
            return SYSTEMS[system - 1]
        at += 8 + length
    return None


def _between(axes: str, others: str) -> torch.Tensor:
    """[4, 4] from coordinates along some axes to those along others."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = _directions(others).T @ _directions(axes)
    return transform


def _directions(axes: str) -> torch.Tensor:
    """[3, 3]: each column says how far one of the axes leads to the right, down and to the front."""
    ways = {"R": (0, 1.0), "L": (0, -1.0), "D": (1, 1.0), "U": (1, -1.0), "F": (2, 1.0), "B": (2, -1.0)}
    directions = torch.zeros(3, 3, dtype=torch.float64)
    for column, letter in enumerate(axes):
        row, sign = ways[letter]
        directions[row, column] = sign
    return directions
