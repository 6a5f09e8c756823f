"""The rasterizer for machines without a GPU: numba on all cores, forward and backward."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.blending import blend_merged
from pgsd_nerfstudio.rendering.blending_gradient import blend_backward
from pgsd_nerfstudio.rendering.compilation import rendering_lock
from pgsd_nerfstudio.rendering.frozen import FrozenView, FrozenViews, View, float_array, splat
from pgsd_nerfstudio.rendering.projection import GRADIENT_COLUMNS, project_backward
from pgsd_nerfstudio.rendering.rasterizer import Dynamic, RasterConfig, Rendering, composite, dynamic_per_frame
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians


class CpuRasterizer:
    """Renders a frozen scene, and dynamic Gaussians among it, on the CPU.

    The first picture from a camera prepares the frozen scene for it; that is kept, within `cache_bytes`, so later pictures from
    the same camera cost little more than what moves. May be called from several Python threads.
    """

    def __init__(self, frozen: Gaussians, *, config: RasterConfig | None = None, cache_bytes: int = 1 << 30) -> None:
        if frozen.device.type != "cpu":
            raise ValueError(f"CpuRasterizer expects Gaussians on the CPU, found them on {frozen.device}; call .to('cpu')")
        frozen.check_finite()
        self.frozen = frozen.detach().to(torch.float32)
        self.config = config or RasterConfig()
        self.views = FrozenViews(self.frozen, self.config, cache_bytes)

    def render(self, cameras: Cameras, dynamic: Dynamic = None, background: Float[Tensor, "3"] | None = None) -> Rendering:
        """As `Rasterizer.render`."""
        if not (torch.isfinite(cameras.viewmats).all() and torch.isfinite(cameras.Ks).all()):
            raise ValueError("the cameras' viewmats and Ks must be finite, found NaN or infinite values")
        frames = []
        for k, moving in enumerate(dynamic_per_frame(dynamic, len(cameras))):
            with rendering_lock:
                view, frozen = self.views.get(cameras.viewmats[k], cameras.Ks[k], cameras.width, cameras.height)
                if moving is None:
                    frames.append(tuple(torch.from_numpy(image) for image in frozen[1:]))
                else:
                    parameters = (moving.means, moving.quats, moving.scales, moving.opacities, moving.colors)
                    frames.append(_RenderMerged.apply(*parameters, view, frozen, self.config))
        color, depth, transmittance = (torch.stack(images) for images in zip(*frames, strict=True))
        return composite(color, depth, 1.0 - transmittance, background)


class _RenderMerged(torch.autograd.Function):
    """One frame: colour [h, w, 3], sum of weights times depth [h, w] and transmittance [h, w]."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        view: View,
        frozen: FrozenView,
        config: RasterConfig,
    ) -> tuple[Tensor, Tensor, Tensor]:
        dynamic, ids = splat(Gaussians(means, quats, scales, opacities, colors), view)
        color, depth, transmittance = frozen.color.copy(), frozen.depth.copy(), frozen.transmittance.copy()
        width, height, workers = view.lens.width, view.lens.height, numba.get_num_threads()
        limits = np.float32(config.max_alpha), np.float32(config.min_transmittance)
        blend_merged(frozen.binned, dynamic, width, height, workers, *limits, color, depth, transmittance)
        images = torch.from_numpy(color), torch.from_numpy(depth), torch.from_numpy(transmittance)
        ctx.save_for_backward(means, quats, scales, opacities, colors, *images)
        ctx.walk = (view, frozen.binned, dynamic, ids, limits)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *to_images: Tensor) -> tuple[Tensor | None, ...]:
        *parameters, color, depth, transmittance = ctx.saved_tensors
        with rendering_lock:
            gradients = _gradients(ctx.walk, parameters, (color, depth, transmittance), to_images)
        typed = (gradient.to(parameter.dtype) for gradient, parameter in zip(gradients, parameters, strict=True))
        return *typed, None, None, None


def _gradients(
    walk: tuple[View, Binned, Binned, np.ndarray, tuple[np.float32, np.float32]],
    parameters: list[Tensor],
    images: tuple[Tensor, ...],
    to_images: tuple[Tensor, ...],
) -> list[Tensor]:
    """Gradients of means, quats, scales, opacities and colours."""
    view, frozen, dynamic, ids, limits = walk
    to_splats = np.zeros((numba.get_num_threads(), len(ids), GRADIENT_COLUMNS), np.float32)
    color, depth, transmittance = (float_array(image) for image in images)
    to_color, to_depth, to_transmittance = (float_array(image) for image in to_images)
    blend_backward(
        frozen,
        dynamic,
        view.lens.width,
        view.lens.height,
        *limits,
        color,
        depth,
        transmittance,
        to_color,
        to_depth,
        to_transmittance,
        to_splats,
    )
    means, quats, scales = (float_array(parameter) for parameter in parameters[:3])
    to_means, to_quats, to_scales, to_opacities, to_colors = (np.zeros(tuple(p.shape), np.float32) for p in parameters)
    project_backward(
        means,
        quats,
        scales,
        view.viewmat,
        view.lens,
        ids,
        to_splats.sum(axis=0),
        to_means,
        to_quats,
        to_scales,
        to_opacities,
        to_colors,
    )
    return [torch.from_numpy(gradient) for gradient in (to_means, to_quats, to_scales, to_opacities, to_colors)]
