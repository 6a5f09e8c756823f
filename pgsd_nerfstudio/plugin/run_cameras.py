"""Cameras and photographs of a nerfstudio run, read by the run's own dataparser: they lie in the coordinates of its splat.

config.yml is read as data. Of what it says only the plain options of a dataparser are used, and only dataparsers of nerfstudio
are made that read cameras without running anything they find.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from pgsd_nerfstudio.plugin.places import found
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.capture import Capture, checked_poses
from pgsd_nerfstudio.scene.captures.lenses import lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, find_photographs
from pgsd_nerfstudio.scene.captures.transforms import DISTORTION
from pgsd_nerfstudio.scene.run_config import Record, entry, read_run_config
from pgsd_nerfstudio.scene.scene import SceneError

# Those of nerfstudio 1.1.5, without minimal_dataparser, which unpickles, and nuscenes_dataparser, which needs another package.
DATAPARSERS = {
    f"nerfstudio.data.dataparsers.{module}_dataparser.{name}DataParserConfig"
    for module, name in (
        *(("nerfstudio", "Nerfstudio"), ("colmap", "Colmap"), ("blender", "Blender"), ("instant_ngp", "InstantNGP")),
        *(("arkitscenes", "ARKitScenes"), ("dnerf", "DNeRF"), ("dycheck", "Dycheck"), ("nerfosr", "NeRFOSR")),
        *(("phototourism", "Phototourism"), ("scannet", "ScanNet"), ("scannetpp", "ScanNetpp"), ("sdfstudio", "SDFStudio")),
        ("sitcoms3d", "Sitcoms3D"),
    )
}
LENSES = {CameraType.PERSPECTIVE.value: "OPENCV", CameraType.FISHEYE.value: "OPENCV_FISHEYE"}
"""COLMAP's names for nerfstudio's kinds of cameras; of the others no pinhole can stand for the photographs."""
PLAIN = (bool, int, float, str, Path, type(None))


def run_cameras(config_path: Path) -> Capture:
    """Training views of a run, from its config.yml, as nerfstudio itself would place them.

    Nothing that the file names is imported or called but one of `DATAPARSERS`.

    Raises:
        SceneError: the config cannot be read, its data has moved, or no pinhole can stand for its cameras.
    """
    manager = entry(read_run_config(config_path), "pipeline", "datamanager")
    record = entry(manager, "dataparser")
    if not isinstance(record, Record):
        raise SceneError(f"{config_path} is not the config.yml of a splatfacto run: it names no dataparser")
    # A saved dataparser says data "."; where the photographs lie is said one level up.
    saved = entry(manager, "data") or entry(record, "data")
    saved = Path(saved) if isinstance(saved, str) else saved
    if not isinstance(saved, Path):
        raise SceneError(f"{config_path} does not say where its photographs lie: pass data= with their transforms.json")
    data = found(saved, config_path.resolve().parent)
    if data is None:
        raise SceneError(
            f"the photographs of {config_path} are no longer at {saved}, nor below a folder above the run: move them back, run "
            "the command where the training was run, or pass data= with their transforms.json"
        )
    config = _dataparser_config(config_path, record, data)
    try:
        outputs = config.setup().get_dataparser_outputs(split="train")
    except (Exception, SystemExit) as error:
        # Whatever a dataparser meets in files that are not as it wants them; one ends the process where it may not ask.
        raise SceneError(
            f"the dataparser of {config_path} could not read {data} ({error!r}): pass data= with a transforms.json"
        ) from error
    return _capture(config_path, outputs, data)


def _capture(config_path: Path, outputs: DataparserOutputs, data: Path) -> Capture:
    """What a dataparser found: poses, lenses, and where the photographs lie."""
    cameras, names = outputs.cameras.reshape((-1,)), [str(name) for name in outputs.image_filenames]
    kinds = [LENSES.get(int(kind), CameraType(int(kind)).name) for kind in cameras.camera_type.flatten()]
    sides = (cameras.width, cameras.height, cameras.fx, cameras.fy, cameras.cx, cameras.cy)
    numbers = torch.cat([side.double().reshape(-1, 1) for side in sides], dim=1).tolist()
    bent = cameras.distortion_params
    bends = [[]] * len(names) if bent is None else bent.double().reshape(len(names), -1).tolist()
    lenses = []
    for name, kind, (width, height, *focal), bend in zip(names, kinds, numbers, bends, strict=True):
        values: dict[str, float] = dict(zip(("fx", "fy", "cx", "cy", *DISTORTION), (*focal, *bend), strict=False))
        lenses.append(lens_of(kind, width, height, values, f"{config_path}: the lens of {name}"))
    masks = outputs.mask_filenames or [None] * len(names)
    places = find_photographs(names, [data, data / "images"])
    photographs = tuple(map(Photograph, places, lenses, masks))
    poses = torch.eye(4, dtype=torch.float64).repeat(len(names), 1, 1)
    poses[:, :3] = cameras.camera_to_worlds.double()
    return Capture(checked_poses(poses, names, config_path), photographs)


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


def _dataparser_config(config_path: Path, record: Record, data: Path) -> Any:
    """The configuration that a record stands for, with the class's own target whatever the file says."""
    if record.python not in DATAPARSERS:
        raise SceneError(
            f"{config_path} asks for the dataparser {record.python}, which is not run for a file that may come from anybody: "
            "pass data= with the transforms.json that it was trained on"
        )
    module, _, name = record.python.rpartition(".")
    kind = getattr(import_module(module), name)
    known = {field.name for field in fields(kind)} - {"_target", "data"}
    options = {name: value for name, value in record.items() if name in known}
    odd = [name for name, value in options.items() if not _plain(value)]
    if odd:
        raise SceneError(f"{config_path}: {', '.join(odd)} of its dataparser must be plain values: pass data= instead")
    if name == "ColmapDataParserConfig":
        # Where photographs of the wanted size are missing it asks, and makes them with a shell that is given their names.
        factor, images = options.get("downscale_factor"), options.get("images_path", "images")
        if not (isinstance(factor, int) and (data / f"{images}_{factor}").is_dir()):
            options["downscale_factor"] = 1
    return kind(**options, data=data)


def _plain(value: Any) -> bool:
    return all(map(_plain, value)) if isinstance(value, list | tuple) else isinstance(value, PLAIN)
