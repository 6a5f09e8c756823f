"""Edited pictures with their cameras in the size of the fit, and the Gaussians that they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.response.edited_pictures import Picture
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors

SEEN = 0.02  # pixels; Gaussians that light up less than this in every view are not fitted
LEAST_SIDE = 16  # pixels; the window of structural similarity has 11


@dataclass(frozen=True)
class EditedViews:
    """The edited views in the size of the fit."""

    cameras: Cameras
    targets: list[Float[Tensor, "h w 3"]]
    """Edited pictures in half precision on the CPU."""
    seen: Bool[Tensor, " n"]
    """Whether a Gaussian lights up at least SEEN pixels in one of the views."""

    @staticmethod
    def of(
        gaussians: Gaussians, cameras: Cameras, pictures: Sequence[Picture], side: int | None, advance: Callable[[], object]
    ) -> EditedViews:
        """Shrink the pictures and find the Gaussians that they show.

        Args:
            gaussians: the frozen scene.
            cameras: all views of the scene.
            pictures: indices of views and their edited pictures in the size of the cameras.
            side: pixels of the longer side to which the pictures are shrunk; None: they keep their size.
            advance: called after each view.
        """
        cameras = cameras[torch.tensor([index for index, _ in pictures])]
        small = _shrunk(cameras, side)
        most, targets = torch.zeros(len(gaussians), device=gaussians.device), []
        rasterizer = choose_rasterizer(Gaussians.empty(), gaussians.device)
        for k, (_, picture) in enumerate(pictures):
            target = picture.to(gaussians.device) / 255
            colors = view_colors(gaussians.colors, gaussians.means, small.viewmats[k]).clone().requires_grad_()
            shown = rasterizer.render(small[k], replace(gaussians, colors=colors)).rgb[0]
            # The gradient of the picture by a Gaussian's red is the number of pixels that the Gaussian lights up.
            (light,) = torch.autograd.grad(shown[..., 0].sum(), colors)
            most = torch.maximum(most, light[:, 0])
            if small.width != cameras.width:
                # Gaussians look wider where pixels are larger, which is no edit. So the small target is the small picture of
                # the scene plus the difference that the editor made.
                with torch.no_grad():
                    change = target - rasterizer.render(cameras[k], gaussians).rgb[0]
                target = shown.detach() + _averaged(change, small.width, small.height)
            targets.append(target.half().cpu())
            advance()
        return EditedViews(small, targets, most >= SEEN)


def _shrunk(cameras: Cameras, side: int | None) -> Cameras:
    """The same views, uncropped, with at most `side` pixels along the longer side; they are stretched by less than a pixel."""
    zoom = 1.0 if side is None else min(1.0, side / max(cameras.width, cameras.height))
    width, height = (max(LEAST_SIDE, round(zoom * length)) for length in (cameras.width, cameras.height))
    stretch = torch.tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.viewmats, cameras.Ks * stretch.to(cameras.Ks)[:, None], width, height)


def _averaged(picture: Float[Tensor, "h w 3"], width: int, height: int) -> Float[Tensor, "height width 3"]:
    small = torch.nn.functional.interpolate(picture.permute(2, 0, 1)[None], (height, width), mode="area")
    return small[0].permute(1, 2, 0)
