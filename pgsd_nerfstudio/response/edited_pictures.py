"""Read a folder of edited pictures: the view that each picture shows, and its pixels."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from rich.console import Console
from torch import Tensor

from pgsd_nerfstudio.scene.scene import Scene

Picture = tuple[int, UInt8[Tensor, "h w 3"]]
"""Index of a view, and its edited picture."""

console = Console(stderr=True, highlight=False)


def read_edited(folder: Path, scene: Scene) -> list[Picture]:
    """Read the edited pictures in a folder.

    A picture has the name of its photograph with any suffix (frame_00012.png for images/frame_00012.jpg). If the scene has no
    photographs, the only number in the name is the index of the view. Pictures of another size are stretched to that of the
    cameras. Pictures that belong to no view are left out, and a note tells so.

    Args:
        folder: holds the pictures.
        scene: its cameras are the views, its photographs give the names.

    Returns:
        Indices of views in ascending order and their pictures.

    Raises:
        ValueError: the folder is missing, no picture in it belongs to a view, a picture cannot be read, or two show one view.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ValueError(
            f"edited pictures must be in a folder, but {folder} {'is a file' if folder.exists() else 'does not exist'}"
        )
    kinds = Image.registered_extensions()
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in kinds and not p.name.startswith(".") and p.is_file())
    found: dict[int, Path] = {}
    strangers = []
    for file in files:
        index = _view_of(file.stem, scene)
        if index is None:
            strangers.append(file.name)
        elif index in found:
            raise ValueError(f"{found[index].name} and {file.name} in {folder} both show view {index}; keep one of them")
        else:
            found[index] = file
    if not found:
        expected = [f"{path.stem}.png" for path in scene.images] or [f"view_{i:04d}.png" for i in range(len(scene.cameras))]
        there = f"found {len(files)} pictures, such as {files[0].name}" if files else "found no pictures at all"
        raise ValueError(
            f"no picture in {folder} belongs to one of the {len(scene.cameras)} views: expected names such as "
            f"{' and '.join(expected[:2])}, {there}"
        )
    if strangers:
        note = f"{len(strangers)} of the {len(files)} pictures in {folder} belong to no view, such as {strangers[0]}"
        console.print(f"[yellow]{note}[/]", soft_wrap=True)
    size = (scene.cameras.width, scene.cameras.height)
    return [(index, _read_picture(found[index], size)) for index in sorted(found)]


def _view_of(stem: str, scene: Scene) -> int | None:
    """The view that the name of a picture tells; None if it tells no view or several."""
    if scene.images:
        same = [index for index, path in enumerate(scene.images) if path.stem == stem]
    else:
        numbers = [int(digits) for digits in re.findall(r"\d+", stem)]
        same = numbers if len(numbers) == 1 and numbers[0] < len(scene.cameras) else []
    return same[0] if len(same) == 1 else None


def _read_picture(path: Path, size: tuple[int, int]) -> UInt8[Tensor, "h w 3"]:
    try:
        with Image.open(path) as stored:
            picture = stored.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"the edited picture {path} cannot be read ({error}): write it again as .png or .jpg") from error
    resized = picture if picture.size == size else picture.resize(size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(resized))
