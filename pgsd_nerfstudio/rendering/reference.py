"""The judge: the same picture in plain float64 torch, differentiable by autograd, as slow as it is short.

Written after gsplat 1.4.0's CUDA sources (fully_fused_projection_fwd.cu, isect_tiles.cu, rasterize_to_pixels_fwd.cu), with
nothing of the numba kernels. Never a default.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pgsd_nerfstudio.rendering.rasterizer import TILE, RasterConfig, Rendering, composite
from pgsd_nerfstudio.rendering.spherical_harmonics import view_colors
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians


class Projection(NamedTuple):
    """Gaussians on the image plane of one camera."""

    centers: Float[Tensor, "n 2"]
    """Pixels."""
    covariances: Float[Tensor, "n 2 2"]
    """Pixels squared, blur included."""
    depths: Float[Tensor, "n"]
    radii: Float[Tensor, "n"]
    """Whole pixels, 0 where the Gaussian is not drawn."""


def project_reference(
    gaussians: Gaussians, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int, config: RasterConfig
) -> Projection:
    """EWA projection of float64 Gaussians."""
    points = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = points.unbind(-1)
    seen = (z >= config.near) & (z <= config.far)
    z = torch.where(seen, z, torch.ones_like(z))  # what is not drawn must not divide by zero, neither here nor in the gradient
    focal, center, extent = K.diagonal()[:2], K[:2, 2], torch.tensor([width, height]).to(K)
    slopes = torch.stack([x / z, y / z], dim=-1)
    centers = slopes * focal + center
    slack = config.frustum_margin * 0.5 * extent / focal
    bent = torch.maximum(torch.minimum(slopes, (extent - center) / focal + slack), -center / focal - slack)

    rotations = roma.unitquat_to_rotmat(torch.nn.functional.normalize(gaussians.quats, dim=-1)[:, [1, 2, 3, 0]])
    factors = viewmat[:3, :3] @ rotations * gaussians.scales[:, None, :]
    covariances = factors @ factors.mT
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] * bent[:, 0] / z], dim=-1),
            torch.stack([zero, focal[1] / z, -focal[1] * bent[:, 1] / z], dim=-1),
        ],
        dim=-2,
    )
    flat = jacobian @ covariances @ jacobian.mT + config.blur * torch.eye(2).to(K)

    mean = 0.5 * (flat[:, 0, 0] + flat[:, 1, 1])
    largest = mean + (mean**2 - torch.linalg.det(flat)).clamp_min(0.01).sqrt()
    radii = (config.radius_sigmas * largest.sqrt()).ceil()
    inside = ((centers + radii[:, None] > 0) & (centers - radii[:, None] < extent)).all(dim=-1)
    return Projection(centers, flat, z, torch.where(seen & inside, radii, zero).detach())


def _enters(projection: Projection, left: int, top: int) -> Bool[Tensor, "n"]:
    """Whether the square around each Gaussian touches the tile at (left, top)."""
    corner = torch.tensor([left, top]).to(projection.centers)
    radii = projection.radii[:, None]
    first = torch.floor((projection.centers - radii) / TILE) * TILE
    last = torch.ceil((projection.centers + radii) / TILE) * TILE
    return ((first <= corner) & (corner < last)).all(dim=-1) & (projection.radii > 0)


def _blend(
    pixels: Float[Tensor, "p 2"],
    projection: Projection,
    opacities: Float[Tensor, "n"],
    colors: Float[Tensor, "n 3"],
    config: RasterConfig,
) -> Float[Tensor, "p 5"]:
    """Red, green, blue, weighted depth and accumulation at pixel centres; Gaussians come nearest first."""
    dx, dy = (pixels[:, None, :] - projection.centers).unbind(-1)
    conics = torch.linalg.inv(projection.covariances)
    sigma = 0.5 * (conics[:, 0, 0] * dx**2 + conics[:, 1, 1] * dy**2) + conics[:, 0, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp_max(config.max_alpha)
    alpha = torch.where(alpha >= config.min_alpha, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    # Light only falls along the ray, so all behind the first Gaussian that lets too little through is cut off with it.
    weights = torch.where(after > config.min_transmittance, alpha * before, torch.zeros_like(alpha))
    return weights @ torch.cat([colors, projection.depths[:, None], torch.ones_like(projection.depths)[:, None]], dim=1)


def render_reference(
    cameras: Cameras,
    gaussians: Gaussians | Sequence[Gaussians],
    background: Float[Tensor, "3"] | None = None,
    config: RasterConfig | None = None,
) -> Rendering:
    """Render one set, or several (each with plain RGB or harmonics) as one scene; float64, differentiable in all of them."""
    config = config or RasterConfig()
    sets = [one.to(torch.float64) for one in ([gaussians] if isinstance(gaussians, Gaussians) else gaussians)]
    clip = torch.stack([_render_frame(cameras, k, sets, config) for k in range(len(cameras))])
    return composite(clip[..., :3], clip[..., 3], clip[..., 4], background)


@torch.no_grad()
def certain_pixels(
    cameras: Cameras, gaussians: Gaussians | Sequence[Gaussians], margin: float = 2e-5, config: RasterConfig | None = None
) -> Bool[Tensor, "t h w"]:
    """Pixels where no decision (drawn or not, finished or not) hangs on the last digits of single precision.

    Elsewhere two exact rasterizers may differ by a whole step. Found by moving the thresholds by the relative `margin`: certain
    pixels stay as they are.
    """
    config = config or RasterConfig()
    before = render_reference(cameras, gaussians, config=config).accumulation
    certain = torch.ones_like(before, dtype=torch.bool)
    for factor in (1.0 - margin, 1.0 + margin):
        moved = replace(config, min_alpha=config.min_alpha * factor, min_transmittance=config.min_transmittance * factor)
        certain &= (render_reference(cameras, gaussians, config=moved).accumulation - before).abs() < 1e-9
    return certain


def _render_frame(cameras: Cameras, k: int, sets: Sequence[Gaussians], config: RasterConfig) -> Float[Tensor, "h w 5"]:
    viewmat, K = cameras.viewmats[k].double(), cameras.Ks[k].double()
    parts = [project_reference(one, viewmat, K, cameras.width, cameras.height, config) for one in sets]
    projection = Projection(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))
    opacities = torch.cat([one.opacities for one in sets])
    colors = torch.cat([view_colors(one.colors, one.means, viewmat) for one in sets])
    order = projection.depths.float().argsort(stable=True)  # gsplat sorts single precision depths
    image = torch.zeros(cameras.height, cameras.width, 5, dtype=torch.float64)
    for top in range(0, cameras.height, TILE):
        for left in range(0, cameras.width, TILE):
            chosen = order[_enters(projection, left, top)[order]]
            if len(chosen):
                y = torch.arange(top, min(top + TILE, cameras.height))
                x = torch.arange(left, min(left + TILE, cameras.width))
                pixels = torch.cartesian_prod(y, x).flip(-1).double() + 0.5
                here = Projection(*(t[chosen] for t in projection))
                # Intermediate values are made again on the way back: kept, those of one large scene would fill the memory.
                tile = checkpoint(_blend, pixels, here, opacities[chosen], colors[chosen], config, use_reentrant=False)
                image[y[0] : y[-1] + 1, x[0] : x[-1] + 1] = tile.view(len(y), len(x), 5)
    return image
