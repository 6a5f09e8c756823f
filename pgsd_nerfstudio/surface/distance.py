"""Signed distance to a surface on a grid, exact near the surface and clamped farther away.

Distances are computed only for lattice points near the surface: the search finds cubes of 8 points that may hold some, then
cubes of 4, 2 and 1. Meshes of captures have holes and triangles that face the wrong way, so the sign does not come from the
normals of the nearest triangle. Rays go from a point to the upper half of the sky. The point is outside if a quarter of them
reach the sky; otherwise it is inside (negative) if most of them cross the surface an odd number of times, as they do below the
ground or within a body, but not below a table top that was seen only from above. A hole changes the count of the rays that pass
through it and not the majority; flipped triangles change no count. Two sheets above each other give the same counts as the two
sides of a slab; there, and only there, the majority of the normals around the point decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import distance_transform_edt, uniform_filter
from torch import Tensor

from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

MAX_POINTS = 100_000_000  # 400 MB
RAYS = 24  # per point whose sign is computed
SKY = 0.25  # a point is outside if at least this share of its rays reach the sky, whatever the others cross
LOWEST = 0.2  # sine of the lowest ray's elevation: flatter ones graze the ground
STRIDE = 3  # beyond the band, signs are computed for one point in so many along each axis; the others copy the nearest
AROUND = 2  # points on each side over which normals are averaged where they decide


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distances on a lattice, positive outside; each point takes four bytes."""

    lower: Float[ndarray, "3"]
    """First lattice point, metres."""
    cell: float
    """Metres between lattice points."""
    band: float
    """Metres from the surface within which distances are exact; farther away they are +band or -band."""
    values: Float[ndarray, "x y z"]
    """Metres."""
    asked: int
    """Number of points whose distance was computed."""

    @staticmethod
    def of(
        surface: SurfaceMesh, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], cell: float, band: int = 3
    ) -> DistanceGrid:
        """Distances to a surface in a box; an empty surface leaves everything outside.

        Args:
            surface: triangles in metres.
            lower: corner of the box in metres, and the first lattice point.
            upper: opposite corner in metres; the last lattice point is there or just beyond.
            cell: metres between lattice points.
            band: cells on each side of the surface.

        Raises:
            ValueError: the box is empty, or the lattice would have more than a hundred million points.
        """
        lower, size = np.asarray(lower, np.float64), np.asarray(upper, np.float64) - np.asarray(lower, np.float64)
        if not ((size > 0).all() and cell > 0 and band >= 1):
            raise ValueError(f"a distance grid needs a box, cell > 0 and band >= 1, got {size} m, {cell:g} m and {band}")
        shape = tuple((np.ceil(size / cell - 1e-6).astype(int) + 1).tolist())
        if math.prod(shape) > MAX_POINTS:
            raise ValueError(f"{shape} points are more than {MAX_POINTS:,}: take cells larger than {cell:g} m or a smaller box")
        reach, values = cell * band, np.full(shape, cell * band, np.float32)
        if len(surface.triangles) == 0:
            return DistanceGrid(lower, cell, reach, values, 0)
        points, distance, asked = _near(surface, lower, shape, cell, reach)
        inside = _sides(surface, lower, cell, points, shape)
        values[tuple(points.T)] = distance
        return DistanceGrid(lower, cell, reach, np.where(inside, -values, values), asked)

    @property
    def upper(self) -> Float[ndarray, "3"]:
        """Last lattice point, metres."""
        return self.lower + self.cell * (np.array(self.values.shape) - 1)

    def sample(self, points: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
        """Distance in metres at points, interpolated between eight lattice points, and its gradient, which points outwards.

        A point beyond the box gets the values of the nearest point of the box. The gradient is short or zero beyond the band.

        Args:
            points: in metres.
        """
        at = ((np.asarray(points, np.float64) - self.lower) / self.cell).clip(0, np.array(self.values.shape) - 1)
        corner = np.minimum(at.astype(np.int64), np.array(self.values.shape) - 2)
        share = at - corner
        value, gradient = np.zeros(len(at)), np.zeros((len(at), 3))
        for offset in np.ndindex(2, 2, 2):
            found = self.values[tuple((corner + offset).T)]
            x, y, z = np.where(offset, share, 1 - share).T
            dx, dy, dz = (2 * side - 1 for side in offset)
            value += x * y * z * found
            gradient += np.stack([dx * y * z, x * dy * z, x * y * dz], 1) * found[:, None]
        return value, gradient / self.cell

    def normals(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Unit normals of the open side at points in the band; zero where the distance has no slope.

        Args:
            points: in metres.
        """
        _, gradient = self.sample(points)
        return gradient / np.linalg.norm(gradient, axis=1, keepdims=True).clip(1e-9)


def _near(
    surface: SurfaceMesh, lower: Float[ndarray, "3"], shape: tuple[int, ...], cell: float, reach: float
) -> tuple[Int[ndarray, "n 3"], Float[ndarray, " n"], int]:
    """Lattice points within `reach` metres of the surface, their distances, and how many distances were computed."""
    scene, asked = surface.raycasting, 0
    edge = 8
    cubes = np.stack(np.meshgrid(*[np.arange(0, count, edge) for count in shape], indexing="ij"), -1).reshape(-1, 3)
    while True:
        middle = lower + cell * (cubes + (edge - 1) / 2)
        distance = scene.compute_distance(queries(_tensor(middle))).numpy()
        asked += len(cubes)
        near = distance <= reach + cell * (edge - 1) / 2 * math.sqrt(3)
        cubes, distance = cubes[near], distance[near]
        if edge == 1:
            return cubes, distance, asked
        edge //= 2
        cubes = (cubes[:, None] + edge * np.array(list(np.ndindex(2, 2, 2)))).reshape(-1, 3)
        cubes = cubes[(cubes < shape).all(1)]


def _sides(
    surface: SurfaceMesh, lower: Float[ndarray, "3"], cell: float, points: Int[ndarray, "n 3"], shape: tuple[int, ...]
) -> Bool[ndarray, "x y z"]:
    """Which lattice points are inside, given those in the band.

    Beyond the band, signs are computed for every third point and copied to its neighbours. These are on the same side, since
    the nearest point with a computed sign is nearer than the band is wide.
    """
    near, every = np.zeros(shape, bool), np.zeros(shape, bool)
    near[tuple(points.T)] = True
    every[::STRIDE, ::STRIDE, ::STRIDE] = True
    far = np.argwhere(every & ~near)
    tried = np.concatenate([points, far])
    origins = lower + cell * tried
    inside, doubtful = _by_crossings(surface, origins)
    if doubtful.any():
        facing = np.zeros(shape, np.float32)
        facing[tuple(tried[doubtful].T)] = _facing(surface, origins[doubtful])
        around = uniform_filter(facing, 2 * AROUND + 1, mode="constant")
        inside[doubtful] = around[tuple(tried[doubtful].T)] < 0
    sides = np.zeros(shape, bool)
    sides[tuple(tried.T)] = inside
    if len(far):
        every &= ~near
        nearest = np.asarray(distance_transform_edt(~every, return_distances=False, return_indices=True))
        sides[~near] = sides[tuple(nearest[:, ~near])]
    return sides


def _by_crossings(surface: SurfaceMesh, points: Float[ndarray, "n 3"]) -> tuple[Bool[ndarray, " n"], Bool[ndarray, " n"]]:
    """Which points are inside by the parity of crossings, and which are not inside although they see no sky."""
    odd, sky = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for direction in _upward(RAYS):
        rays = queries(_tensor(points), _tensor(np.broadcast_to(direction, points.shape)))
        crossings = surface.raycasting.count_intersections(rays).numpy()
        odd += crossings % 2
        sky += crossings == 0
    hidden = sky < SKY * RAYS
    return hidden & (odd > RAYS / 2), hidden & (odd <= RAYS / 2)


def _facing(surface: SurfaceMesh, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
    """Mean over the rays of +1 if the first triangle on the ray shows its front, -1 if it shows its back."""
    total = np.zeros(len(points), np.float32)
    for direction in _upward(RAYS):
        rays = queries(_tensor(points), _tensor(np.broadcast_to(direction, points.shape)))
        met = surface.raycasting.cast_rays(rays)
        total -= np.where(np.isfinite(met["t_hit"].numpy()), np.sign(met["primitive_normals"].numpy() @ direction), 0.0)
    return total / RAYS


def _upward(count: int) -> Float[ndarray, "r 3"]:
    """Unit directions that cover the sky above LOWEST evenly (golden spiral)."""
    at = np.arange(count) + 0.5
    z = LOWEST + (1 - LOWEST) * at / count
    turn = math.pi * (1 + math.sqrt(5)) * at
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)


def _tensor(points: Float[ndarray, "n 3"]) -> Tensor:
    return torch.from_numpy(np.array(points, np.float32))
