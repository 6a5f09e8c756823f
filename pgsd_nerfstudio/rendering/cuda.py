"""The rasterizer for CUDA: gsplat, with the frozen scene left out of the gradients."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.rasterizer import Dynamic, RasterConfig, Rendering, dynamic_per_frame
from pgsd_nerfstudio.rendering.spherical_harmonics import view_colors
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate


class GsplatRasterizer:
    """Renders a frozen scene, and dynamic Gaussians among it, with gsplat."""

    def __init__(self, frozen: Gaussians, *, config: RasterConfig | None = None) -> None:
        if frozen.device.type != "cuda":
            raise ValueError(f"GsplatRasterizer expects Gaussians on CUDA, found them on {frozen.device}; call .to('cuda')")
        # What gsplat compiles in cannot be asked of it.
        self.config = config or RasterConfig()
        changeable = {"blur": self.config.blur, "near": self.config.near, "far": self.config.far}
        if self.config != RasterConfig(**changeable):
            raise ValueError(f"gsplat lets only blur, near and far be chosen, found {self.config}")
        frozen.check_finite()
        self.frozen = frozen.detach().to(torch.float32)

    def render(self, cameras: Cameras, dynamic: Dynamic = None, background: Float[Tensor, "3"] | None = None) -> Rendering:
        """As `Rasterizer.render`."""
        from gsplat import rasterization  # compiles its kernels on first use

        device = self.frozen.device
        rgb, depth, accumulation = [], [], []
        for k, moving in enumerate(dynamic_per_frame(dynamic, len(cameras))):
            viewmat, K = cameras.viewmats[k].to(device, torch.float32), cameras.Ks[k].to(device, torch.float32)
            # Harmonics are evaluated here, so that the two sets share one kind of colour and the dynamic one keeps its exactly.
            scene = replace(self.frozen, colors=view_colors(self.frozen.colors, self.frozen.means, viewmat))
            if moving is not None:
                scene = concatenate([scene, moving.to(device, torch.float32)])
            image, alpha, _ = rasterization(
                scene.means,
                scene.quats,
                scene.scales,
                scene.opacities,
                scene.colors,
                viewmat[None],
                K[None],
                cameras.width,
                cameras.height,
                near_plane=self.config.near,
                far_plane=self.config.far,
                eps2d=self.config.blur,
                backgrounds=None if background is None else background.to(device, torch.float32)[None],
                render_mode="RGB+ED",
                rasterize_mode="classic",
            )
            rgb.append(image[0, ..., :3])
            depth.append(image[0, ..., 3])
            accumulation.append(alpha[0, ..., 0])
        return Rendering(torch.stack(rgb), torch.stack(depth), torch.stack(accumulation))
