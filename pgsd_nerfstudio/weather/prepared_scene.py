"""A frozen scene on one device, ready to be rendered."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rasterizer
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.weather.agreement import agreed


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene, and what renders it on a device."""

    scene: Scene
    rasterizer: Rasterizer
    """Exact; what people look at and what is measured."""
    clip_rasterizer: Rasterizer
    """What training clips are rendered with: the same, or with the frozen scene in layers."""
    device: torch.device


def prepare_scene(scene: Scene, device: torch.device | str | None = None, layers: int | None = None) -> PreparedScene:
    """Put a scene on a device, and see that renders of it look like its photographs (`agreement.agreed`).

    Args:
        scene: as `load_scene` returns it.
        device: cpu or cuda; by default cuda where there is one.
        layers: press the frozen scene behind every 16x16 pixels of a training clip into so many layers (CPU only); None: exact.

    Raises:
        ValueError: the device is neither cpu nor cuda or is not there, or layers are asked of another than the CPU's.
        SceneError: the cameras do not fit the splat.
    """
    try:
        device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    except RuntimeError as error:
        raise ValueError(f"a scene is prepared on cpu or cuda, got {device!r}") from error
    if device.type not in ("cpu", "cuda") or (device.type == "cuda" and not torch.cuda.is_available()):
        found = "CUDA is there" if torch.cuda.is_available() else "there is no CUDA device here"
        raise ValueError(f"a scene is prepared on cpu or cuda, got {device}; {found}")
    frozen = scene.gaussians.to(device)
    exact = choose_rasterizer(frozen, device)
    scene = agreed(scene, exact, device)
    return PreparedScene(scene, exact, exact if layers is None else choose_rasterizer(frozen, device, layers), device)
