"""The choice of a rasterizer by device."""

from __future__ import annotations

import torch

from pgsd_nerfstudio.rendering.rasterizer import Rasterizer
from pgsd_nerfstudio.scene.gaussians import Gaussians


def choose_rasterizer(frozen: Gaussians, device: torch.device | str, layers: int | None = None) -> Rasterizer:
    """The rasterizer for a device: numba on the CPU, gsplat with CUDA.

    Args:
        frozen: the frozen scene; it is moved to the device.
        device: cpu or cuda.
        layers: number of layers of `CpuRasterizer`; None blends the frozen scene exactly.

    Raises:
        ValueError: there is no rasterizer for the device, or `layers` is given for another device than the CPU.
    """
    kind = torch.device(device).type
    if layers is not None and kind != "cpu":
        raise ValueError(f"layers are an option of the rasterizer for the CPU, found layers={layers} on {device}")
    if kind == "cuda":
        from pgsd_nerfstudio.rendering.cuda import GsplatRasterizer

        return GsplatRasterizer(frozen.to(device))
    if kind == "cpu":
        from pgsd_nerfstudio.rendering.cpu import CpuRasterizer

        return CpuRasterizer(frozen.to("cpu"), layers=layers)
    raise ValueError(f"there are rasterizers for the devices cpu and cuda, found {device}")
