"""The frozen scene that the weather acts on: its Gaussians, the cameras that saw it, and its metric frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.capture import Placement, moved_poses
from pgsd_nerfstudio.scene.captures.photographs import Photograph
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.frame import Frame, estimate_frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.storage import content_key

Known = tuple[float | None, tuple[float, float, float] | None]
"""Metres per scene unit, and up in scene axes, where they were given."""


def nowhere() -> Float64[Tensor, "3"]:
    """The offset of a scene that was not moved."""
    return torch.zeros(3, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Scene:
    """A frozen scene as `load_scene` returns it; all tensors are on the CPU, in scene units, float32 but for the offset."""

    name: str
    """Short name for files and headings."""
    gaussians: Gaussians
    """Colours as spherical harmonics."""
    cameras: Cameras
    """The training views."""
    frame: Frame
    """The metric frame: scene units to metres, z up."""
    photographs: tuple[Photograph, ...] = ()
    """The training photographs, one for each camera and in the same order; some may be missing on disk. Empty if unknown."""
    description: str = "a scene"
    """Name of the scene in prompts, such as "a garden"."""
    mesh: tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]] | None = None
    """Exact vertices (scene units) and triangles of a scene that was built from them; None for captures."""
    offset: Float64[Tensor, "3"] = field(default_factory=nowhere)
    """What was taken from the coordinates of a georeferenced splat and of its cameras, so that float32 rounds nothing that can
    be seen: coordinates of the file are coordinates here plus offset."""
    placements: tuple[Placement, ...] = ()
    """Where else the cameras may be, in scene units, if their renders do not look like their photographs."""
    known: Known = (None, None)
    """What of the metric frame was given and not estimated."""
    trusted: bool = False
    """Whether renders are known to look like the photographs, or were not to be compared."""
    remarks: tuple[str, ...] = ()
    """What was found or decided while the scene was opened, in sentences."""

    @property
    def images(self) -> tuple[Path, ...]:
        """Paths of the training photographs, as they are named or were found."""
        return tuple(photograph.path for photograph in self.photographs)

    def photographed(self) -> list[int]:
        """Numbers of the views whose photograph is on disk."""
        return [index for index, photograph in enumerate(self.photographs) if photograph.there]

    def placed(self, placement: Placement) -> Scene:
        """The scene with its cameras elsewhere, and with the metric frame that follows from that.

        Args:
            placement: one of `placements`.

        Raises:
            ValueError: no metric frame follows from cameras at that place.
        """
        poses = moved_poses(self.cameras.opengl(), placement.move).float()
        cameras = Cameras.from_opengl(poses, self.cameras.Ks, self.cameras.width, self.cameras.height)
        frame = estimate_frame(cameras, self.gaussians, *self.known)
        return replace(self, cameras=cameras, frame=frame, placements=())

    def content_key(self) -> str:
        """Hash of all that the weather depends on: Gaussians, cameras and metric frame, without names and descriptions."""
        frame = self.frame
        return content_key(self.gaussians, self.cameras, frame.metres_per_unit, frame.rotation, frame.origin)


__all__ = ["Scene", "SceneError"]
