"""A moment of the weather: how it changes the look of the frozen scene, and the air in front of a camera.

A rasterizer gets the frozen scene once. The effect of rain, snow and haze on it depends on time and on the camera (wet ground
mirrors the sky, fog fades by distance); it changes a Gaussian's opacity, scales and colour before the Gaussian is blended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


class Viewpoint(NamedTuple):
    """One camera."""

    viewmat: Float[Tensor, "4 4"]
    """World to camera, OpenCV."""
    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    @staticmethod
    def of(cameras: Cameras, k: int, like: Tensor) -> Viewpoint:
        """The k-th camera, on the device and in the dtype of the tensor `like`."""
        return Viewpoint(cameras.viewmats[k].to(like), cameras.Ks[k].to(like), cameras.width, cameras.height)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Position of the camera in scene units."""
        return torch.linalg.inv(self.viewmat.double())[:3, 3].to(self.viewmat)


class Gaps(NamedTuple):
    """What the frozen scene leaves open in a picture."""

    light: Float[Tensor, "h w"]
    """Share of the light from behind that the frozen scene lets through."""
    depth: Float[Tensor, "h w"]
    """Expected depth along the camera's z axis in scene units of what is there; 0 where nothing is."""

    @staticmethod
    def of(light: Float[Tensor, "h w"], weighted: Float[Tensor, "h w"], accumulation: Float[Tensor, "h w"]) -> Gaps:
        """The gaps of a picture, from the sum of its weights times depths and the sum of its weights."""
        return Gaps(light.detach(), (weighted / accumulation.clamp_min(1e-10)).detach())


@runtime_checkable
class Moment(Protocol):
    """What a rasterizer needs to know of a moment; lengths are in scene units."""

    @property
    def key(self) -> bytes:
        """Moments with the same key look the same; the key is a part of the key of a prepared view."""
        ...

    def altered(self, frozen: Gaussians) -> Gaussians:
        """The frozen scene with other opacities and scales; the tensors of `frozen` stay as they are."""
        ...

    def frozen_colors(
        self, rgb: Float[Tensor, "m 3"], means: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], view: Viewpoint
    ) -> Float[Tensor, "m 3"]:
        """Colours of frozen Gaussians as they arrive at a camera.

        Args:
            rgb: colours that the camera would see without weather.
            means: centres.
            ids: indices of the Gaussians in the frozen scene.
            view: the camera.
        """
        ...

    def moving_colors(self, rgb: Float[Tensor, "n 3"], means: Float[Tensor, "n 3"], view: Viewpoint) -> Float[Tensor, "n 3"]:
        """Colours of dynamic Gaussians as they arrive at a camera through the air; differentiable in `rgb`.

        Args:
            rgb: colours as they leave.
            means: centres.
            view: the camera.
        """
        ...

    def adds(self, view: Viewpoint) -> Gaussians | None:
        """Gaussians of the moment itself that only this view needs, with plain RGB as it leaves them; they are drawn with the
        dynamic ones. None: there are none.

        Args:
            view: the camera.
        """
        ...

    def background(self, own: Float[Tensor, "3"], view: Viewpoint, gaps: Gaps) -> Tensor:
        """The background as a camera sees it, [3] or [h, w, 3].

        Args:
            own: the background without weather.
            view: the camera.
            gaps: of the frozen scene, through which the background is seen.
        """
        ...


Moments: TypeAlias = Moment | Sequence[Moment | None] | None
"""One moment for each camera, one for all, or none: then the frozen scene looks as it is."""


def moment_per_frame(moments: Moments, frames: int) -> list[Moment | None]:
    """The moment of each frame.

    Raises:
        ValueError: there are not as many moments as frames.
    """
    if moments is None or not isinstance(moments, Sequence):
        return [moments] * frames
    if len(moments) != frames:
        raise ValueError(f"expected one moment for each of the {frames} cameras, found {len(moments)}; one serves all")
    return list(moments)


def with_added(
    moving: Sequence[Gaussians | None], moments: Sequence[Moment | None], cameras: Cameras
) -> list[Gaussians | None]:
    """The dynamic Gaussians of each frame, and those that the moment of the frame adds for its camera.

    Args:
        moving: one set for each frame, or None.
        moments: one for each frame, or None.
        cameras: one for each frame.
    """
    frames = []
    for k, (one, moment) in enumerate(zip(moving, moments, strict=True)):
        with torch.no_grad():
            added = None if moment is None else moment.adds(Viewpoint.of(cameras, k, torch.zeros(1)))
        if one is not None and added is not None:
            colors = view_colors(one.colors, one.means, cameras.viewmats[k].to(one.means))
            own = replace(added.to(one.means), antialiased=one.antialiased, whole=one.whole)
            frames.append(concatenate([replace(one, colors=colors), own]))
        else:
            frames.append(added if one is None else one)
    return frames


def backgrounds(
    background: Float[Tensor, "3"] | None,
    cameras: Cameras,
    moments: Sequence[Moment | None],
    like: Tensor,
    gaps: Sequence[Gaps],
) -> Tensor | None:
    """The background of each frame.

    Args:
        background: the background without weather; None is black.
        cameras: one for each frame.
        moments: one for each frame.
        like: tensor whose device and dtype the result has.
        gaps: of the frozen scene in each frame.

    Returns:
        `background` itself if there are no moments, otherwise [t, 1 or h, 1 or w, 3].
    """
    if all(moment is None for moment in moments):
        return background
    own = torch.zeros(3).to(like) if background is None else background.to(like)
    seen = [
        own if moment is None else moment.background(own, Viewpoint.of(cameras, k, like), gaps[k])
        for k, moment in enumerate(moments)
    ]
    if all(one.ndim == 1 for one in seen):
        return torch.stack(seen)[:, None, None, :]
    return torch.stack([one.expand(cameras.height, cameras.width, 3) for one in seen])
