"""Light on its way through the air to the camera: fog, dust, falling rain and snow absorb it and add airlight.

Along a ray, light of colour c from distance d arrives as c T + A (1 - T), T = exp(-optical depth), A the airlight (Koschmieder
1924; Beer-Lambert), all in linear light. For splats the colour of each Gaussian is changed for the way from its centre to the
camera, and the Gaussians are blended afterwards. Every rasterizer can show it and none needs to know of it. Splats blend
display values, as they were trained; where Gaussians of one pixel differ by a factor of two in linear light, what their blend
shows is up to 3 % darker than the blend of their light.

A medium that differs from place to place is sampled once for each camera in froxels (Wronski, "Volumetric fog", SIGGRAPH
2014): along a fan of rays, in slices that grow with distance. The optical depth of a Gaussian is interpolated between the rays,
so the cost hardly depends on the number of Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pgsd_nerfstudio.rendering.display import encoded, linear

Extinction: TypeAlias = Callable[[Float[Tensor, "n 3"]], Float[Tensor, " n"]]
"""From points in scene units to the extinction per scene unit."""

Lengths: TypeAlias = Callable[[Float[Tensor, " n"]], Float[Tensor, " n"]]
"""From distances to the camera to the lengths of full air that lie before them, both in scene units."""

CLOSEST = 2.0  # pixels between rays, at least; small pictures do not show more
BEYOND = 100.0  # the air of the last slice goes on to so many times the distance of its end


@dataclass(frozen=True, kw_only=True)
class Froxels:
    """Resolution of the samples of the air in front of a camera. Lengths are in scene units.

    In patches of 8 m to 0.5 m whose density deviates by half, the optical depth is off by 2 % (root mean square), and the light
    that arrives by less than 4 % everywhere.
    """

    nearest: float = 0.4
    """Thickness of the slice at the camera; each slice is thicker than the one before by the same factor."""
    farthest: float = 400.0
    """Distance at which the last slice ends; the air beyond is as in the last slice."""
    slices: int = 64
    """Number of slices along a ray."""
    rays: int = 44
    """Number of rays across the wider side of the image, whatever its size, since the distance between rays in the air counts.
    An image of 512 pixels has one ray in 12 pixels; small images have fewer rays, one in 2 pixels."""
    margin: float = 0.3
    """How far the fan of rays reaches beyond each side of the image, in halves of the image; still farther out the values of
    its edge are used. The margin is where rasterizers stop projecting without distortion: of Gaussians beyond, only wide tails
    come into view."""

    def __post_init__(self) -> None:
        if not 0 < self.nearest * self.slices < self.farthest:
            raise ValueError(
                f"slices that grow from {self.nearest:g} must reach farther than {self.slices} even ones, "
                f"{self.nearest * self.slices:g} scene units; found {self.farthest:g}"
            )

    @cached_property
    def growth(self) -> float:
        """Logarithm of the factor from slice to slice."""
        ratio = self.farthest / self.nearest

        def excess(growth: float) -> float:
            return math.log(math.expm1(growth * self.slices) / math.expm1(growth) / ratio)

        from scipy.optimize import root_scalar  # a third of a second to import, and most air is even

        return float(root_scalar(excess, bracket=(1e-9, 600 / self.slices)).root)

    def edges(self, like: Tensor) -> Float[Tensor, " {self.slices}+2"]:
        """Distances from the camera at which slices begin, then those at which the last slice and the air beyond it end."""
        within = self.nearest / math.expm1(self.growth) * torch.expm1(self.growth * torch.arange(self.slices + 1).to(like))
        return torch.cat([within, BEYOND * within[-1:]])

    def slots(self, distances: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Positions of distances among the edges, linear within each slice, so that even air is sampled exactly."""
        at = torch.log1p(distances * (math.expm1(self.growth) / self.nearest)) / self.growth
        whole = at.detach().floor()
        within = whole + torch.expm1(self.growth * (at - whole)) / math.expm1(self.growth)
        beyond = (distances / self.farthest - 1.0) / (BEYOND - 1.0)
        return torch.where(at < self.slices, within, self.slices + beyond.clamp(0.0, 1.0))


