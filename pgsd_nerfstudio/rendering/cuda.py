"""The rasterizer for CUDA: gsplat's kernels, with the frozen scene projected and sorted once for each camera.

gsplat's own `rasterization` would project, sort and differentiate a frozen scene of millions of Gaussians in every frame for
the sake of a few thousand dynamic ones. This rasterizer calls gsplat's parts one by one: in each frame it projects and sorts
only the dynamic Gaussians and merges them with the frozen scene's list. The picture is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import gsplat
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.ewa import perspective_jacobians
from pgsd_nerfstudio.rendering.isects import Isects, merge
from pgsd_nerfstudio.rendering.moment import Gaps, Moment, Moments, Viewpoint, backgrounds, moment_per_frame, with_added
from pgsd_nerfstudio.rendering.motion_blur import footprint_opacities, stretched_covariances
from pgsd_nerfstudio.rendering.rasterizer import TILE, Dynamic, RasterConfig, Rendering, composite, dynamic_per_frame
from pgsd_nerfstudio.rendering.view_cache import ViewCache
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


class Splats(NamedTuple):
    """Gaussians that one camera sees, in the form that gsplat blends."""

    centers: Float[Tensor, "m 2"]
    """Pixels."""
    conics: Float[Tensor, "m 3"]
    """Inverse covariances on the image plane, upper triangle."""
    features: Float[Tensor, "m 4"]
    """Red, green, blue and depth."""
    opacities: Float[Tensor, " m"]


class Sorted(NamedTuple):
    """Splats, and the tiles that they enter."""

    splats: Splats
    isects: Isects

    @property
    def nbytes(self) -> int:
        return sum(tensor.nbytes for tensor in (*self.splats, *self.isects))


class GsplatRasterizer:
    """Renders a frozen scene with dynamic Gaussians in it with gsplat.

    The first picture from a camera prepares a view of the frozen scene, which is kept on the device.
    """

    def __init__(self, frozen: Gaussians, *, config: RasterConfig | None = None, cache_bytes: int = 1 << 30) -> None:
        """Check the frozen scene; views are prepared when cameras are first rendered.

        Args:
            frozen: the frozen scene, on CUDA.
            config: conventions of the picture; those of the installed gsplat by default.
            cache_bytes: memory for prepared views; beyond it the least recently used are dropped.

        Raises:
            ValueError: the Gaussians are not on CUDA or not finite, or gsplat cannot be configured as `config` says.
        """
        self._check_device(frozen)
        # gsplat has no function that tells which numbers it was compiled with.
        compiled_in = RasterConfig.of_gsplat(gsplat.__version__)
        # Its one threshold of alpha holds for all Gaussians.
        compiled_in = replace(compiled_in, faint_alpha=compiled_in.min_alpha)
        self.config = replace(config or compiled_in, faint_alpha=compiled_in.min_alpha)
        if self.config != replace(compiled_in, blur=self.config.blur, near=self.config.near, far=self.config.far):
            raise ValueError(
                f"gsplat {gsplat.__version__} lets only blur, near and far be chosen, the rest is {compiled_in}; "
                f"found {self.config}"
            )
        frozen.check_finite()
        self.frozen = frozen.detach().to(torch.float32)
        self.views: ViewCache[Sorted] = ViewCache(cache_bytes)

    @property
    def nbytes(self) -> int:
        """Memory held by prepared views, in bytes."""
        return self.views.nbytes

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
        at = moment_per_frame(moments, len(cameras))
        moving = with_added(dynamic_per_frame(dynamic, len(cameras)), at, cameras)
        frames = [self._frame(cameras, k, moving[k], at[k]) for k in range(len(cameras))]
        clip = torch.stack([image for image, _ in frames])
        gaps = [Gaps.of(light, image[..., 3], image[..., 4]) for image, light in frames]
        behind = backgrounds(background, cameras, at, clip, gaps)
        return composite(clip[..., :3], clip[..., 3], clip[..., 4], behind)

    @staticmethod
    def _check_device(frozen: Gaussians) -> None:
        if frozen.device.type != "cuda":
            raise ValueError(f"GsplatRasterizer expects Gaussians on CUDA, found them on {frozen.device}; call .to('cuda')")

    def _frame(
        self, cameras: Cameras, k: int, moving: Gaussians | None, moment: Moment | None
    ) -> tuple[Float[Tensor, "h w 5"], Float[Tensor, "h w"]]:
        """Sums along the rays of frame k: red, green, blue, weighted depth, accumulation; and the share of light that the
        frozen scene lets through, if there is a moment to ask for it."""
        view = Viewpoint.of(cameras, k, self.frozen.means)
        # The key is made of the caller's tensors, which are mostly on the CPU, so nothing waits for the device.
        key = b"" if moment is None else moment.key
        scene = self.views.get(
            cameras.viewmats[k], cameras.Ks[k], view.width, view.height, lambda: self._prepare(view, moment), key
        )
        if moving is None:
            image = _blend(scene, view)
            return image, 1.0 - image[..., 4]

        def arriving(rgb: Tensor, means: Tensor, ids: Tensor) -> Tensor:
            return rgb if moment is None else moment.moving_colors(rgb, means, view)

        movers = self._sort(moving.to(self.frozen.device, torch.float32), view, arriving)
        splats = Splats(*(torch.cat(pair) for pair in zip(scene.splats, movers.splats, strict=True)))
        image = _blend(Sorted(splats, merge(scene.isects, movers.isects, len(scene.splats.centers))), view)
        if moment is None:
            return image, 1.0 - image[..., 4]
        with torch.no_grad():
            return image, 1.0 - _blend(scene, view)[..., 4]

    @torch.no_grad()
    def _prepare(self, view: Viewpoint, moment: Moment | None) -> Sorted:
        if moment is None:
            return self._sort(self.frozen, view, lambda rgb, means, ids: rgb)
        return self._sort(
            moment.altered(self.frozen), view, lambda rgb, means, ids: moment.frozen_colors(rgb, means, ids, view)
        )

    def _sort(self, gaussians: Gaussians, view: Viewpoint, shade: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Sorted:
        """Project and sort the Gaussians that touch the image.

        Args:
            gaussians: on the device of the frozen scene.
            view: the camera.
            shade: from colours [m, 3], means [m, 3] and indices [m] of Gaussians to the colours that arrive at the camera.
        """
        radii, *projected = self._project(gaussians, view)
        seen = torch.nonzero(radii > 0)[:, 0]  # for the others gsplat leaves the memory as it was
        centers, depths, conics = (tensor[seen] for tensor in projected)
        gaussians = gaussians.select(seen)
        colors = shade(view_colors(gaussians.colors, gaussians.means, view.viewmat), gaussians.means, seen)
        splats = Splats(centers, conics, torch.cat([colors, depths[:, None]], dim=1), self._opacities(gaussians, view))
        return Sorted(splats, _intersect(centers.detach(), radii[seen], depths.detach(), view))

    def _project(self, gaussians: Gaussians, view: Viewpoint) -> Sequence[Tensor]:
        """Radii [n] (0 where not drawn), centres [n, 2], depths [n] and conics [n, 3]."""
        still = gaussians.displacements is None
        *found, _ = gsplat.fully_fused_projection(
            gaussians.means,
            None if still else upper_triangle(stretched_covariances(gaussians)),
            gaussians.quats if still else None,
            gaussians.scales if still else None,
            view.viewmat[None],
            view.K[None],
            view.width,
            view.height,
            eps2d=self.config.blur,
            near_plane=self.config.near,
            far_plane=self.config.far,
        )
        return [tensor[0] for tensor in found]

    def _opacities(self, gaussians: Gaussians, view: Viewpoint) -> Float[Tensor, " m"]:
        """Opacities on the image plane, of Gaussians in front of the camera."""
        turn = view.viewmat[:3, :3]
        points = gaussians.means @ turn.T + view.viewmat[:3, 3]
        to_image = perspective_jacobians(points, view.K, view.width, view.height, self.config.frustum_margin) @ turn
        return footprint_opacities(gaussians, to_image, self.config.blur, self.config.faint_alpha)


def upper_triangle(matrices: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 6"]:
    """The upper triangle of symmetric matrices, row by row, as gsplat takes covariances."""
    return matrices.flatten(1)[:, [0, 1, 2, 4, 5, 8]]


def _intersect(centers: Float[Tensor, "m 2"], radii: Tensor, depths: Float[Tensor, " m"], view: Viewpoint) -> Isects:
    across, down = -(-view.width // TILE), -(-view.height // TILE)
    _, ids, rows = gsplat.isect_tiles(centers[None], radii[None], depths[None], TILE, across, down)
    return Isects(ids, rows, gsplat.isect_offset_encode(ids, 1, across, down))


def _blend(scene: Sorted, view: Viewpoint) -> Float[Tensor, "h w 5"]:
    centers, conics, features, opacities = (tensor[None] for tensor in scene.splats)
    _, rows, offsets = scene.isects
    sums, accumulation = gsplat.rasterize_to_pixels(
        centers, conics, features, opacities, view.width, view.height, TILE, offsets, rows
    )
    return torch.cat([sums[0], accumulation[0]], dim=-1)
