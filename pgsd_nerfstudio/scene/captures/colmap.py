"""Cameras of a COLMAP reconstruction: cameras and images as .bin or .txt, of COLMAP 3 and 4.

COLMAP 4 adds rigs and frames, and still writes every image's own pose to `images`, so these two tables suffice. They are read
here and not through pycolmap, which also reads all points and tracks, and which a damaged file can keep busy without end.
Formats: https://colmap.github.io/format.html; quaternions are wxyz and lead from the world to the camera.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.captures.capture import Capture, checked_poses
from pgsd_nerfstudio.scene.captures.lenses import MODELS, READ, Lens, lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, find_photographs
from pgsd_nerfstudio.scene.captures.placements import colmap_placements
from pgsd_nerfstudio.scene.errors import SceneError

MODEL_NUMBERS = tuple(MODELS)
PLACES = ("sparse/0", "colmap/sparse/0", "sparse", "colmap/sparse", "colmap", ".")
"""Where in a folder its reconstruction may lie, the likeliest first."""
LONGEST_NAME = 4096

Row = tuple[str, int, tuple[float, ...]]
"""An image: its name, the number of its camera, and its pose as a quaternion and a translation."""


def reconstruction_in(folder: Path) -> Path | None:
    """The folder of cameras.bin or cameras.txt in a folder that people hand over; None if there is none."""
    for place in (folder / name for name in PLACES):
        for suffix in (".bin", ".txt"):
            if (place / f"cameras{suffix}").is_file() and (place / f"images{suffix}").is_file():
                return place
    return None


def read_colmap(folder: Path) -> Capture:
    """Cameras of a COLMAP reconstruction, in its own world, sorted by the names of their images.

    Args:
        folder: holds cameras and images as .bin or, where these are not there, as .txt; or holds such a folder (sparse/0).

    Raises:
        SceneError: there is no reconstruction, it is damaged or empty, or a camera's model is not read.
    """
    place = reconstruction_in(folder)
    if place is None:
        raise SceneError(f"no COLMAP reconstruction in {folder}: expected cameras.bin and images.bin in sparse/0, or .txt")
    binary = (place / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    cameras, images = place / f"cameras{suffix}", place / f"images{suffix}"
    try:
        lenses = dict(_binary_cameras(cameras) if binary else _text_cameras(cameras))
        rows = sorted(_binary_images(images) if binary else _text_images(images))
    except SceneError:
        raise
    except (OSError, ValueError, IndexError, struct.error) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{place} holds no cameras that can be read ({reason}): export the model from COLMAP again") from error
    if not rows:
        raise SceneError(f"{images} has no images: the reconstruction is empty")
    stray = next((name for name, number, _ in rows if number not in lenses), None)
    if stray is not None:
        raise SceneError(f"{images}: the camera of {stray} is not in {cameras.name}; export both from COLMAP again")
    names = [name for name, _, _ in rows]
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    numbers = torch.tensor([pose for _, _, pose in rows], dtype=torch.float64)
    lengths = numbers[:, :4].norm(dim=1, keepdim=True)
    # One of length 0 becomes NaN, which is refused with its image's name.
    quaternions = rotations.quat_wxyz_to_xyzw(numbers[:, :4] / lengths)
    rotation = rotations.unitquat_to_rotmat(quaternions).transpose(1, 2)  # camera to world
    matrices[:, :3, :3] = rotation @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    matrices[:, :3, 3] = -(rotation @ numbers[:, 4:, None])[:, :, 0]
    poses = checked_poses(matrices, names, images)
    root = _root(folder, place)
    paths = find_photographs(names, [root / "images", root / "input", root])
    photographs = tuple(Photograph(path, lenses[number]) for path, (_, number, _) in zip(paths, rows, strict=True))
    return Capture(poses, photographs, colmap_placements(poses))


def _root(folder: Path, place: Path) -> Path:
    """The folder that holds the photographs, also if the reconstruction itself was handed over."""
    if place != folder:
        return folder
    above = [folder.resolve(), *folder.resolve().parents[:3]]
    return next((parent for parent in above if (parent / "images").is_dir() or (parent / "input").is_dir()), folder)


def _lens(file: Path, number: int, model: str, width: float, height: float, values: list[float]) -> tuple[int, Lens]:
    names = MODELS[model][1].split() if model in READ else []
    if names and len(values) != len(names):
        raise SceneError(f"{file}: camera {number} has {len(values)} parameters; {model} has {len(names)}")
    return number, lens_of(model, width, height, dict(zip(names, values, strict=False)), f"{file}: the lens of camera {number}")


def _binary_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    stream = _Stream(file)
    for _ in range(stream.count(24)):
        number, model, width, height = stream.read("<IiQQ")
        if not 0 <= model < len(MODEL_NUMBERS):
            raise SceneError(f"{file}: camera {number} is of model {model}, which COLMAP 4.2 does not know")
        name = MODEL_NUMBERS[model]
        values = stream.read(f"<{len(MODELS[name][1].split())}d")
        yield _lens(file, number, name, width, height, list(values))


def _binary_images(file: Path) -> Iterator[Row]:
    stream = _Stream(file)
    for _ in range(stream.count(64)):
        _, *pose, number = stream.read("<I7dI")
        name = stream.text()
        stream.skip(24 * stream.count(24))  # x, y and the point of each feature
        yield name, number, tuple(pose)


def _text_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    for line in _lines(file):
        if line and not line.startswith("#"):
            number, model, width, height, *values = line.split()
            yield _lens(file, int(number), model, float(width), float(height), [float(value) for value in values])


def _text_images(file: Path) -> Iterator[Row]:
    lines = _lines(file)
    for line in lines:
        if line and not line.startswith("#"):
            _, *pose, number, name = line.split(maxsplit=9)
            yield name, int(number), tuple(float(value) for value in pose)
            next(lines, None)  # the features, on a line that may be empty


def _lines(file: Path) -> Iterator[str]:
    with file.open(encoding="utf-8", errors="replace") as lines:
        yield from (line.strip() for line in lines)


class _Stream:
    """A binary file from which nothing is taken that is not there."""

    def __init__(self, file: Path) -> None:
        with file.open("rb") as opened:  # mapped, since features make it large
            self._bytes, self._at = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ), 0

    def read(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from(form, self._bytes, self._at)
        self._at += struct.calcsize(form)
        return values

    def count(self, least: int) -> int:
        """A number of records that have at least so many bytes each."""
        (number,) = self.read("<Q")
        if number * least > len(self._bytes) - self._at:
            raise ValueError(f"{number:,} records are announced, but only {len(self._bytes) - self._at:,} bytes follow")
        return int(number)

    def skip(self, length: int) -> None:
        self._at += length

    def text(self) -> str:
        """A name that ends with a zero byte."""
        name = self._bytes[self._at : self._at + LONGEST_NAME].partition(b"\0")
        if not name[1]:
            raise ValueError("the name of an image does not end")
        self._at += len(name[0]) + 1
        return name[0].decode("utf-8", errors="replace")
