"""How much of what comes down reaches each Gaussian of the frozen scene, and how much of the sky it sees.

Rays against the way that particles come tell what is sheltered; the mass that a surface catches is the flux density times the
cosine to its normal, relative to what an open horizontal surface catches (as for wind-driven rain: Blocken & Carmeliet, "A
review of wind-driven rain research in building science", 2004, section 2). Sky: the cosine-weighted share of the hemisphere
about the normal that is open (ambient visibility).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.laws.populations import fall_speed, number_density
from pgsd_nerfstudio.response.rays import blocked, open_sky
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

RAYS = 24  # per Gaussian and kind; their noise, a tenth, is less than what neighbours differ by
NEAR = 0.08  # m: a Gaussian this close to the surface is part of it
SUNK = 0.5  # m below the ground to which Gaussians still belong to it: light leaks through the ones above
OFF = 0.03  # m off the surface from which rays start: captures are rough by as much
LOOSE_CATCH = 0.4  # leaves, blades and branches turn half of their area to the sky, on average
LOOSE_MOST = 0.7  # share of them that a cover can hide
LEVEL = 0.9  # from which a Gaussian counts as part of a smooth surface
UNEVEN = 0.3  # how level a Gaussian is that has no plane
FLAT = 0.5  # thinnest over middle axis, below which a Gaussian has a normal of its own


@dataclass(frozen=True)
class Exposure:
    """N Gaussians in a weather."""

    normals: Float[Tensor, "n 3"]
    """Unit, metric: a flat Gaussian's own, turned to the surface's open side; else the surface's, and away from it up."""
    loose: Bool[Tensor, " n"]
    """Away from the surface that is known: foliage, branches, the far background."""
    catches: Float[Tensor, " n"]
    """Mass that comes down on it relative to what an open horizontal area of the same size catches."""
    level: Float[Tensor, " n"]
    """How well its own plane lies in the surface, 0..1: paving mirrors when it is wet, blades of grass do not."""
    sky: Float[Tensor, " n"]
    """Share of the sky it sees, weighted by the cosine; 1: an open horizontal surface."""

    @staticmethod
    def of(metric: Gaussians, surface: SurfaceMesh, effect: Effect, *, seed: int = 0) -> Exposure:
        """Of Gaussians in metres, within a surface that shelters."""
        generator = torch.Generator().manual_seed(seed)
        starts, normals, loose, level = _ground(metric, surface)
        ways, fluxes = arrivals(effect, RAYS, generator)
        catches = torch.zeros(len(metric))
        for way, flux in zip(ways, fluxes, strict=True):
            facing = torch.where(loose, LOOSE_CATCH * way.norm(), -(normals @ way).clamp_max(0.0))
            asked = (facing > 0).nonzero()[:, 0]
            facing[asked[blocked(surface, starts[asked], (-way / way.norm()).expand(len(asked), 3))]] = 0.0
            catches += flux * facing
        sky, _ = open_sky(starts, normals, surface, RAYS, generator)
        return Exposure(normals, loose, catches, level, sky)


def arrivals(effect: Effect, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "r 3"], Float[Tensor, " r"]]:
    """Velocities in m/s with which an effect's mass comes down, and the share of each over its fall speed, in s/m.

    With them sum(share * -velocity . n) is the mass caught by a surface of normal n, relative to a horizontal one: the
    velocities are drawn by the flux of mass through a horizontal area, with the mean wind at its reference height, gusts and
    turbulence.
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
    velocities[:, 2] = -falling  # eddies take as much up as down
    velocities[:, 0] += gusts * math.cos(along)
    velocities[:, 1] += gusts * math.sin(along)
    return velocities, 1 / (count * falling)


def _ground(
    metric: Gaussians, surface: SurfaceMesh
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Bool[Tensor, " n"], Float[Tensor, " n"]]:
    """Where rays of each Gaussian start, its normal, whether it is loose, and how level it lies."""
    up = torch.tensor([0.0, 0.0, 1.0])
    found = surface.closest(metric.means)
    loose = ~(found.distance < NEAR) & ~_beneath(metric.means, surface)
    order = metric.scales.sort(dim=1)
    axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(torch.nn.functional.normalize(metric.quats, dim=1)))
    own = axes.gather(2, order.indices[:, :1, None].expand(-1, 3, 1))[:, :, 0]
    own = own * torch.where(own[:, 2:] < 0, -1.0, 1.0)
    flat = order.values[:, 0] < FLAT * order.values[:, 1]
    apart = torch.where(flat[:, None], own, up)
    normals = torch.where(loose[:, None], apart, found.normals)
    starts = torch.where(loose[:, None], metric.means + OFF * up, found.points + OFF * found.normals)
    cosine = (own * normals).sum(1)
    level = torch.where(loose | ~flat, UNEVEN, cosine.square())
    # A captured surface is rough by its voxels; Gaussians that lie in it know its slope better.
    turned = own * torch.where(cosine < 0, -1.0, 1.0)[:, None]
    return starts, torch.where((level > LEVEL)[:, None], turned, normals), loose, level


def _beneath(points: Float[Tensor, "n 3"], surface: SurfaceMesh) -> Bool[Tensor, " n"]:
    """Whether the first thing above a point is the back of a surface: then it fills what a camera sees as that surface."""
    hits = surface.cast(points, torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3))
    return torch.isfinite(hits.distance) & (hits.distance < SUNK) & (hits.normal[:, 2] > 0)
