"""The views of a splat, in its coordinates as far as files tell: those of its run, or from where people say they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene.captures.capture import Capture, Placement
from pgsd_nerfstudio.scene.captures.placements import run_placement, undone_placements
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.source import Source
from pgsd_nerfstudio.scene.splats.reading import SPLAT_SUFFIXES

RunCameras = Callable[[Path], Capture]
"""Function from the config.yml of a run to its training views, in the coordinates of the splat."""
TRANSFORMS = "dataparser_transforms.json"
FAR = 1000.0  # times the cameras' spread from the origin: beyond, float32 rounds what can be seen


def views_of(
    source: Source, data: Path | None, run_cameras: RunCameras | None, offset: Float64[Tensor, "3"]
) -> tuple[Capture, list[str]]:
    """The views of a splat, and remarks on them.

    Args:
        source: what was handed over as the scene.
        data: what was handed over as its cameras; None: they came with the scene.
        run_cameras: function that reads the cameras of a run; None: the installed one.
        offset: what was taken from the coordinates of the splat.

    Raises:
        SceneError: there are no cameras, or they cannot be used.
    """
    if source.run is not None:
        if data is None:
            return _run_capture(source.run, run_cameras), []
        capture = read_capture(data)
        placement = run_placement(source.run / TRANSFORMS, capture.applied, capture.applied_scale)
        return capture.moved(placement.move), []
    if data is None and source.cameras is None:
        raise SceneError(
            f"{source.splat} holds no cameras: pass data= with the transforms.json, COLMAP folder or cameras.json that it was "
            f"trained on{_beside(source.splat)}, or camera='orbit' to have some made around its middle, and up= to say which "
            "way is up"
        )
    capture = _data_capture(data or source.cameras or Path(), run_cameras)
    folders = {source.splat.parent, *([] if data is None else [data if data.is_dir() else data.parent])}
    said = [folder / TRANSFORMS for folder in folders if (folder / TRANSFORMS).is_file()]
    moves = [run_placement(file, capture.applied, capture.applied_scale) for file in said]
    capture = replace(capture, placements=(*moves, *capture.placements))
    return _near(capture, offset)


def _beside(splat: Path) -> str:
    """A hint for the splat of Inria's trainer, whose cameras.json lies two folders above."""
    above = splat.resolve().parent.parent.parent
    return f", or pass the folder {above}, which has them" if (above / "cameras.json").is_file() else ""


def _data_capture(data: Path, run_cameras: RunCameras | None) -> Capture:
    """The views of a capture or of a run."""
    if data.suffix.lower() in SPLAT_SUFFIXES and data.is_file():
        raise SceneError(f"data= must lead to cameras, got the splat {data}")
    config = data / "config.yml" if data.is_dir() else data
    if config.name == "config.yml" and config.is_file() and not (data / "transforms.json").is_file():
        run = config.resolve().parent
        capture = _run_capture(run, run_cameras)
        return replace(capture, placements=undone_placements(run / TRANSFORMS))
    return read_capture(data)


def _run_capture(run: Path, run_cameras: RunCameras | None) -> Capture:
    config = run / "config.yml"
    if not config.is_file():
        raise SceneError(f"cameras are missing: there is no {config}; pass data= with the transforms.json it was trained on")
    run_cameras = run_cameras or _installed_reader()
    if run_cameras is None:
        raise SceneError(f"only nerfstudio reads the cameras of {run}; pass data= with the transforms.json it was trained on")
    capture = run_cameras(config)
    if len(capture) == 0:
        raise SceneError(f"{config} leads to data without cameras; pass data= with the transforms.json it was trained on")
    return capture


def _installed_reader() -> RunCameras | None:
    """What reads the cameras of a run; an entry point, so that this room does not know nerfstudio."""
    return next((point.load() for point in entry_points(group="pgsd_nerfstudio.run_cameras")), None)


def _near(capture: Capture, offset: Float64[Tensor, "3"]) -> tuple[Capture, list[str]]:
    """The capture where float32 rounds nothing that can be seen: moved as the splat was, or to the origin if only it is far."""
    centers = capture.poses[:, :3, 3]
    middle = centers.median(dim=0).values
    spread = float((centers - middle).norm(dim=1).median())
    remarks = []
    if offset.any():
        here = _shifted(torch.eye(4, dtype=torch.float64), offset)
        unmoved = Placement("left where they are, while the splat lies far from the origin", here)
        capture = replace(capture, placements=(unmoved, *capture.placements))
        remarks.append(f"the splat lies around {_place(offset)}: it and its cameras are moved to the origin")
        taken = offset
    elif float(middle.norm()) > FAR * max(spread, 1.0):
        taken = middle.round()
        remarks.append(f"the cameras lie around {_place(taken)}, far from the splat: they are moved to the origin")
    else:
        return capture, remarks
    moved = capture.moved(_shifted(torch.eye(4, dtype=torch.float64), -taken))
    placements = tuple(Placement(p.name, _shifted(p.move, -offset)) for p in moved.placements)
    return replace(moved, placements=placements), remarks


def _shifted(move: Float64[Tensor, "4 4"], by: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    move = move.clone()
    move[:3, 3] += by
    return move


def _place(point: Float64[Tensor, "3"]) -> str:
    return ", ".join(f"{value:,.0f}" for value in point.tolist())
