"""The interface of all rasterizers: they render clips of Gaussians, differentiable in the dynamic ones.

The conventions are those of gsplat 1.4.0, rasterize_mode "classic", tile size 16 (Ye et al., "gsplat: An Open-Source Library
for Gaussian Splatting", 2024). A Gaussian colours a pixel only if the square of three standard deviations around it touches the
pixel's tile, so the tile size changes the picture and not only the speed.
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
"""One set for each camera, one for all, or none; in scene units, with plain RGB or spherical harmonics."""


@dataclass(frozen=True, kw_only=True)
class RasterConfig:
    """Numbers that decide what a Gaussian looks like on the image plane; the defaults are gsplat 1.4.0's."""

    blur: float = 0.3
    """Pixels squared added to both projected variances, so that no Gaussian is thinner than a pixel (gsplat: eps2d)."""
    near: float = 0.01
    """Scene units; Gaussians nearer to the camera plane are not drawn, since their projection would explode."""
    far: float = 1e10
    """Scene units; Gaussians beyond are not drawn. The default is so far that all are drawn."""
    footprint: Literal["square", "rectangle"] = "square"
    """Which tiles a Gaussian enters. square: the tiles that a square touches with `radius_sigmas` standard deviations of the
    longer axis to each side (gsplat 1.4). rectangle: the tiles of the bounding box, which ends where alpha falls below
    `min_alpha` if that is nearer (from gsplat 1.5 on; Radl et al., "StopThePop", 2024, section B.2)."""
    radius_sigmas: float = 3.0
    """Half side of the footprint in standard deviations; gsplat has 3.0 with squares and 3.33 with rectangles."""
    frustum_margin: float = 0.3
    """The projection is linearised no further outside the image than this fraction of its half extent; else it diverges."""
    min_alpha: float = 1.0 / 255.0
    """Smaller contributions are skipped. The default is one step of an 8 bit image, which skips most pixels of a tail."""
    faint_alpha: float = 1e-2 / 255.0
    """The same for Gaussians that are whole: each keeps its light, and this is by how much their alphas are noisy. gsplat knows
    only `min_alpha`, so GsplatRasterizer takes that."""
    max_alpha: float = 0.999
    """Largest alpha of a single Gaussian; none is fully opaque, so that those behind it keep a gradient."""
    min_transmittance: float = 1e-4
    """A pixel is finished before the Gaussian that would let no more light than this through."""

    @staticmethod
    def of_gsplat(version: str) -> RasterConfig:
        """The conventions of a release of gsplat.

        Args:
            version: for example "1.4.0" or "1.5.3", or "main" for the sources after 1.5.

        Raises:
            ValueError: the conventions of that version are not known.
        """
        for prefix, config in _GSPLAT.items():
            if version == prefix or version.startswith(prefix + "."):
                return config
        raise ValueError(f"the conventions of gsplat {version} are not known; known are those of {', '.join(_GSPLAT)}")


# The numbers stand in gsplat's sources: footprints in Projection*.cu, alphas in Rasterization*.cu and Common.h.
_GSPLAT = {
    "1.4": RasterConfig(),
    "1.5": RasterConfig(footprint="rectangle", radius_sigmas=3.33),
    "main": RasterConfig(footprint="rectangle", radius_sigmas=3.33, max_alpha=0.99),
}


class Rendering(NamedTuple):
    """A rendered clip."""

    rgb: Float[Tensor, "t h w 3"]
    """Colours over the background; not clamped to 1."""
    depth: Float[Tensor, "t h w"]
    """Expected depth of a hit along the camera's z axis in scene units (gsplat "ED"); 0 where no Gaussian is seen."""
    accumulation: Float[Tensor, "t h w"]
    """Share of the light that comes from Gaussians, 0..1."""


@runtime_checkable
class Rasterizer(Protocol):
    """Renders one frozen scene, and dynamic Gaussians in it."""

    frozen: Gaussians
    config: RasterConfig

    @property
    def memory(self) -> str:
        """A sentence that says how many views of the frozen scene are kept, and in how much memory."""
        ...

    def render(
        self,
        cameras: Cameras,
        dynamic: Dynamic = None,
        background: Float[Tensor, "3"] | None = None,
        moments: Moments = None,
    ) -> Rendering:
        """Render the frozen scene merged by depth with the dynamic Gaussians.

        The clip is differentiable in all tensors of the dynamic Gaussians and in the background, but not in the frozen scene or
        the cameras.

        Args:
            cameras: one for each frame.
            dynamic: dynamic Gaussians of each frame.
            background: colour behind all Gaussians; None is black.
            moments: how the weather changes the frozen scene, the light on its way and the background.

        Raises:
            ValueError: the number of sets or moments is not that of the cameras, or a value is not finite; the message names
                which.
        """
        ...


def dynamic_per_frame(dynamic: Dynamic, frames: int) -> list[Gaussians | None]:
    """The dynamic set of each frame; None for a frame without one, or with an empty one.

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
    """A rendering from the sums along the rays: it adds the background and divides the depth by its weights."""
    if background is not None:
        color = color + (1.0 - accumulation)[..., None] * background.to(color)
    return Rendering(color, weighted_depth / accumulation.clamp_min(1e-10), accumulation)
