"""Rays from a surface into the open: what is blocked, how much of the sky is seen, which suns shine."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

LIFT = (0.004, 0.03)  # m above the surface where rays start; within this, 0.3 of the median edge
GOLDEN = math.pi * (3 - math.sqrt(5))


def ray_starts(points: Tensor, normals: Tensor, surface: SurfaceMesh) -> Float[Tensor, "n 3"]:
    """Where rays start: a little above the surface for points on it or below, else the points themselves."""
    points, normals = points.detach().float().cpu(), normals.detach().float().cpu()
    if len(surface.triangles) == 0:
        return points
    corners = surface.vertices[surface.triangles.long()]
    lift = 0.3 * float((corners[:, 0] - corners[:, 1]).norm(dim=1).median())
    lift = min(max(lift, LIFT[0]), LIFT[1])
    closest = surface.closest(points)
    # Leaves are open on both sides: there the point's own normal says which.
    turned = (closest.normals * normals).sum(1, keepdim=True) < -0.5
    out = torch.where(turned, -closest.normals, closest.normals)
    height = ((points - closest.points) * out).sum(1)
    return torch.where((height < lift)[:, None], closest.points + lift * out, points)


def open_cosines(
    starts: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh, directions: Float[Tensor, "d 3"]
) -> Float[Tensor, "n d"]:
    """Cosines between normals and directions, zero where they face away or the surface is in the way."""
    cosines = (normals @ directions.T).clamp_min(0.0)
    for k, direction in enumerate(directions):
        facing = torch.nonzero(cosines[:, k])[:, 0]
        cosines[facing[blocked(surface, starts[facing], direction.expand(len(facing), 3))], k] = 0.0
    return cosines


def open_sky(
    starts: Tensor, normals: Tensor, surface: SurfaceMesh, rays: int, generator: torch.Generator
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Open share of the cosine-weighted hemisphere, and its first moment; each point turns the same rays by another angle."""
    side, across = frames(normals)
    turn = 2 * math.pi * torch.rand(len(normals), 1, generator=generator)
    side, across = turn.cos() * side + turn.sin() * across, turn.cos() * across - turn.sin() * side
    seen, moment = torch.zeros(len(normals)), torch.zeros(len(normals), 3)
    for x, y, z in cosine_directions(rays):
        direction = x * side + y * across + z * normals
        free = ((direction[:, 2] > 0) & ~blocked(surface, starts, direction)).float()
        seen += free
        moment += free[:, None] * direction
    return seen / rays, moment / rays


def blocked(surface: SurfaceMesh, origins: Tensor, directions: Tensor) -> Tensor:
    if len(surface.triangles) == 0 or len(origins) == 0:
        return torch.zeros(len(origins), dtype=torch.bool)
    return torch.from_numpy(surface.raycasting.test_occlusions(queries(origins, directions)).numpy())


def frames(normals: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors across each normal."""
    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    side = normalize(torch.linalg.cross(helper, normals), dim=1)
    return side, torch.linalg.cross(normals, side)


def cosine_directions(count: int) -> Float[Tensor, "k 3"]:
    """Directions about +z whose density is proportional to the cosine; x and y spread evenly over the disc (Vogel's spiral)."""
    k = torch.arange(count) + 0.5
    radius = (k / count).sqrt()
    return torch.stack([radius * (GOLDEN * k).cos(), radius * (GOLDEN * k).sin(), (1 - radius**2).sqrt()], dim=1)
