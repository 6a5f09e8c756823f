"""How a moment of the weather changes what a camera sees, apart from what moves: the frozen scene's answer, and the air.

A rasterizer is handed a frozen scene once. What rain, snow and haze make of it is a function of time, and of the camera too
(wet ground mirrors the sky, fog fades by distance); both act on a Gaussian's opacity, scales and colour before it is blended.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians


class Viewpoint(NamedTuple):
    """One camera."""

    viewmat: Float[Tensor, "4 4"]
    """World to camera, OpenCV."""
    K: Float[Tensor, "3 3"]
    """Pixels."""
    width: int
    height: int

    @staticmethod
    def of(cameras: Cameras, k: int, like: Tensor) -> Viewpoint:
        """The k-th camera, on the device and in the dtype of a tensor."""
        return Viewpoint(cameras.viewmats[k].to(like), cameras.Ks[k].to(like), cameras.width, cameras.height)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Where the camera stands."""
        return torch.linalg.inv(self.viewmat.double())[:3, 3].to(self.viewmat)


@runtime_checkable
class Moment(Protocol):
    """What a rasterizer asks of a moment; everything in scene units."""

    @property
    def key(self) -> bytes:
        """Moments with the same key look the same: part of what a prepared view is known by."""
        ...

    def altered(self, frozen: Gaussians) -> Gaussians:
        """The frozen scene with other opacities and scales; its tensors are not touched."""
        ...

    def frozen_colors(
        self, rgb: Float[Tensor, "m 3"], means: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], view: Viewpoint
    ) -> Float[Tensor, "m 3"]:
        """Colours of the frozen Gaussians `ids`, from their own as this camera sees them; the air in between included."""
        ...

    def moving_colors(self, rgb: Float[Tensor, "n 3"], means: Float[Tensor, "n 3"], view: Viewpoint) -> Float[Tensor, "n 3"]:
        """Colours of what moves as they arrive through the air; differentiable in `rgb`."""
        ...

    def background(self, own: Float[Tensor, "3"], view: Viewpoint) -> Tensor:
        """What is seen where nothing is, [3] or [h, w, 3]; `own` without weather."""
        ...


Moments: TypeAlias = Moment | Sequence[Moment | None] | None
"""One for each camera, one for all, or none: then the frozen scene looks as it is."""


def moment_per_frame(moments: Moments, frames: int) -> list[Moment | None]:
    """The moment of each frame.

    Raises:
        ValueError: there are not as many as frames.
    """
    if moments is None or not isinstance(moments, Sequence):
        return [moments] * frames
    if len(moments) != frames:
        raise ValueError(f"expected one moment for each of the {frames} cameras, found {len(moments)}; one serves all")
    return list(moments)


def backgrounds(
    background: Float[Tensor, "3"] | None, cameras: Cameras, moments: Sequence[Moment | None], like: Tensor
) -> Tensor | None:
    """What is behind each frame, [t, 1 or h, 1 or w, 3]; None where that is black everywhere."""
    if all(moment is None for moment in moments):
        return background
    own = torch.zeros(3).to(like) if background is None else background.to(like)
    seen = [
        own if moment is None else moment.background(own, Viewpoint.of(cameras, k, like)) for k, moment in enumerate(moments)
    ]
    if all(one.ndim == 1 for one in seen):
        return torch.stack(seen)[:, None, None, :]
    return torch.stack([one.expand(cameras.height, cameras.width, 3) for one in seen])
