"""Read a trained splat from any of the files that hold one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.splats.checkpoint import read_checkpoint
from pgsd_nerfstudio.scene.splats.ply import read_ply

SPLAT_SUFFIXES = (".ply", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".gltf")
"""Suffixes, in small letters, of files that hold a splat and nothing of the run that trained it."""


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
    nowhere = torch.zeros(3, dtype=torch.float64)
    if path.suffix.lower() == ".ckpt":
        return Splat(read_checkpoint(path), nowhere)
    if path.suffix.lower() == ".ply":
        return Splat(read_ply(path), nowhere)
    raise SceneError(f"{path} is no splat: expected a file ending in {', '.join(SPLAT_SUFFIXES)}")
