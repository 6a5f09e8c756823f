"""Rays from points of a surface: which rays the mesh blocks, and how much of the sky a point sees."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

LIFT = (0.004, 0.03)  # m; rays start 0.3 median edges above the surface, within these bounds
GOLDEN = math.pi * (3 - math.sqrt(5))  # the golden angle in radians


def ray_starts(points: Tensor, normals: Tensor, surface: SurfaceMesh) -> Float[Tensor, "n 3"]:
    """Starts of rays: slightly above the surface for points on it or below it, else the points themselves.

    Args:
        points: [n, 3] in metres.
        normals: [n, 3] unit, towards the open side.
        surface: the mesh in metres.
    """
    points, normals = points.detach().float().cpu(), normals.detach().float().cpu()
    if len(surface.triangles) == 0:
        return points
    corners = surface.vertices[surface.triangles.long()]
    lift = 0.3 * float((corners[:, 0] - corners[:, 1]).norm(dim=1).median())
    lift = min(max(lift, LIFT[0]), LIFT[1])
    closest = surface.closest(points)
    # Leaves are open on both sides, so the point's own normal tells the side.
    turned = (closest.normals * normals).sum(1, keepdim=True) < -0.5
    out = torch.where(turned, -closest.normals, closest.normals)
    height = ((points - closest.points) * out).sum(1)
    return torch.where((height < lift)[:, None], closest.points + lift * out, points)


def open_cosines(
    starts: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh, directions: Float[Tensor, "d 3"]
) -> Float[Tensor, "n d"]:
    """Cosines between normals and directions; 0 if the normal faces away or the mesh blocks the ray.

    Args:
        starts: of the rays, in metres.
        normals: unit normals at the starts.
        surface: the mesh in metres.
        directions: unit directions of the rays.
    """
    cosines = (normals @ directions.T).clamp_min(0.0)
    for k, direction in enumerate(directions):
        facing = torch.nonzero(cosines[:, k])[:, 0]
        cosines[facing[blocked(surface, starts[facing], direction.expand(len(facing), 3))], k] = 0.0
    return cosines


def open_sky(
    starts: Tensor, normals: Tensor, surface: SurfaceMesh, rays: int, generator: torch.Generator
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Open share of the sky at points. All points have the same rays about their normal, turned by a random angle.

    Args:
        starts: [n, 3] of the rays, in metres.
        normals: [n, 3] unit normals at the starts.
        surface: the mesh in metres.
        rays: number of rays per point.
        generator: source of the angles.

    Returns:
        The open share of the cosine-weighted hemisphere, 0..1, and the mean over all rays of the open directions.
    """
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
    """Whether the mesh blocks each ray, as [n] bool, for origins [n, 3] in metres and directions [n, 3]."""
    if len(surface.triangles) == 0 or len(origins) == 0:
        return torch.zeros(len(origins), dtype=torch.bool)
    return torch.from_numpy(surface.raycasting.test_occlusions(queries(origins, directions)).numpy())


def frames(normals: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors perpendicular to each unit normal and to each other."""
    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    side = normalize(torch.linalg.cross(helper, normals), dim=1)
    return side, torch.linalg.cross(normals, side)


def cosine_directions(count: int) -> Float[Tensor, "k 3"]:
    """Unit directions about +z whose density is proportional to the cosine; x and y fill a disc evenly (Vogel's spiral)."""
    k = torch.arange(count) + 0.5
    radius = (k / count).sqrt()
    return torch.stack([radius * (GOLDEN * k).cos(), radius * (GOLDEN * k).sin(), (1 - radius**2).sqrt()], dim=1)
