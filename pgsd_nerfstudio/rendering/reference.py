"""The reference rasterizer: the same picture in plain float64 torch, differentiable by autograd, short and slow.

It follows gsplat's CUDA sources (1.4.0: fully_fused_projection_fwd.cu, isect_tiles.cu, rasterize_to_pixels_fwd.cu; 1.5:
ProjectionEWA3DGSFused.cu for rectangles) and shares nothing with the numba kernels, which it judges. It is never a default.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pgsd_nerfstudio.rendering.ewa import perspective_jacobians
from pgsd_nerfstudio.rendering.moment import Gaps, Moment, Moments, Viewpoint, backgrounds, moment_per_frame
from pgsd_nerfstudio.rendering.motion_blur import determinants, footprint_opacities, stretched_covariances
from pgsd_nerfstudio.rendering.rasterizer import TILE, RasterConfig, Rendering, composite
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


class Projection(NamedTuple):
    """Gaussians on the image plane of one camera."""

    centers: Float[Tensor, "n 2"]
    """Pixels."""
    covariances: Float[Tensor, "n 2 2"]
    """Pixels squared, blur and motion included."""
    depths: Float[Tensor, " n"]
    """Along the camera's z axis, scene units."""
    opacities: Float[Tensor, " n"]
    """Averaged over the exposure if it moves, and under the blur if it is antialiased; `faint_alpha` more if it is whole."""
    thresholds: Float[Tensor, " n"]
    """Smallest alphas that are drawn."""
    radii: Float[Tensor, "n 2"]
    """Half sides of the footprint along x and y in whole pixels, 0 if the Gaussian is not drawn."""


