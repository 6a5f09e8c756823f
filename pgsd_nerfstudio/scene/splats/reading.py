"""Read a trained splat from any of the files that hold one.

The first bytes of a file decide where its format has a mark of its own, else its suffix does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.activation import checked
from pgsd_nerfstudio.scene.splats.checkpoint import read_checkpoint
from pgsd_nerfstudio.scene.splats.compressed_ply import decompressed
from pgsd_nerfstudio.scene.splats.gltf import read_glb, read_gltf
from pgsd_nerfstudio.scene.splats.ksplat import read_ksplat
from pgsd_nerfstudio.scene.splats.ply import uncompressed
from pgsd_nerfstudio.scene.splats.ply_file import open_ply
from pgsd_nerfstudio.scene.splats.sog import META, read_sog
from pgsd_nerfstudio.scene.splats.splat import read_dot_splat
from pgsd_nerfstudio.scene.splats.spz import read_spz

SPLAT_SUFFIXES = (".ply", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".gltf")
"""Suffixes, in small letters, of files that hold a splat and nothing of the run that trained it."""

Reader = Callable[[Path], Gaussians]

TRAIN = "train a splat on its photographs (ns-train splatfacto)"
CONVERT = "npx @playcanvas/splat-transform IN OUT.ply converts it"
ORIGINAL = "use the .ply or .spz that it was made from"
UNREAD = {
    **dict.fromkeys((".las", ".laz", ".e57", ".pcd", ".pts", ".xyz"), ("a point cloud", TRAIN)),
    **dict.fromkeys((".obj", ".stl", ".off", ".fbx", ".dae", ".3ds", ".blend"), ("a mesh", TRAIN)),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), ("an OpenUSD stage", ORIGINAL)),
    **dict.fromkeys((".lcc", ".lcc2"), ("a scene of XGRIDS", CONVERT)),
    ".rad": ("a scene of Spark in levels of detail", ORIGINAL),
    ".4dgs": ("a splat that moves", "export one moment of it as .ply"),
    ".pth": ("a checkpoint of another trainer", "use the point_cloud.ply that it saved"),
    ".pt": ("a checkpoint of another trainer", "use the .ply that it exports"),
    ".html": ("a viewer with a splat in it", ORIGINAL),
}
"""What files with these suffixes are, and what to do with them."""


@dataclass(frozen=True)
class Splat:
    """A trained splat as a file holds it."""

    gaussians: Gaussians
    """Float32 on the CPU, colours as spherical harmonics, centres without the offset."""
    offset: Float64[Tensor, "3"]
    """What was taken from the centres of the file, in float64 and before they became float32, because they lie far from the
    origin (georeferenced scenes); zero otherwise. File coordinates are centres plus offset."""


def read_splat(path: Path) -> Splat:
    """Read a splat of any format: a file with one of `SPLAT_SUFFIXES`, a splatfacto checkpoint (.ckpt), or meta.json of a SOG.

    Other formats are refused by name with what converts them, so that any file may be handed over.

    Raises:
        SceneError: the file is of no format that is read, is damaged or holds no Gaussians; the sentence says what to do.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what damaged values come to is looked at afterwards
        gaussians = _reader(path)(path)
    return Splat(*checked(path, gaussians))


def _reader(path: Path) -> Reader:
    suffix = path.suffix.lower()
    if path.is_dir() or path.name.lower() == META:
        return read_sog
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except (OSError, ValueError) as error:  # ValueError: there is a null in the path
        raise SceneError(f"{path} cannot be opened ({getattr(error, 'strerror', error)})") from error
    if suffix in UNREAD:
        kind, advice = UNREAD[suffix]
        raise SceneError(f"{path} is {kind}, which is not read: {advice}")
    if path.name.lower() == "lod-meta.json":
        raise SceneError(f"{path} is a SOG in levels of detail, which is not read: {CONVERT}")
    marks: dict[bytes, Reader] = {b"NGSP": read_spz, b"glTF": read_glb, b"\x1f\x8b": read_spz, b"ply": _read_ply}
    marked = next((reader for mark, reader in marks.items() if start.startswith(mark)), None)
    by_suffix: dict[str, Reader] = {
        **{".ply": _read_ply, ".spz": read_spz, ".sog": read_sog, ".splat": read_dot_splat, ".ksplat": read_ksplat},
        **{".glb": read_glb, ".gltf": read_gltf, ".ckpt": read_checkpoint},
    }
    reader = marked or by_suffix.get(suffix)
    if reader is None:
        raise SceneError(f"{path} is no splat: expected a file that ends in {', '.join(SPLAT_SUFFIXES)}")
    return reader


def _read_ply(path: Path) -> Gaussians:
    ply = open_ply(path)
    vertex = ply.element("vertex")
    return decompressed(ply) if vertex is not None and "packed_position" in vertex.columns else uncompressed(ply)
