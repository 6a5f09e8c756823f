"""The rasterizer for the CPU: numba kernels on all cores, forward and backward."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.compilation import small_steps, workers
from pgsd_nerfstudio.rendering.frozen import FrozenView, FrozenViews, View, float_array, motions_array, splat
from pgsd_nerfstudio.rendering.layers import Layers
from pgsd_nerfstudio.rendering.moment import Gaps, Moment, Moments, Viewpoint, backgrounds, moment_per_frame, with_added
from pgsd_nerfstudio.rendering.projection_gradient import GRADIENT_COLUMNS, project_backward
from pgsd_nerfstudio.rendering.rasterizer import Dynamic, RasterConfig, Rendering, composite, dynamic_per_frame
from pgsd_nerfstudio.rendering.walk import blend_at_once, blend_backward, blend_merged
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


class CpuRasterizer:
    """Renders a frozen scene with dynamic Gaussians in it on the CPU.

    The first picture from a camera prepares a view of the frozen scene. The view is kept, so later pictures from the same
    camera cost little more than their dynamic Gaussians. Several Python threads may call a rasterizer.
    """

    def __init__(
        self,
        frozen: Gaussians,
        *,
        config: RasterConfig | None = None,
        cache_bytes: int = 1 << 30,
        layers: int | None = None,
    ) -> None:
        """Check the frozen scene; views are prepared when cameras are first rendered.

        Args:
            frozen: the frozen scene, on the CPU.
            config: conventions of the picture; gsplat 1.4.0's by default.
            cache_bytes: memory for prepared views; beyond it the least recently used are dropped.
            layers: number of layers that the frozen splats of each tile are pressed into (see layers.py); None blends them
                exactly.

        Raises:
            ValueError: the Gaussians are not on the CPU or not finite, or `layers` is less than one.
        """
        if frozen.device.type != "cpu":
            raise ValueError(f"CpuRasterizer expects Gaussians on the CPU, found them on {frozen.device}; call .to('cpu')")
        if layers is not None and layers < 1:
            raise ValueError(f"a tile has at least one layer, or is exact with layers=None; found layers={layers}")
        frozen.check_finite()
        self.frozen = frozen.detach().to(torch.float32)
        self.config = config or RasterConfig()
        self.views = FrozenViews(self.frozen, self.config, cache_bytes, layers)

    @property
    def memory(self) -> str:
        """As `Rasterizer.memory`."""
        return str(self.views)

    def render(
        self,
        cameras: Cameras,
        dynamic: Dynamic = None,
        background: Float[Tensor, "3"] | None = None,
        moments: Moments = None,
    ) -> Rendering:
        """As `Rasterizer.render`."""
        if not (torch.isfinite(cameras.viewmats).all() and torch.isfinite(cameras.Ks).all()):
            raise ValueError("the cameras' viewmats and Ks must be finite, found NaN or infinite values")
        with small_steps(3 * max(cameras.width * cameras.height, len(self.frozen))):
            return self._render(cameras, dynamic, background, moment_per_frame(moments, len(cameras)))

    def _render(
        self, cameras: Cameras, dynamic: Dynamic, background: Float[Tensor, "3"] | None, at: list[Moment | None]
    ) -> Rendering:
        frames, gaps = [], []
        sets = with_added(dynamic_per_frame(dynamic, len(cameras)), at, cameras)
        for k, (moving, moment) in enumerate(zip(sets, at, strict=True)):
            # The backward pass walks over the frozen list once more, which a view that is blended alone makes shorter.
            once = moving is not None and not (
                torch.is_grad_enabled() and any(tensor.requires_grad for tensor in moving.tensors.values())
            )
            camera = cameras.viewmats[k], cameras.Ks[k], cameras.width, cameras.height
            view, frozen = self.views.get(*camera, moment, once=once)
            if moving is None:
                assert frozen.image is not None
                frames.append(torch.from_numpy(frozen.image))
                light = frames[-1][0]
            else:
                colors = view_colors(moving.colors, moving.means, cameras.viewmats[k])
                if moment is not None:
                    colors = moment.moving_colors(colors, moving.means, Viewpoint.of(cameras, k, moving.means))
                tensors = {**moving.tensors, "colors": colors}
                drawn = _Drawn(moving.antialiased, moving.whole)
                asked = moment is not None
                image, light = _RenderMerged.apply(view, frozen, self.config, drawn, asked, *tensors.values())
                frames.append(image)
            gaps.append(Gaps.of(light, frames[-1][4], 1.0 - frames[-1][0]))
        clip = torch.stack(frames)
        behind = backgrounds(background, cameras, at, clip, gaps)
        return composite(clip[:, 1:4].permute(0, 2, 3, 1), clip[:, 4], 1.0 - clip[:, 0], behind)


class _Drawn(NamedTuple):
    """Fields of Gaussians that are no tensors."""

    antialiased: bool
    whole: bool


class _Walk(NamedTuple):
    """What the backward pass needs from the forward pass of a frame."""

    view: View
    part: Binned | Layers
    dynamic: Binned
    drawn: _Drawn
    ids: np.ndarray
    """[m] int32: the index of the Gaussian of each splat in `dynamic`."""
    limits: tuple[np.float32, np.float32]
    """max_alpha and min_transmittance."""
    image: np.ndarray
    """[5, h, w] float32 as in blending.py."""


class _RenderMerged(torch.autograd.Function):
    """One frame [5, h, w] as in blending.py, with gradients for the tensors of its dynamic Gaussians; and the share of light
    [h, w] that the frozen scene lets through if that is asked, without gradients."""

    @staticmethod
    def forward(
        ctx: Any, view: View, frozen: FrozenView, config: RasterConfig, drawn: _Drawn, asked: bool, *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        dynamic, ids = splat(Gaussians(*tensors, **drawn._asdict()), view)
        width, height = view.lens.width, view.lens.height
        limits = np.float32(config.max_alpha), np.float32(config.min_transmittance)
        if frozen.image is None:
            assert isinstance(frozen.part, Binned)
            image = np.empty((5, height, width), np.float32)
            light = np.empty((height, width) if asked else (0, 0), np.float32)
            blend_at_once(frozen.part, dynamic, width, height, *limits, image, light)
            light = light if asked else image[0]
        else:
            image = frozen.image.copy()
            blend_merged(frozen.part, dynamic, width, height, *limits, image)
            light = frozen.image[0]
        ctx.save_for_backward(*tensors)
        ctx.walk = _Walk(view, frozen.part, dynamic, drawn, ids, limits, image)
        through = torch.from_numpy(light)
        ctx.mark_non_differentiable(through)
        return torch.from_numpy(image), through

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_image: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
        gradients = _gradients(ctx.walk, Gaussians(*ctx.saved_tensors), to_image)
        typed = (gradient.to(tensor.dtype) for gradient, tensor in zip(gradients, ctx.saved_tensors, strict=True))
        return None, None, None, None, None, *typed


def _gradients(walk: _Walk, gaussians: Gaussians, to_image: Tensor) -> list[Tensor]:
    """Gradients of the tensors of the dynamic Gaussians, in the order of these tensors."""
    view, part, dynamic, drawn, ids, limits, image = walk
    lens = view.lens
    to_splats = np.zeros((workers(), len(ids), GRADIENT_COLUMNS), np.float32)
    scene = dynamic, lens.width, lens.height, *limits, image, float_array(to_image), to_splats
    blend_backward(part, *scene)
    means, quats, scales = (float_array(tensor) for tensor in (gaussians.means, gaussians.quats, gaussians.scales))
    motions, totals = motions_array(gaussians), to_splats[0] if len(to_splats) == 1 else to_splats.sum(axis=0)
    found = [np.zeros(tuple(tensor.shape), np.float32) for tensor in gaussians.tensors.values()]
    outputs = found if len(motions) else [*found, np.zeros((0, 3), np.float32)]
    projected = means, quats, scales, motions, drawn.antialiased, drawn.whole, view.viewmat, lens
    project_backward(*projected, ids, dynamic.splats, totals, *outputs)
    return [torch.from_numpy(gradient) for gradient in found]
