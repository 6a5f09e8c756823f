"""The frozen scene, opened once per process and ready to be rendered; pipeline, data manager and datasets share it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch

from pgsd_nerfstudio.plugin.options import WeatherOptions
from pgsd_nerfstudio.plugin.run_cameras import open_scene
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rasterizer
from pgsd_nerfstudio.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene on one device."""

    scene: Scene
    rasterizer: Rasterizer
    """Exact; what people look at and what is measured."""
    clip_rasterizer: Rasterizer
    """What training clips are rendered with: the same, or with the frozen scene in layers."""
    device: torch.device


def prepare_scene(options: WeatherOptions, device: torch.device | str) -> PreparedScene:
    """The prepared scene of a run.

    Raises:
        SceneError: the scene cannot be used.
    """
    return _prepared(
        options.load_scene, options.data, options.metres_per_unit, options.scene_description, str(device), options.layers
    )


@lru_cache(maxsize=2)
def _prepared(
    path: Path, data: Path | None, metres_per_unit: float | None, description: str | None, device: str, layers: int | None
) -> PreparedScene:
    scene = open_scene(path, data, metres_per_unit, description)
    frozen = scene.gaussians.to(device)
    exact = choose_rasterizer(frozen, device)
    return PreparedScene(
        scene, exact, exact if layers is None else choose_rasterizer(frozen, device, layers), torch.device(device)
    )
