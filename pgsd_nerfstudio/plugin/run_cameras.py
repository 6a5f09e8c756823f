"""Cameras and photographs of a nerfstudio run, read by the run's own dataparser: they lie in the coordinates of its splat."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.cameras.cameras import CameraType

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.scene import SceneError


def run_cameras(config_path: Path) -> tuple[Cameras, tuple[Path, ...]]:
    """Training views of a run, from its config.yml, as nerfstudio itself would place them.

    Raises:
        SceneError: the config cannot be read, its data has moved, or its cameras are not of the pinhole kind.
    """
    config = _read_config(config_path)
    manager = getattr(getattr(config, "pipeline", None), "datamanager", None)
    parser_config = getattr(manager, "dataparser", None)
    if manager is None or parser_config is None:
        raise SceneError(f"{config_path} is not the config.yml of a splatfacto run: it names no dataparser")
    # A saved dataparser says data "."; where the photographs lie is said one level up.
    saved = Path(manager.data or parser_config.data)
    parser_config.data = next((place for place in _places(saved, config_path) if place.exists()), None)
    if parser_config.data is None:
        raise SceneError(
            f"the photographs of {config_path} are no longer at {saved}: move them back, run the command where the training "
            "was run, or pass --data with their transforms.json"
        )
    try:
        outputs = parser_config.setup().get_dataparser_outputs(split="train")
    except (AssertionError, OSError, KeyError, ValueError) as error:
        raise SceneError(
            f"the dataparser of {config_path} could not read {parser_config.data} ({error}): pass --data with a transforms.json"
        ) from error
    return from_nerfstudio(outputs.cameras), tuple(Path(name) for name in outputs.image_filenames)


def from_nerfstudio(cameras: NerfstudioCameras) -> Cameras:
    """Cameras of one image size; where sizes differ, all take the most frequent one (cropped, never stretched).

    Raises:
        SceneError: a camera is not a perspective one.
    """
    if (cameras.camera_type != CameraType.PERSPECTIVE.value).any():
        raise SceneError("weather is rendered through perspective cameras only; choose the camera type perspective")
    flat = cameras.reshape((-1,))
    sizes = list(zip(flat.width[:, 0].tolist(), flat.height[:, 0].tolist(), strict=True))
    (width, height), _ = Counter(sizes).most_common(1)[0]
    Ks = flat.get_intrinsics_matrices().float()
    for index, size in enumerate(sizes):
        if size != (width, height):
            Ks[index] = Cameras(torch.eye(4, device=Ks.device)[None], Ks[index][None], *size).resized(width, height).Ks[0]
    return Cameras.from_opengl(flat.camera_to_worlds.float(), Ks, width, height)


def to_nerfstudio(cameras: Cameras, times: torch.Tensor | None = None) -> NerfstudioCameras:
    """The same views as nerfstudio's cameras.

    Args:
        cameras: t views.
        times: of each view [t] in 0..1 over the whole weather; None: the views have no time.
    """
    return NerfstudioCameras(
        camera_to_worlds=cameras.opengl()[:, :3],
        fx=cameras.Ks[:, 0, 0],
        fy=cameras.Ks[:, 1, 1],
        cx=cameras.Ks[:, 0, 2],
        cy=cameras.Ks[:, 1, 2],
        width=cameras.width,
        height=cameras.height,
        times=None if times is None else times.reshape(-1, 1).float(),
    )


def _read_config(config_path: Path) -> Any:
    try:
        return yaml.load(config_path.read_text("utf-8"), Loader=yaml.Loader)
    except (OSError, yaml.YAMLError, AttributeError, ImportError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{config_path} is not a config.yml of this nerfstudio ({reason}): pass --data instead") from error


def _places(saved: Path, config_path: Path) -> Iterator[Path]:
    """Where the data may lie: as saved, or relative to a folder above the run (nerfstudio saves paths as they were typed)."""
    yield saved
    if not saved.is_absolute():
        yield from (parent / saved for parent in config_path.resolve().parents)
