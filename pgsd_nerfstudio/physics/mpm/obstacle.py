"""Obstacles as signed distance, outward normal and friction in space.

Obstacles stand still and feel no force. An obstacle has parts, which act one after the other: in the edge between floor and
wall, matter may move into neither. A plate must be at least two grid cells thick: the sides of a thinner one share nodes, or
lie between them, and fast matter passes. A plate that is known to be thinner is refused; `grown` makes it thicker.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.physics.mpm.layout import CELLS, EDGE, MARGIN, STICKS, WALL

Point = tuple[float, float, float]
Sampler = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Part:
    """One body of an obstacle."""

    sample: Sampler
    """Takes points [n, 3] in metres to distances [n] (negative inside), outward unit normals [n, 3] and frictions [n]."""
    thickness: float = math.inf
    """Thickness of the thinnest plate in metres, as far as it is known."""


@dataclass(frozen=True)
class Obstacle:
    """A solid body; made by `plane`, `box`, `room` or `from_grid`, and joined with `|`.

    Friction is Coulomb's coefficient; infinity sticks: matter at such a surface neither slides nor leaves.
    """

    parts: tuple[Part, ...]

    def __or__(self, other: Obstacle) -> Obstacle:
        return Obstacle(self.parts + other.parts)

    def distance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Signed distance to the nearest part, in metres."""
        return torch.stack([part.sample(points)[0] for part in self.parts]).amin(0)

    def freed(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points that lie inside, moved onto the surface."""
        for part in self.parts:
            distance, normal, _ = part.sample(points)
            points = torch.where((distance < 0)[:, None], points - distance[:, None] * normal, points)
        return points

    def grown(self, by: float) -> Obstacle:
        """The obstacle with its surface moved outwards by `by` metres: sheets become plates twice as thick as that.

        Raises:
            ValueError: `by` is negative or not finite.
        """
        if not 0 <= by < math.inf:
            raise ValueError(f"an obstacle grows by a finite length of 0 or more, got {by:g} m")

        def larger(part: Part) -> Part:
            def sample(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
                distance, normal, friction = part.sample(points)
                return distance - by, normal, friction

            return Part(sample, part.thickness + 2 * by)

        return Obstacle(tuple(larger(part) for part in self.parts))

    def require_thick(self, dx: float) -> None:
        """Check that the sides of every plate lie apart on a grid.

        Raises:
            ValueError: a plate is thinner than two cells.
        """
        thinnest = min((part.thickness for part in self.parts), default=math.inf)
        if thinnest < 2 * dx * (1 - 1e-6):
            raise ValueError(
                f"an obstacle must be two cells thick, here {2 * dx:g} m, or fast matter passes through it; its thinnest plate "
                f"has {thinnest:g} m: use dx <= {thinnest / 2:g} m, or Obstacle.grown({dx - thinnest / 2:g})"
            )

    def at_nodes(self, blocks: tuple[int, int, int], lower: Point, dx: float) -> Float[Tensor, "nodes columns"]:
        """Values of every part at the nodes of a grid of blocks, in the order of its rows: the columns that `layout` names."""
        if not self.parts:
            return torch.zeros(1, WALL)
        _, by, bz = blocks
        nodes = math.prod(blocks) * CELLS
        wall = torch.empty(nodes, len(self.parts) * WALL, dtype=torch.float64)
        for first in range(0, nodes, 2**20):
            row = torch.arange(first, min(first + 2**20, nodes))
            block, cell = row // CELLS, row % CELLS
            node = torch.stack([block // (by * bz), block // bz % by, block % bz], 1) * EDGE - MARGIN
            node = node + torch.stack([cell // EDGE**2, cell // EDGE % EDGE, cell % EDGE], 1)
            points = torch.tensor(lower, dtype=torch.float64) + node.double() * dx
            for i, part in enumerate(self.parts):
                distance, normal, friction = part.sample(points)
                # A node on the surface counts as on it, whatever rounding says.
                distance = torch.where(distance.abs() < 1e-6 * dx, 0.0, distance)
                columns = [distance[:, None], normal, friction.clamp(max=STICKS)[:, None]]
                wall[first : first + len(row), i * WALL : (i + 1) * WALL - 1] = torch.cat(columns, 1)
        for i in range(len(self.parts)):
            wall[:, (i + 1) * WALL - 1] = _least_in_cell(wall[:, i * WALL], blocks)
        return wall

    @staticmethod
    def plane(point: Point, normal: Point, friction: float = 0.5) -> Obstacle:
        """Everything below a plane through `point`."""

        def distance(points: Tensor) -> tuple[Tensor, Tensor]:
            up = torch.nn.functional.normalize(points.new_tensor(normal), dim=0)
            return (points - points.new_tensor(point)) @ up, up.expand_as(points)

        return _uniform(distance, friction)

    @staticmethod
    def box(lower: Point, upper: Point, friction: float = 0.5) -> Obstacle:
        """A solid block."""

        def distance(points: Tensor) -> tuple[Tensor, Tensor]:
            low, high = points.new_tensor(lower), points.new_tensor(upper)
            middle = (low + high) / 2
            beyond = (points - middle).abs() - (high - low) / 2
            side = torch.where(points < middle, -1.0, 1.0).to(points)
            outside = beyond.clamp_min(0)
            apart = outside.norm(dim=1)
            face = torch.nn.functional.one_hot(beyond.argmax(1), 3).to(points)
            normal = torch.where((apart > 0)[:, None], outside / apart.clamp_min(1e-30)[:, None], face) * side
            return torch.where(apart > 0, apart, beyond.amax(1)), normal

        return _uniform(distance, friction, min(b - a for a, b in zip(lower, upper, strict=True)))

    @staticmethod
    def room(lower: Point, upper: Point, friction: float = 0.5) -> Obstacle:
        """Everything outside a box: floor, walls and ceiling."""

        def pair(axis: int) -> Obstacle:
            def distance(points: Tensor) -> tuple[Tensor, Tensor]:
                below, above = points[:, axis] - lower[axis], upper[axis] - points[:, axis]
                normal = torch.zeros_like(points)
                normal[:, axis] = torch.where(below < above, 1.0, -1.0).to(points)
                return torch.minimum(below, above), normal

            return _uniform(distance, friction)

        return pair(0) | pair(1) | pair(2)

    @staticmethod
    def from_grid(
        distance: Float[Tensor, "x y z"],
        normal: Float[Tensor, "x y z 3"],
        lower: Point,
        spacing: float,
        friction: float = 0.5,
        thickness: float = math.inf,
    ) -> Obstacle:
        """Signed distance in metres and outward normals on a grid; node (0, 0, 0) lies at `lower`. Outside it nothing stands.

        Args:
            thickness: of the thinnest plate that must hold, in metres. It cannot be read off a grid, where every edge is thin.
                A sheet whose distance is positive on both sides has 0, and holds nothing unless it is `grown`.

        Raises:
            ValueError: the arrays do not fit together or hold something that is not finite.
        """
        distance, normal = torch.as_tensor(distance).cpu(), torch.as_tensor(normal).cpu()
        if normal.shape != (*distance.shape, 3) or distance.ndim != 3 or min(distance.shape) < 2:
            raise ValueError(
                f"a signed distance on a grid needs shapes [x, y, z] and [x, y, z, 3] with two nodes or more on each axis, got "
                f"{list(distance.shape)} and {list(normal.shape)}"
            )
        for name, values in (("signed distance", distance), ("normals", normal)):
            if not values.isfinite().all():
                raise ValueError(f"the obstacle's {name} must be finite, but {int((~values.isfinite()).sum())} values are not")
        both = torch.cat([distance[..., None], normal], 3).permute(3, 2, 1, 0)[None]  # grid_sample takes z, y, x

        def interpolated(points: Tensor) -> tuple[Tensor, Tensor]:
            last = points.new_tensor([n - 1 for n in distance.shape])
            at = (points - points.new_tensor(lower)) / spacing / last * 2 - 1
            values = torch.nn.functional.grid_sample(
                both.to(points), at[None, :, None, None], align_corners=True, padding_mode="border"
            )[0, :, :, 0, 0].T
            outside = (at.abs() > 1 + 1e-6).any(1)
            away = torch.where(outside, values[:, 0].abs().clamp_min(spacing), values[:, 0])
            return away, torch.nn.functional.normalize(values[:, 1:], dim=1)

        return _uniform(interpolated, friction, thickness)


def _least_in_cell(distance: Float[Tensor, " nodes"], blocks: tuple[int, int, int]) -> Float[Tensor, " nodes"]:
    """The least of a cell's eight nodes, at the lowest of them: where it is positive, no point of the cell lies inside."""
    bx, by, bz = blocks
    dense = distance.reshape(bx, by, bz, EDGE, EDGE, EDGE).permute(0, 3, 1, 4, 2, 5).reshape(bx * EDGE, by * EDGE, bz * EDGE)
    beyond = torch.nn.functional.pad(dense[None, None], (0, 1, 0, 1, 0, 1), mode="replicate")
    least = -torch.nn.functional.max_pool3d(-beyond, 2, stride=1)[0, 0]
    return least.reshape(bx, EDGE, by, EDGE, bz, EDGE).permute(0, 2, 4, 1, 3, 5).reshape(-1)


def _uniform(distance: Callable[[Tensor], tuple[Tensor, Tensor]], friction: float, thickness: float = math.inf) -> Obstacle:
    if not friction >= 0:
        raise ValueError(f"an obstacle's friction must not be negative, got {friction:g}")

    def sample(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gap, normal = distance(points)
        return gap, normal, torch.full_like(gap, friction)

    return Obstacle((Part(sample, thickness),))
