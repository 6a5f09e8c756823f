"""The frozen scene that the weather acts on: its Gaussians, the cameras that saw it, and its metric frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.storage import content_key


class SceneError(ValueError):
    """The scene cannot be used; the message is one sentence: what was expected, what was found and what to do."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A frozen scene as `load_scene` returns it; all tensors are float32 on the CPU, in scene units."""

    name: str
    """Short name for files and headings."""
    gaussians: Gaussians
    """Colours as spherical harmonics."""
    cameras: Cameras
    """The training views."""
    frame: Frame
    """The metric frame: scene units to metres, z up."""
    images: tuple[Path, ...] = ()
    """The training photographs, one for each camera and in the same order; empty if they are unknown."""
    description: str = "a scene"
    """Name of the scene in prompts, such as "a garden"."""
    mesh: tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]] | None = None
    """Exact vertices (scene units) and triangles of a scene that was built from them; None for captures."""

    def content_key(self) -> str:
        """Hash of all that the weather depends on: Gaussians, cameras and metric frame, without names and descriptions."""
        frame = self.frame
        return content_key(self.gaussians, self.cameras, frame.metres_per_unit, frame.rotation, frame.origin)
