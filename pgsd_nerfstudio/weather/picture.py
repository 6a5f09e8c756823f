"""One rendered picture with its depth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.moment import Moment
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene
from pgsd_nerfstudio.weather.video import write_picture


class Picture(NamedTuple):
    """What one camera sees."""

    rgb: Float[Tensor, "h w 3"]
    """Display colours (sRGB) over black, 0..1 up to rounding, not clipped."""
    depth: Float[Tensor, "h w"]
    """Expected depth along the camera's z axis in scene units; 0 where nothing is.
    Times `scene.frame.metres_per_unit` it is in metres."""
    accumulation: Float[Tensor, "h w"]
    """Share of the light that comes from Gaussians, 0..1."""

    def save(self, path: str | Path) -> Path:
        """Write the colours as PNG, clipped to 8 bits; returns the path.

        Raises:
            ValueError: the path does not end in .png.
            OSError: it could not be written; nothing is left behind.
        """
        path = Path(path).expanduser()
        if path.suffix.lower() != ".png":
            raise ValueError(f"a picture is written as .png, got {path}")
        write_picture(path, self.rgb)
        return path

    def __repr__(self) -> str:
        height, width, _ = self.rgb.shape
        return f"Picture({width}x{height})"


def picture_of(prepared: PreparedScene, camera: Cameras, weather: Gaussians | None, moment: Moment | None) -> Picture:
    """Render one picture, without gradient.

    Args:
        prepared: the frozen scene.
        camera: one camera in scene units.
        weather: the particles in scene units, or None for none.
        moment: the answer of the frozen scene; None: as it was trained.

    Raises:
        ValueError: there is not exactly one camera.
    """
    if len(camera) != 1:
        raise ValueError(f"a picture is seen by one camera, got {len(camera)}; Weather.frames takes a path")
    with torch.no_grad():
        clip = prepared.rasterizer.render(camera.to(prepared.device), weather, None, moment)
    return Picture(clip.rgb[0], clip.depth[0], clip.accumulation[0])
