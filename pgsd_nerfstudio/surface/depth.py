"""Depth of the solid part of a scene, as its training cameras see it.

Two things are no surface and would pull the depth away from it. Haze, faint Gaussians in front of a surface, is left out, and
so is the sky: Gaussians farther from every camera than anything that is fused. A splat of the outdoors often holds a sphere of
them. The expected depth mixes what it sees by light, so a hundredth of the light from a sky at 2,000 m would put a table at 2 m
another 20 m away.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

VIEWS = 40  # number of training cameras, at most
PIXELS = 512  # of the longer side of a depth image, at most
HAZE, HARDENING = 0.1, 3.0  # see `solid`
SETTINGS = (VIEWS, PIXELS, HAZE, HARDENING)
"""All that the depth depends on besides the scene and the distance of the sky."""


def chosen_views(cameras: Cameras) -> Cameras:
    """An even choice of the training cameras, small enough for depth."""
    chosen = torch.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().long()
    zoom = min(1.0, PIXELS / max(cameras.width, cameras.height))
    return cameras[chosen].resized(round(cameras.width * zoom), round(cameras.height * zoom))


def without_sky(gaussians: Gaussians, cameras: Cameras, distance: float) -> Gaussians:
    """The Gaussians whose centre is within a distance of at least one camera.

    Args:
        gaussians: in scene units.
        cameras: in scene units.
        distance: in scene units.
    """
    nearest, _ = KDTree(cameras.centers.numpy(force=True)).query(gaussians.means.numpy(force=True))
    near = torch.from_numpy(nearest <= distance).to(gaussians.device)
    return gaussians if near.all() else gaussians.select(near)


def solid(gaussians: Gaussians) -> Gaussians:
    """The solid part of a scene; all colours are zero.

    The expected depth of a trained splat lies behind a surface through which a little light leaks, and in front of a surface
    whose reflections faint haze imitates. Gaussians below an opacity of 0.1 are therefore left out and the others hardened to
    1 - (1 - opacity)^3 (three of each), so that light stops at the first surface: on a garden table the spread of depth fell
    from 2.8 to 1.1 cm, and the mesh within 5 cm of it grew from 66 to 90 percent of the pixels. The price is that surfaces lie
    up to a standard deviation of their Gaussians too far out (measured there: 0.5 cm on the table, 2 to 3 cm on the ground).
    More hardening raises that error, less leaves holes.
    """
    kept = gaussians.select(gaussians.opacities > HAZE)
    plain = torch.zeros_like(kept.means)
    return replace(kept, opacities=1 - (1 - kept.opacities) ** HARDENING, colors=plain)


@torch.no_grad()
def render_depths(
    gaussians: Gaussians, cameras: Cameras, device: torch.device, *, progress: bool = True
) -> list[Float[Tensor, "h w"]]:
    """Depth in scene units; 0 where the solid part is half transparent, inf where it is absent and the sky shows.

    Args:
        gaussians: the scene without its sky.
        cameras: one for each image.
        device: where they are rendered.
        progress: whether to show a progress bar.
    """
    rasterizer, depths = choose_rasterizer(solid(gaussians), device), []
    shown = {"console": Console(stderr=True), "disable": not progress, "transient": True}
    for index in track(range(len(cameras)), "Surface: depth of the training views", **shown):
        seen = rasterizer.render(cameras[index].to(device))
        depth, accumulation = seen.depth[0].cpu(), seen.accumulation[0].cpu()
        depth = torch.where(accumulation > 0.5, depth, 0.0)
        depths.append(torch.where(accumulation < 0.1, torch.inf, depth))
    return depths