def project_reference(
    gaussians: Gaussians,
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    config: RasterConfig,
    missed: float | None = None,
) -> Projection:
    """Project Gaussians by EWA splatting.

    Args:
        gaussians: in the dtype of `viewmat` and `K`.
        viewmat: world to camera.
        K: intrinsics in pixels.
        width: of the image in pixels.
        height: of the image in pixels.
        config: the rules of projection.
        missed: what the peaks of whole Gaussians rise by; None: `config.faint_alpha`.
    """
    points = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    seen = (points[:, 2] >= config.near) & (points[:, 2] <= config.far)
    # Gaussians that are not drawn must not divide by zero, neither here nor in the gradient.
    points = torch.where(seen[:, None], points, torch.tensor([0.0, 0.0, 1.0]).to(points))
    centers = points[:, :2] / points[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    to_image = perspective_jacobians(points, K, width, height, config.frustum_margin) @ viewmat[:3, :3]
    unit = torch.eye(2).to(K)
    flat = to_image @ stretched_covariances(gaussians) @ to_image.mT + config.blur * unit
    opacities = footprint_opacities(gaussians, to_image, config.blur, config.faint_alpha if missed is None else missed)
    drawn = seen & (determinants(flat) > 0)
    thresholds = torch.full_like(opacities, config.faint_alpha if gaussians.whole else config.min_alpha)
    radii = _half_sides(flat, opacities, thresholds, config)
    inside = ((centers + radii > 0) & (centers - radii < torch.tensor([width, height]).to(K))).all(dim=-1)
    radii = torch.where((drawn & inside)[:, None], radii, 0.0)
    return Projection(centers, flat, points[:, 2], opacities, thresholds, radii)


@torch.no_grad()
def _half_sides(
    covariances: Float[Tensor, "n 2 2"], opacities: Float[Tensor, " n"], thresholds: Float[Tensor, " n"], config: RasterConfig
) -> Float[Tensor, "n 2"]:
    """Half sides of the footprint in whole pixels."""
    variances = covariances.diagonal(dim1=1, dim2=2)
    if config.footprint == "square":
        mean = variances.mean(dim=1, keepdim=True)
        largest = mean + (mean**2 - determinants(covariances)[:, None]).clamp_min(0.01).sqrt()
        return (config.radius_sigmas * largest.sqrt()).ceil().expand(-1, 2)
    sigmas = (2.0 * (opacities / thresholds).clamp_min(1.0).log()).sqrt().clamp_max(config.radius_sigmas)
    return (sigmas[:, None] * variances.sqrt()).ceil()


def _enters(projection: Projection, left: int, top: int) -> Bool[Tensor, " n"]:
    """Whether the footprint of each Gaussian touches the tile at (left, top)."""
    corner = torch.tensor([left, top]).to(projection.centers)
    first = torch.floor((projection.centers - projection.radii) / TILE) * TILE
    last = torch.ceil((projection.centers + projection.radii) / TILE) * TILE
    return ((first <= corner) & (corner < last) & (projection.radii > 0)).all(dim=-1)


def _blend(
    pixels: Float[Tensor, "p 2"], projection: Projection, colors: Float[Tensor, "n 3"], config: RasterConfig
) -> Float[Tensor, "p 5"]:
    """Red, green, blue, weighted depth and accumulation at pixel centres, of Gaussians that are given nearest first."""
    dx, dy = (pixels[:, None, :] - projection.centers).unbind(-1)
    a, b, c = projection.covariances.flatten(1)[:, [0, 1, 3]].unbind(-1)
    sigma = (0.5 * (c * dx**2 + a * dy**2) - b * dx * dy) / determinants(projection.covariances)
    alpha = (projection.opacities * torch.exp(-sigma)).clamp_max(config.max_alpha)
    alpha = torch.where(alpha >= projection.thresholds, alpha, 0.0)
    after = torch.cumprod(1.0 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    # Light only decreases along the ray, so the first Gaussian that lets too little through cuts off all behind it too.
    weights = torch.where(after > config.min_transmittance, alpha * before, torch.zeros_like(alpha))
    return weights @ torch.cat([colors, projection.depths[:, None], torch.ones_like(projection.depths)[:, None]], dim=1)


def render_reference(
    cameras: Cameras,
    gaussians: Gaussians | Sequence[Gaussians],
    background: Float[Tensor, "3"] | None = None,
    config: RasterConfig | None = None,
    *,
    moments: Moments = None,
    dtype: torch.dtype = torch.float64,
) -> Rendering:
    """Render one or several sets of Gaussians as one scene; differentiable in all of them.

    Gaussians of equal depth are drawn in the order given.

    Args:
        cameras: one for each frame.
        gaussians: one set or several, each with plain RGB or harmonics; the first is the frozen scene for `moments`.
        background: colour behind all Gaussians; None is black.
        config: conventions of the picture; gsplat 1.4.0's by default.
        moments: as for `Rasterizer.render`.
        dtype: float64 to judge others; in float32 it stands for a vectorised torch rasterizer in benches.
    """
    config = config or RasterConfig()
    sets = [one.to(dtype) for one in ([gaussians] if isinstance(gaussians, Gaussians) else gaussians)]
    at = moment_per_frame(moments, len(cameras))
    clip = torch.stack([_render_frame(cameras, k, sets, config, at[k]) for k in range(len(cameras))])
    frozen = clip
    if len(sets) > 1 and any(moment is not None for moment in at):
        with torch.no_grad():
            frozen = torch.stack([_render_frame(cameras, k, sets[:1], config, at[k]) for k in range(len(cameras))])
    gaps = [Gaps.of(1.0 - image[..., 4], image[..., 3], image[..., 4]) for image in frozen]
    behind = backgrounds(background, cameras, at, clip, gaps)
    return composite(clip[..., :3], clip[..., 3], clip[..., 4], behind)


@torch.no_grad()
def certain_pixels(
    cameras: Cameras, gaussians: Gaussians | Sequence[Gaussians], margin: float = 2e-5, config: RasterConfig | None = None
) -> Bool[Tensor, "t h w"]:
    """Pixels in which no decision (drawn or not, finished or not) depends on the last digits of single precision.

    In other pixels two exact rasterizers may differ by a whole step.

    Args:
        cameras: one for each frame.
        gaussians: one set or several, as for `render_reference`.
        margin: relative change of the thresholds that leaves certain pixels as they are.
        config: conventions of the picture.
    """
    config = config or RasterConfig()
    sets = [one.to(torch.float64) for one in ([gaussians] if isinstance(gaussians, Gaussians) else gaussians)]

    def accumulation(moved: RasterConfig) -> Tensor:
        clip = [_render_frame(cameras, k, sets, moved, None, config.faint_alpha) for k in range(len(cameras))]
        return torch.stack(clip)[..., 4]

    before = accumulation(config)
    certain = torch.ones_like(before, dtype=torch.bool)
    for factor in (1.0 - margin, 1.0 + margin):
        moved = replace(
            config,
            min_alpha=config.min_alpha * factor,
            faint_alpha=config.faint_alpha * factor,
            min_transmittance=config.min_transmittance * factor,
        )
        certain &= (accumulation(moved) - before).abs() < 1e-9
    return certain


def _render_frame(
    cameras: Cameras,
    k: int,
    sets: Sequence[Gaussians],
    config: RasterConfig,
    moment: Moment | None,
    missed: float | None = None,  # as for `project_reference`
) -> Float[Tensor, "h w 5"]:
    view = Viewpoint.of(cameras, k, sets[0].means)
    viewmat, K = view.viewmat, view.K
    if moment is not None:
        added = moment.adds(view)
        sets = [moment.altered(sets[0]), *sets[1:], *([] if added is None else [added.to(sets[0].means)])]
    parts = [project_reference(one, viewmat, K, cameras.width, cameras.height, config, missed) for one in sets]
    projection = Projection(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))
    seen = [view_colors(one.colors, one.means, viewmat) for one in sets]
    if moment is not None:
        frozen = moment.frozen_colors(seen[0], sets[0].means, torch.arange(len(sets[0])), view)
        moving = [moment.moving_colors(rgb, one.means, view) for rgb, one in zip(seen[1:], sets[1:], strict=True)]
        seen = [frozen, *moving]
    colors = torch.cat(seen)
    order = projection.depths.float().argsort(stable=True)  # gsplat sorts single precision depths
    image = torch.zeros(cameras.height, cameras.width, 5).to(viewmat)
    for top in range(0, cameras.height, TILE):
        for left in range(0, cameras.width, TILE):
            chosen = order[_enters(projection, left, top)[order]]
            if len(chosen):
                y = torch.arange(top, min(top + TILE, cameras.height))
                x = torch.arange(left, min(left + TILE, cameras.width))
                pixels = torch.cartesian_prod(y, x).flip(-1).to(viewmat) + 0.5
                here = Projection(*(t[chosen] for t in projection))
                # The backward pass computes intermediate values again: those of one large scene would fill the memory.
                tile = checkpoint(_blend, pixels, here, colors[chosen], config, use_reentrant=False)
                image[y[0] : y[-1] + 1, x[0] : x[-1] + 1] = tile.view(len(y), len(x), 5)
    return image
