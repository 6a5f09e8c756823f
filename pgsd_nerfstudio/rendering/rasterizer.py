"""What every rasterizer here promises: clips of Gaussians through cameras, differentiable in the dynamic ones.

Conventions are those of gsplat 1.4.0, rasterize_mode "classic", tile size 16 (Ye et al., "gsplat: An Open-Source Library for
Gaussian Splatting", 2024). A Gaussian colours a pixel only if the square of three standard deviations around it touches the
pixel's tile, so the tile size is part of the picture and not only of the speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.moment import Moments
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

TILE = 16
"""Side of a tile in pixels; gsplat's default, and the width of one vector row in the CPU kernels."""

Dynamic: TypeAlias = Gaussians | Sequence[Gaussians] | None
"""One set for each camera, one for all, or none. Scene units; plain RGB or spherical harmonics."""


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """Numbers that decide what a Gaussian looks like on the image plane; the defaults are gsplat 1.4.0's."""

    blur: float = 0.3
    """Pixels squared added to both projected variances, so that no Gaussian is thinner than a pixel (gsplat: eps2d)."""
    near: float = 0.01
    """Scene units; what lies closer to the camera plane is not drawn, its projection would explode."""
    far: float = 1e10
    """Scene units; beyond is not drawn. Far enough to mean never."""
    footprint: Literal["square", "rectangle"] = "square"
    """Which tiles a Gaussian enters. square: those that the square around its longer axis touches, `radius_sigmas` standard
    deviations to each side (gsplat 1.4). rectangle: those of its bounding box, cut where alpha falls below `min_alpha` if that
    is nearer (from gsplat 1.5 on; Radl et al., "StopThePop", 2024, section B.2)."""
    radius_sigmas: float = 3.0
    """Half side of the footprint in standard deviations; gsplat 3.0 with squares, 3.33 with rectangles."""
    frustum_margin: float = 0.3
    """The projection is linearised no further outside the image than this fraction of its half extent, else it diverges."""
    min_alpha: float = 1.0 / 255.0
    """Contributions below one step of an 8 bit image are skipped: most of the pixels under a Gaussian's tail."""
    max_alpha: float = 0.999
    """No single Gaussian is fully opaque, so that what lies behind keeps a gradient."""
    min_transmittance: float = 1e-4
    """A pixel is finished before the Gaussian that would let less light than this through."""

    @staticmethod
    def of_gsplat(version: str) -> RasterConfig:
        """What a release of gsplat does, by its version ("1.4.0", "1.5.3"), or "main" for what came after 1.5.

        Raises:
            ValueError: the conventions of that version are not known.
        """
        for prefix, config in _GSPLAT.items():
            if version == prefix or version.startswith(prefix + "."):
                return config
        raise ValueError(f"the conventions of gsplat {version} are not known; known are those of {', '.join(_GSPLAT)}")


# Read in the sources: Projection*.cu for the footprints, Rasterization*.cu and Common.h for the alphas.
_GSPLAT = {
    "1.4": RasterConfig(),
    "1.5": RasterConfig(footprint="rectangle", radius_sigmas=3.33),
    "main": RasterConfig(footprint="rectangle", radius_sigmas=3.33, max_alpha=0.99),
}


class Rendering(NamedTuple):
    """A rendered clip."""

    rgb: Float[Tensor, "t h w 3"]
    """Composited over the background; not clamped to 1."""
    depth: Float[Tensor, "t h w"]
    """Expected depth of a hit along the camera's z axis in scene units (gsplat "ED"); 0 where nothing is."""
    accumulation: Float[Tensor, "t h w"]
    """Share of the light that comes from Gaussians, 0..1."""


@runtime_checkable
class Rasterizer(Protocol):
    """Renders one frozen scene, and with it what moves."""

    frozen: Gaussians

    @property
    def memory(self) -> str:
        """What is kept of the frozen scene for the cameras seen so far, in words."""
        ...

    def render(
        self,
        cameras: Cameras,
        dynamic: Dynamic = None,
        background: Float[Tensor, "3"] | None = None,
        moments: Moments = None,
    ) -> Rendering:
        """The frozen scene merged by depth with the dynamic Gaussians, over the background (black if None).

        `moments` say how the weather changes the frozen scene, the light on its way and the background.
        Differentiable in all tensors of the dynamic Gaussians and in the background, not in the frozen scene or cameras.

        Raises:
            ValueError: the number of sets or moments is not that of the cameras, or a value is not finite; the message names
                which.
        """
        ...


def dynamic_per_frame(dynamic: Dynamic, frames: int) -> list[Gaussians | None]:
    """The dynamic set of each frame; None where there is none or it is empty.

    Raises:
        ValueError: as for `Rasterizer.render`.
    """
    if dynamic is None:
        return [None] * frames
    if isinstance(dynamic, Gaussians):
        dynamic.check_finite()
        return [dynamic if len(dynamic) else None] * frames
    if len(dynamic) != frames:
        raise ValueError(
            f"expected one dynamic set for each of the {frames} cameras, found {len(dynamic)}; one Gaussians serves all"
        )
    for one in dynamic:
        one.check_finite()
    return [one if len(one) else None for one in dynamic]


def composite(
    color: Float[Tensor, "*s h w 3"],  # sum of weights times colours
    weighted_depth: Float[Tensor, "*s h w"],  # sum of weights times depths
    accumulation: Float[Tensor, "*s h w"],  # sum of weights
    background: Tensor | None,  # [3], or as `moment.backgrounds`
) -> Rendering:
    """Background and expected depth from the sums along the rays."""
    if background is not None:
        color = color + (1.0 - accumulation)[..., None] * background.to(color)
    return Rendering(color, weighted_depth / accumulation.clamp_min(1e-10), accumulation)
