"""Read .ksplat of levels 0 to 2, as mkkellogg's viewer packs splats.

Format: SplatBuffer in https://github.com/mkkellogg/GaussianSplats3D (0.4.7). A header of 4096 bytes, one of 1024 for each
section, then for each section the sizes and middles of its buckets and a row for each Gaussian. Level 0 holds floats; level 1
halves, and centres as 16 bits within a bucket; level 2 besides harmonics as bytes. Colours and opacities are bytes throughout.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.activation import harmonics, joined
from pgsd_nerfstudio.scene.splats.bounds import contents

HEADER, SECTION = 4096, 1024  # bytes
REST = (0, 3, 8, 15)  # coefficients beyond the constant, by degree
BANDS = ((0, 3), (3, 8), (8, 15))  # in a row, red, green and blue of a degree follow each other
RANGE = 1.5  # of harmonics that are bytes, where the header has none
FULL = 32767  # steps from the middle of a bucket to its side, where the section has none


@dataclass(frozen=True)
class Section:
    """Where a section lies in the file, and how it is packed."""

    count: int
    degree: int
    bucket_size: int
    full_buckets: int
    step: float
    """Scene units of one step of a packed centre."""
    steps: int
    """From the middle of a bucket to its side."""
    partial_sizes: int
    """Where the sizes of buckets that are not full begin; their number is `partial_buckets`."""
    partial_buckets: int
    middles: int
    buckets: int
    rows: int
    """Where its Gaussians begin."""
    end: int


def read_ksplat(path: Path) -> Gaussians:
    """Gaussians of a .ksplat, not yet checked.

    Raises:
        SceneError: the file is damaged or cut off, or of a version or level that is not known.
    """
    data = contents(path)
    if len(data) < HEADER:
        raise SceneError(f"{path} is no .ksplat or cut off: its header needs {HEADER} bytes, it has {len(data):,}")
    major, minor = data[0], data[1]
    sections, _, _, count = struct.unpack_from("<4I", data, 4)  # the second is of those that a stream has brought so far
    (level,) = struct.unpack_from("<H", data, 20)
    low, high = struct.unpack_from("<2f", data, 36)
    if (major, minor) != (0, 1) or level > 2:
        raise SceneError(f"{path} is a .ksplat of version {major}.{minor} and level {level}; 0.1 and levels 0 to 2 are read")
    if sections > (len(data) - HEADER) // SECTION:
        raise SceneError(f"{path} is damaged: its {len(data):,} bytes have no room for {sections:,} sections")
    low, high = low or -RANGE, high or RANGE
    parts, at = [], HEADER + sections * SECTION
    for number in range(sections):
        section = _section(path, data, HEADER + number * SECTION, at, level)
        parts.append(_gaussians(path, data, section, level, low, high))
        at = section.end
    held = sum(len(part) for part in parts)
    if held != count:
        raise SceneError(f"{path} is damaged: its header has {count:,} Gaussians, its sections {held:,}")
    if not parts:
        return Gaussians.empty()
    return joined(parts)


def _row(level: int, degree: int) -> np.dtype:
    wide = "<f4" if level == 0 else "<f2"
    rest = ("<f4", "<f2", "u1")[level]
    centre = "<f4" if level == 0 else "<u2"
    return np.dtype(
        [
            ("centre", centre, 3),
            ("scales", wide, 3),
            ("rotation", wide, 4),
            ("colour", "u1", 4),
            ("rest", rest, 3 * REST[degree]),
        ]
    )


def _section(path: Path, data: bytes, header: int, start: int, level: int) -> Section:
    count, most, bucket_size, buckets = struct.unpack_from("<4I", data, header)
    (block,) = struct.unpack_from("<f", data, header + 16)
    (bucket_bytes,) = struct.unpack_from("<H", data, header + 20)
    (steps,) = struct.unpack_from("<I", data, header + 24)
    full, partial = struct.unpack_from("<2I", data, header + 32)
    (degree,) = struct.unpack_from("<H", data, header + 40)
    if degree >= len(REST) or count > most:
        raise SceneError(f"{path} is damaged: a section has {count:,} of {most:,} Gaussians and harmonics of degree {degree}")
    middles = start + 4 * partial
    rows = middles + bucket_bytes * buckets
    end = rows + _row(level, degree).itemsize * most
    if end > len(data):
        raise SceneError(f"{path} is cut off or damaged: a section needs {end:,} bytes, the file has {len(data):,}")
    if level and (bucket_bytes != 12 or full + partial > buckets):
        raise SceneError(
            f"{path} is damaged: {full:,} full and {partial:,} other buckets of {bucket_bytes} bytes in {buckets:,}"
        )
    steps = steps or FULL
    return Section(count, degree, bucket_size, full, block / 2 / steps, steps, start, partial, middles, buckets, rows, end)


def _gaussians(path: Path, data: bytes, section: Section, level: int, low: float, high: float) -> Gaussians:
    table = np.frombuffer(data, _row(level, section.degree), section.count, section.rows)
    centres = table["centre"].astype(np.float32)
    if level:
        middles = np.frombuffer(data, "<f4", 3 * section.buckets, section.middles).reshape(-1, 3)
        centres = (centres - section.steps) * np.float32(section.step) + middles[_buckets(path, data, section)]
    rest = table["rest"].astype(np.float32)
    if level == 2:
        rest = low + rest / 255 * np.float32(high - low)
    ordered = np.empty((section.count, REST[section.degree], 3), np.float32)
    for first, last in BANDS[: section.degree]:
        ordered[:, first:last] = rest[:, 3 * first : 3 * last].reshape(-1, 3, last - first).transpose(0, 2, 1)
    colour = table["colour"].astype(np.float32) / 255
    constant = harmonics(torch.from_numpy(colour[:, :3]))
    return Gaussians(
        torch.from_numpy(centres),
        torch.from_numpy(table["rotation"].astype(np.float32)),
        torch.from_numpy(table["scales"].astype(np.float32)),
        torch.from_numpy(colour[:, 3].copy()),
        torch.cat([constant, torch.from_numpy(ordered)], dim=1),
    )


def _buckets(path: Path, data: bytes, section: Section) -> np.ndarray:
    """The bucket of each Gaussian: first those that are full, then the others with their own sizes."""
    others = np.frombuffer(data, "<u4", section.partial_buckets, section.partial_sizes).astype(np.int64)
    ends = np.cumsum(np.concatenate([np.full(section.full_buckets, section.bucket_size, np.int64), others]))
    if section.count and (len(ends) == 0 or ends[-1] < section.count):
        raise SceneError(f"{path} is damaged: its buckets have no room for the {section.count:,} Gaussians of a section")
    return np.searchsorted(ends, np.arange(section.count), side="right")
