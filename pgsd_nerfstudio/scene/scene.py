"""The frozen scene that weather is given to: Gaussians, the cameras that saw it, and where it stands in the world."""

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
    """A scene that cannot be used, in one sentence: what was expected, what was found and what to do."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What `load_scene` returns; everything float32 on the CPU, in scene units."""

    name: str
    """Short name for files and headings."""
    gaussians: Gaussians
    """Colours as spherical harmonics."""
    cameras: Cameras
    """The training views."""
    frame: Frame
    """Scene units to metres, z up."""
    images: tuple[Path, ...] = ()
    """The training photographs, one a camera and in their order; empty where they are unknown."""
    description: str = "a scene"
    """What prompts call it, such as "a garden"."""
    mesh: tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]] | None = None
    """Exact vertices (scene units) and triangles, where the scene was built from them; captures have none."""

    def content_key(self) -> str:
        """Hash of what weather depends on: Gaussians, cameras and the metric frame; not of names and words."""
        frame = self.frame
        return content_key(self.gaussians, self.cameras, frame.metres_per_unit, frame.rotation, frame.origin)
