"""Read a folder of edited pictures: the view that each picture shows, and its pixels."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from jaxtyping import UInt8
from PIL import Image
from rich.console import Console
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.captures.lenses import pinhole
from pgsd_nerfstudio.scene.captures.photographs import Photograph, read_photograph
from pgsd_nerfstudio.scene.scene import Scene

Picture = tuple[int, UInt8[Tensor, "h w 3"]]
"""Index of a view, and its edited picture."""

console = Console(stderr=True, highlight=False)


def edited_folder(folder: Path) -> Path:
    """The folder of edited pictures, with the user's home in place of ~.

    Raises:
        ValueError: there is no such folder.
    """
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ValueError(
            f"edited pictures must be in a folder, but {folder} {'is a file' if folder.exists() else 'does not exist'}"
        )
    return folder


def read_edited(folder: Path, scene: Scene) -> list[Picture]:
    """Read the edited pictures in a folder.

    A picture has the name of its photograph with any suffix (frame_00012.png for images/frame_00012.jpg). If the scene has no
    photographs, the only number in the name is the index of the view. Pictures are read as photographs are
    (`captures.photographs.read_photograph`): in the size of the cameras, undistorted, and never stretched; where they show
    nothing, the scene stays as it is. Pictures that belong to no view are left out, and a note tells so.

    Args:
        folder: holds the pictures.
        scene: its cameras are the views, its photographs give the names.

    Returns:
        Indices of views in ascending order and their pictures.

    Raises:
        ValueError: the folder is missing, no picture in it belongs to a view, a picture cannot be read, or two show one view.
    """
    folder = edited_folder(folder)
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
    return [(index, _read_picture(found[index], scene, index)) for index in sorted(found)]


def _view_of(stem: str, scene: Scene) -> int | None:
    """The view that the name of a picture tells; None if it tells no view or several."""
    if scene.images:
        same = [index for index, path in enumerate(scene.images) if path.stem == stem]
    else:
        numbers = [int(digits) for digits in re.findall(r"\d+", stem)]
        same = numbers if len(numbers) == 1 and numbers[0] < len(scene.cameras) else []
    return same[0] if len(same) == 1 else None


def _read_picture(path: Path, scene: Scene, index: int) -> UInt8[Tensor, "h w 3"]:
    camera = scene.cameras[index]
    lens = scene.photographs[index].lens if scene.photographs else pinhole(camera)
    seen = read_photograph(Photograph(path, lens), camera)
    rgb = seen.rgb
    if not seen.known.all():
        with torch.no_grad():
            as_it_is = choose_rasterizer(scene.gaussians, "cpu").render(camera).rgb[0].clamp(0, 1)
        rgb = torch.where(seen.known[..., None], rgb, as_it_is)
    return (rgb * 255 + 0.5).byte()
