"""The exposure of each frozen Gaussian: the falling mass that reaches it, and the share of the sky that it sees.

Rays against the motion of the particles find the sheltered Gaussians. The mass that a surface catches is the flux density times
the cosine to its normal, relative to the catch of an open horizontal surface (as for wind-driven rain: Blocken & Carmeliet, "A
review of wind-driven rain research in building science", 2004, section 2). The share of the sky is the cosine-weighted share of
the hemisphere about the normal that is open (ambient visibility).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.laws.populations import fall_speed, number_density
from pgsd_nerfstudio.response.rays import blocked, open_sky
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

RAYS = 24  # per Gaussian for mass, and as many for the sky; their noise of a tenth is less than the difference of neighbours
NEAR = 0.08  # m; a Gaussian this close to the surface is part of it
SUNK = 0.5  # m; Gaussians this far below a surface still belong to it, since those above let light through
OFF = 0.03  # m; rays start this far off the surface, since captures are rough by as much
LOOSE_CATCH = 0.4  # mass that blades and branches catch; on average they turn half of their area to the sky
LOOSE_MOST = 0.7  # share of them that a cover can hide, unless they are level
LEAF, FAR_LEAF = 0.03, 0.012  # m, and share of the distance to a camera: a larger loose Gaussian is many leaves in a haze
UPRIGHT = 0.45, 0.75  # height of a Gaussian relative to its length from which less of it, and none, holds a cover
TALL = 0.02  # m; standard deviation along z below which a Gaussian is not upright, whatever its form
LEVEL = 0.9  # level from which a Gaussian counts as part of a smooth surface
UNEVEN = 0.3  # level of a Gaussian that is not flat
FLAT = 0.5  # ratio of the thinnest to the middle axis below which a Gaussian is flat and has a normal


@dataclass(frozen=True)
class Exposure:
    """The exposure of N Gaussians to an effect."""

    normals: Float[Tensor, "n 3"]
    """Unit normals in the metric frame. A flat Gaussian has its own normal, turned to the open side of the surface; the others
    have that of the surface, or point up if they are away from it."""
    loose: Bool[Tensor, " n"]
    """Whether a Gaussian is away from the mesh: foliage, branches, the far background."""
    catches: Float[Tensor, " n"]
    """Mass that a Gaussian catches relative to an open horizontal area of the same size."""
    level: Float[Tensor, " n"]
    """Squared cosine between the plane of a Gaussian and the surface, 0..1: wet paving mirrors, blades of grass do not."""
    sky: Float[Tensor, " n"]
    """Share of the sky that a Gaussian sees, weighted by the cosine; 1 for an open horizontal surface."""

    @staticmethod
    def of(metric: Gaussians, surface: SurfaceMesh, effect: Effect, *, seed: int = 0) -> Exposure:
        """The exposure of Gaussians.

        Args:
            metric: the frozen Gaussians in metres.
            surface: the mesh that shelters them, in metres.
            effect: its emission, material and wind give the directions of the particles.
            seed: of the rays.
        """
        generator = torch.Generator().manual_seed(seed)
        starts, normals, loose, level = _ground(metric, surface)
        flat = _own_normals(metric)[1]
        ways, fluxes = arrivals(effect, RAYS, generator)
        catches = torch.zeros(len(metric))
        for way, flux in zip(ways, fluxes, strict=True):
            # A leaf or a far roof catches with either side; what is not flat turns every way.
            away = torch.where(flat, (normals @ way).abs(), LOOSE_CATCH * way.norm())
            facing = torch.where(loose, away, -(normals @ way).clamp_max(0.0))
            asked = (facing > 0).nonzero()[:, 0]
            facing[asked[blocked(surface, starts[asked], (-way / way.norm()).expand(len(asked), 3))]] = 0.0
            catches += flux * facing
        sky, _ = open_sky(starts, normals, surface, RAYS, generator)
        return Exposure(normals, loose, catches, level, sky)


def most_hidden(metric: Gaussians, exposure: Exposure, centers: Float[Tensor, "c 3"] | None = None) -> Float[Tensor, " n"]:
    """Greatest share of each Gaussian that a cover can hide, by its form.

    Upright Gaussians show the sides of posts and walls, which stay bare. A large loose Gaussian stands for many leaves, and as
    one white cloud it would look like steam.

    Args:
        metric: the frozen Gaussians in metres.
        exposure: of these Gaussians.
        centers: of the cameras in metres; None: all leaves are near.
    """
    axes = rotations.unitquat_to_rotmat(rotations.quat_wxyz_to_xyzw(torch.nn.functional.normalize(metric.quats, dim=1)))
    height = (axes[:, 2] * metric.scales).norm(dim=1)
    low, high = UPRIGHT
    upright = ((height / metric.scales.amax(1) - low) / (high - low)).clamp(0, 1) * (height > TALL)
    level = exposure.normals[:, 2].clamp(0, 1) ** 4 * _own_normals(metric)[1]
    leaf = torch.full_like(height, LEAF)
    if centers is not None:
        apart, _ = KDTree(centers.numpy(force=True)).query(metric.means.numpy(force=True))
        leaf = torch.maximum(leaf, FAR_LEAF * torch.from_numpy(apart).to(leaf))
    leaves = (leaf / metric.scales.median(1).values).clamp_max(1.0)
    loose = LOOSE_MOST * leaves + (1 - LOOSE_MOST * leaves) * level
    return torch.where(exposure.loose, loose, 1 - upright)


def arrivals(effect: Effect, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "r 3"], Float[Tensor, " r"]]:
    """Velocities with which the mass of an effect arrives at surfaces.

    The velocities are drawn by the flux of mass through a horizontal area, with the mean wind at its reference height, gusts
    and turbulence.

    Args:
        effect: its emission, material and wind are read.
        count: number of velocities.
        generator: source of the draws.

    Returns:
        Velocities in m/s, and for each its share divided by the fall speed, in s/m. With both, sum(share * -velocity . n) is
        the mass caught by a surface of normal n relative to a horizontal one.
    """
    emission, wind = effect.emission, effect.wind
    diameters = np.geomspace(emission.smallest, emission.largest, 128)
    speeds = fall_speed(diameters, effect.material)
    density = number_density(diameters, emission, effect.material) * speeds * effect.material.mass(diameters)
    weights = np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(diameters))
    at = (torch.arange(count) + torch.rand(count, generator=generator)).numpy() / count * weights[-1]
    falling = torch.from_numpy(np.interp(at, np.concatenate([[0.0], weights]), speeds)).float()
    along = math.radians(wind.direction_degrees)
    gusts = wind.speed * (1 + wind.gustiness * torch.randn(count, generator=generator))
    velocities = wind.turbulence * torch.randn(count, 3, generator=generator)
    velocities[:, 2] = -falling  # eddies move as much mass up as down
    velocities[:, 0] += gusts * math.cos(along)
    velocities[:, 1] += gusts * math.sin(along)
    return velocities, 1 / (count * falling)


def _ground(
    metric: Gaussians, surface: SurfaceMesh
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Bool[Tensor, " n"], Float[Tensor, " n"]]:
    """The start of the rays of each Gaussian, its normal, whether it is loose, and its level."""
    up = torch.tensor([0.0, 0.0, 1.0])
    found = surface.closest(metric.means)
    sunk, buried, above = _beneath(metric.means, surface)
    loose = ~(found.distance < NEAR) & ~sunk & ~buried
    own, flat = _own_normals(metric)
    apart = torch.where(flat[:, None], own, up)
    normals = torch.where(loose[:, None], apart, torch.where(buried[:, None], up, found.normals))
    starts = torch.where(loose[:, None], metric.means + OFF * up, found.points + OFF * found.normals)
    starts = torch.where(buried[:, None], above + OFF * up, starts)
    cosine = (own * normals).sum(1)
    level = torch.where(loose | ~flat, UNEVEN, cosine.square())
    # The mesh of a capture is rough by its voxels; the normals of level Gaussians are more exact.
    turned = own * torch.where(cosine < 0, -1.0, 1.0)[:, None]
    return starts, torch.where((level > LEVEL)[:, None], turned, normals), loose, level


def _beneath(
    points: Float[Tensor, "n 3"], surface: SurfaceMesh
) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Which points are shortly below the back of the surface, where a Gaussian fills what a camera sees as the surface.

    Returns:
        Those points; the points that are farther below the ground, which is a surface with nothing below it: the Gaussians
        there shine through it and are seen as a part of it, while those under a table are not part of the table; and the place
        of the surface above each point.
    """
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
    hits = surface.cast(points, up)
    under = torch.isfinite(hits.distance) & (hits.normal[:, 2] > 0)
    sunk = under & (hits.distance < SUNK)
    buried = under & ~sunk & torch.isinf(surface.cast(points, -up).distance)
    return sunk, buried, points + torch.where(under, hits.distance, 0.0)[:, None] * up


def _own_normals(metric: Gaussians) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
    """The direction of each Gaussian's thinnest axis, turned upwards, and whether it is flat."""
    order = metric.scales.sort(dim=1)
    axes = rotations.unitquat_to_rotmat(rotations.quat_wxyz_to_xyzw(torch.nn.functional.normalize(metric.quats, dim=1)))
    own = axes.gather(2, order.indices[:, :1, None].expand(-1, 3, 1))[:, :, 0]
    return own * torch.where(own[:, 2:] < 0, -1.0, 1.0), order.values[:, 0] < FLAT * order.values[:, 1]