class Medium:
    """The air of one moment; it knows nothing of weather. Several threads may use it."""

    def __init__(
        self,
        airlight: Float[Tensor, "3"],
        extinction: Extinction | float,
        froxels: Froxels | None = None,
        lengths: Lengths | None = None,
    ) -> None:
        """Keep the numbers; nothing is sampled before the first camera.

        Args:
            airlight: colour that the air adds, sRGB.
            extinction: per scene unit; a number stands for air that is the same everywhere, which needs no froxels and is
                exact.
            froxels: resolution of the samples.
            lengths: how much of the air before each distance counts; None: all of it.

        Raises:
            ValueError: a number is negative or not finite.
        """
        if not callable(extinction) and not 0 <= extinction < math.inf:
            raise ValueError(f"an extinction per scene unit must be finite and not negative, found {extinction}")
        self.airlight = airlight
        self.extinction = extinction
        self.froxels = froxels or Froxels()
        self.lengths = lengths
        self._sampled: tuple[tuple[Tensor, Tensor, int, int], Tensor] | None = None

    def through(
        self,
        rgb: Float[Tensor, "n 3"],
        means: Float[Tensor, "n 3"],
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        width: int,
        height: int,
    ) -> Float[Tensor, "n 3"]:
        """Colours as they arrive at the camera; differentiable in `rgb` and `means`.

        Args:
            rgb: sRGB colours as they leave.
            means: points that they leave from, in scene units.
            viewmat: world to camera.
            K: intrinsics in pixels.
            width: of the image in pixels.
            height: of the image in pixels.
        """
        return self._mixed(rgb, self.optical_depth(means, viewmat, K, width, height)[:, None])

    def behind(
        self,
        background: Float[Tensor, "3"] | None,
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        width: int,
        height: int,
        far: float,
    ) -> Tensor:
        """A background as it arrives at the camera: [3] if the air is the same everywhere, else [h, w, 3].

        Args:
            background: sRGB of the background; None is black.
            viewmat: world to camera.
            K: intrinsics in pixels.
            width: of the image in pixels.
            height: of the image in pixels.
            far: distance of the background in scene units.

        Raises:
            ValueError: `far` is not a positive number of scene units.
        """
        if not 0 < far < math.inf:
            raise ValueError(f"the background must lie at a positive, finite distance, found {far} scene units")
        own = torch.zeros(3).to(viewmat) if background is None else background
        if not callable(self.extinction):
            length = self._length(torch.tensor([far]).to(own))
            return self._mixed(own, self.extinction * length)
        depths = self._depths(viewmat, K, width, height)
        slot = float(self.froxels.slots(torch.tensor([far], dtype=torch.float64)))
        here = min(int(slot), len(depths) - 2)
        layer = torch.lerp(depths[here], depths[here + 1], slot - here)
        x, y = (0.5 + torch.arange(side).to(depths) for side in (width, height))
        at = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        read = grid_sample(layer[None, None], self._across(at, width, height)[None], "bilinear", "border", align_corners=True)
        return self._mixed(own, read[0, 0, :, :, None].to(own))

    def optical_depth(
        self,
        means: Float[Tensor, "n 3"],
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        width: int,
        height: int,
    ) -> Float[Tensor, " n"]:
        """The integral of the extinction from the camera's centre to each point; T is exp of minus it.

        Args:
            means: points in scene units.
            viewmat: world to camera.
            K: intrinsics in pixels.
            width: of the image in pixels.
            height: of the image in pixels.
        """
        viewmat, K = viewmat.to(means), K.to(means)
        points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        distances = points.norm(dim=1)
        if not callable(self.extinction):
            return self.extinction * self._length(distances)
        depths = self._depths(viewmat, K, width, height)
        # Points beside or behind the camera are not drawn; they only must not divide by zero.
        pixels = points[:, :2] / points[:, 2:].clamp_min(1e-6) * K.diagonal()[:2] + K[:2, 2]
        along = 2.0 * self.froxels.slots(distances) / (len(depths) - 1) - 1.0
        at = torch.cat([self._across(pixels, width, height), along[:, None]], dim=1)
        read = grid_sample(depths[None, None], at[None, :, None, None, :], "bilinear", "border", align_corners=True)
        return read[0, 0, :, 0, 0]

    def _length(self, distances: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return distances if self.lengths is None else self.lengths(distances)

    def mixed(self, light: Tensor, depth: Tensor) -> Tensor:
        """Linear light behind air of an optical depth, mixed with the airlight; the shapes broadcast."""
        return light * torch.exp(-depth) - linear(self.airlight.to(light)) * torch.expm1(-depth)

    def _mixed(self, rgb: Tensor, depth: Tensor) -> Tensor:
        return encoded(self.mixed(linear(rgb), depth))

    def _across(self, pixels: Float[Tensor, "*n 2"], width: int, height: int) -> Float[Tensor, "*n 2"]:
        """Positions of pixels in the fan of rays, clamped to -1..1."""
        half = 0.5 * torch.tensor([width, height]).to(pixels)
        return ((pixels / half - 1.0) / (1.0 + self.froxels.margin)).clamp(-1.0, 1.0)

    @torch.no_grad()
    def _depths(
        self, viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int
    ) -> Float[Tensor, "{self.froxels.slices}+2 rows columns"]:
        """Optical depth at the edges of the slices along each ray of the fan; the result for the last view is kept."""
        view = viewmat.detach(), K.detach(), width, height
        kept = self._sampled  # it is read once, since another thread may put its own view there
        if kept is not None and _same(kept[0], view):
            return kept[1]
        rays = self._rays(*view)
        edges = self.froxels.edges(rays)
        middles = 0.5 * (edges[:-2] + edges[1:-1])
        points = _center(view[0]) + middles[:, None, None, None] * rays
        assert callable(self.extinction)
        found = self.extinction(points.view(-1, 3)).view(points.shape[:3])
        slices = torch.cat([torch.zeros_like(found[:1]), found, found[-1:]])
        slices[1:] *= self._length(edges).diff()[:, None, None]
        depths = slices.cumsum(0)
        self._sampled = (view[0].clone(), view[1].clone(), width, height), depths
        return depths

    def _rays(self, viewmat: Tensor, K: Tensor, width: int, height: int) -> Float[Tensor, "rows columns 3"]:
        """Unit vectors of the rays in scene axes, row by row."""
        spacing = max(max(width, height) / self.froxels.rays, CLOSEST)
        reach = 0.5 * (1.0 + self.froxels.margin)
        x, y = (
            (side * (0.5 + torch.linspace(-reach, reach, math.ceil(2 * reach * side / spacing) + 1)).to(K) - center) / focal
            for side, center, focal in zip((width, height), K[:2, 2], K.diagonal()[:2], strict=True)
        )
        flat = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        return normalize(torch.cat([flat, torch.ones_like(flat[..., :1])], dim=-1), dim=-1) @ viewmat[:3, :3]


def _center(viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "3"]:
    return torch.linalg.inv(viewmat.double())[:3, 3].to(viewmat)


def _same(one: tuple[Tensor, Tensor, int, int], other: tuple[Tensor, Tensor, int, int]) -> bool:
    alike = one[2:] == other[2:] and (one[0].dtype, one[0].device) == (other[0].dtype, other[0].device)
    return alike and torch.equal(one[0], other[0]) and torch.equal(one[1], other[1])
