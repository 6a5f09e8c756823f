"""Which reader reads what people hand over as the cameras of a splat."""

from __future__ import annotations

from pathlib import Path

from pgsd_nerfstudio.scene.captures.capture import Capture
from pgsd_nerfstudio.scene.captures.colmap import read_colmap, reconstruction_in
from pgsd_nerfstudio.scene.captures.inria import is_camera_list, read_camera_list
from pgsd_nerfstudio.scene.captures.transforms import read_json, read_transforms
from pgsd_nerfstudio.scene.errors import SceneError

FILES = ("transforms.json", "transforms_train.json", "cameras.json")
"""Files of cameras in a folder, the likeliest first; COLMAP's tables come after the first two."""


def read_capture(data: Path) -> Capture:
    """Cameras and photographs of a capture, sorted by file name.

    A camera stays in the list if its photograph is missing on disk.

    Args:
        data: a transforms.json, a cameras.json of Inria's trainer, or a folder with one of them or with COLMAP's tables.

    Raises:
        SceneError: there are no cameras, or they cannot be used; the sentence says why.
    """
    file = camera_file(data)
    if file is None:
        raise SceneError(
            f"no cameras at {data}: expected a transforms.json as ns-process-data writes it, COLMAP's sparse/0, or the "
            "cameras.json of Inria's trainer"
        )
    if file.is_dir():
        return read_colmap(data if data.is_dir() else data.parent)
    content = read_json(file)
    return read_camera_list(file, content) if is_camera_list(content) else read_transforms(file, content)


def camera_file(data: Path) -> Path | None:
    """The file of cameras in a folder or the file itself, or the folder of a COLMAP reconstruction; None if there is none."""
    if data.is_file():
        return reconstruction_in(data.parent) if data.suffix.lower() in (".bin", ".txt") else data
    places = [data / name for name in FILES]
    found = [place for place in places if place.is_file()]
    if found and found[0] != places[-1]:
        return found[0]
    return reconstruction_in(data) or (found[0] if found else None)
