"""Landing: where a path meets the surface, whether the particle stays, and how it lies.

Paths are tested as one ray per particle and frame, against the mesh itself (no grid to fall through); particles with free air
around them are spared the ray. Where a cover lies, contact is made on top of it. What hits is projected onto the closest
point of
the mesh. Whether it stays depends on the slope only: always up to `holds_degrees`, never from `slips_degrees`, and with
linearly falling chance in between; what does not stay slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.physics.clock import Domain

if TYPE_CHECKING:
    from pgsd_nerfstudio.surface.mesh import Hits, SurfaceMesh

CELL = 0.12  # m, of the map of where the surface is, at least
MAX_CELLS = 20_000_000  # of that map; larger scenes have larger cells
BAND = 3  # cells around it that count as near: a path shorter than (BAND - 1) cells cannot reach the surface from outside
PROBE_RINGS = (0.25, 0.5, 1.0)  # of SurfaceResponse.probe
PROBES = 8  # per ring
SMALLEST = 0.15  # of SurfaceResponse.probe: extent where even the first ring finds no surface, as on a blade of grass
ROUGH = 0.35  # rise per run within which the neighbourhood still counts as the same surface


GRAZING = 0.2  # sine of the flattest path for which a cover's thickness is counted along the path


class Raised(Protocol):
    """A cover that lies on the surface (physics.cover has it)."""

    def height(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]: ...
    def normal(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]: ...
    @property
    def thickest(self) -> float: ...


class Meeting(NamedTuple):
    """Paths that end on the surface."""

    which: Float[ndarray, " h"]
    """Index of the path."""
    points: Float[ndarray, "h 3"]
    normals: Float[ndarray, "h 3"]
    """Of the side from which the path came."""


class RestPose(NamedTuple):
    """How landed particles lie."""

    positions: Float[ndarray, "h 3"]
    quats: Float[ndarray, "h 4"]
    extents: Float[ndarray, " h"]


@dataclass(frozen=True)
class Ground:
    """A surface made ready for landing."""

    surface: SurfaceMesh
    response: SurfaceResponse
    lower: Float[ndarray, "3"]
    near: Bool[ndarray, "x y z"]
    """Cells with surface in them or within BAND cells."""
    cell: float
    """Their edge, metres."""

    @staticmethod
    def of(surface: SurfaceMesh, response: SurfaceResponse, domain: Domain) -> Ground:
        """Map where the surface is within the domain."""
        lower = np.asarray(domain.lower, np.float64)
        cell = max(CELL, (domain.volume / MAX_CELLS) ** (1 / 3))
        shape = tuple(np.ceil(np.asarray(domain.size) / cell).astype(int) + 1)
        near = torch.zeros(shape)
        corners = (
            surface.vertices.numpy(force=True)[surface.triangles.numpy(force=True)]
            if len(surface.triangles)
            else np.zeros((0, 3, 3))
        )
        cells = np.floor((sample_triangles(corners, cell / 2) - lower) / cell).astype(int)
        cells = cells[((cells >= -BAND) & (cells < np.asarray(shape) + BAND)).all(1)].clip(0, np.asarray(shape) - 1)
        near[tuple(cells.T)] = 1.0
        for axis in range(3):  # a cube grows axis by axis
            pooled = near.movedim(axis, 2).reshape(1, -1, shape[axis])
            pooled = torch.nn.functional.max_pool1d(pooled, 2 * BAND + 1, 1, BAND)
            near = pooled.reshape(near.movedim(axis, 2).shape).movedim(2, axis)
        return Ground(surface, response, lower, near.numpy() > 0, cell)

    def meet(self, start: Float[ndarray, "n 3"], stop: Float[ndarray, "n 3"], cover: Raised | None = None) -> Meeting:
        """First contact of each straight path with the surface, or with the cover on it, of those that have one."""
        path = stop - start
        length = np.sqrt((path * path).sum(1))
        thickest = cover.thickest if cover is not None else 0.0
        cells = ((start - self.lower.astype(start.dtype)) * start.dtype.type(1 / self.cell)).astype(np.int32)
        inside = ((cells >= 0) & (cells < self.near.shape)).all(1)
        x, y, z = np.where(inside[:, None], cells, 0).T
        test = (self.near[x, y, z] | ~inside | (length + thickest > (BAND - 1) * self.cell)) & (length > 0)
        tried = test.nonzero()[0]
        if len(tried) == 0 or len(self.surface.triangles) == 0:
            return Meeting(tried[:0], start[:0], start[:0])
        direction = path[tried] / length[tried, None]
        hits = self._cast(start[tried], direction)
        distance, normal = hits.distance.numpy(), hits.normal.numpy()
        normal = np.where((normal * direction).sum(1, keepdims=True) > 0, -normal, normal)
        if cover is not None and thickest > 0:
            distance, normal = _on_cover(cover, thickest, start[tried], direction, length[tried], distance, normal)
        met = distance <= length[tried]
        which = tried[met]
        return Meeting(which, start[which] + direction[met] * distance[met, None], normal[met])

    def _cast(self, origins: Float[ndarray, "n 3"], directions: Float[ndarray, "n 3"]) -> Hits:
        as_single = (torch.from_numpy(np.ascontiguousarray(rays, np.float32)) for rays in (origins, directions))
        return self.surface.cast(*as_single)

    def open_above(self, points: Float[ndarray, "n 3"], toward: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether nothing lies between each point and the sky, looking along `toward`."""
        if len(points) == 0 or len(self.surface.triangles) == 0:
            return np.ones(len(points), bool)
        direction = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        hits = self._cast(points, direction)
        return ~np.isfinite(hits.distance.numpy())

    def holds(self, normals: Float[ndarray, "h 3"], draw: Float[ndarray, " h"]) -> Bool[ndarray, " h"]:
        """Whether particles stay, each with its own draw from 0..1; never on a surface that looks down."""
        slope = np.degrees(np.arccos(normals[:, 2].clip(-1, 1)))
        low, high = self.response.holds_degrees, self.response.slips_degrees
        return draw < (high - slope) / max(high - low, 1e-6)

    def rest(
        self, points: Float[ndarray, "h 3"], spin: Float[ndarray, " h"], covers: Float[ndarray, " h"] | None = None
    ) -> RestPose:
        """Lay particles down at their contacts, thin axis along the normal, turned by `spin` turns about it.

        covers: thickness in metres of what lies on the surface there, which raises them.
        """
        raised = np.zeros((len(points), 3))
        if covers is not None:
            raised[:, 2] = covers
        points = points - raised
        if len(points) == 0:
            return RestPose(np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32), np.zeros(0, np.float32))
        closest = self.surface.closest(torch.from_numpy(points.astype(np.float32)))
        at, normal = closest.points.numpy(), _upward(closest.normals.numpy())
        normal, extent = self._feel(at, normal)
        quats = _turned(normal, spin)
        return RestPose((at + self.response.settle * normal + raised).astype(np.float32), quats, extent)

    def _feel(
        self, at: Float[ndarray, "h 3"], normal: Float[ndarray, "h 3"]
    ) -> tuple[Float[ndarray, "h 3"], Float[ndarray, " h"]]:
        """Normals smoothed over the neighbourhood, and the radius to which the surface goes on around each point.

        Rays onto rings around the point, along the normal: the surface goes on where they meet it within ROUGH of the plane.
        """
        first, second = _tangents(normal)
        turns = 2 * np.pi * np.arange(PROBES) / PROBES
        around = np.cos(turns)[:, None, None] * first + np.sin(turns)[:, None, None] * second  # [PROBES, h, 3]
        extent = np.full(len(at), SMALLEST * self.response.probe, np.float32)
        alive, total = np.ones(len(at), bool), 2.0 * normal
        for share in PROBE_RINGS:
            radius = share * self.response.probe
            tolerance = ROUGH * radius + 0.01
            origin = at + radius * around + 2 * tolerance * normal
            down = np.broadcast_to(-normal, origin.shape)
            hits = self._cast(origin.reshape(-1, 3), down.reshape(-1, 3))
            distance = hits.distance.numpy().reshape(PROBES, -1)
            same = np.abs(distance - 2 * tolerance) <= tolerance
            felt = hits.normal.numpy().reshape(PROBES, -1, 3)
            total = total + np.where((same & alive)[..., None], felt, 0.0).sum(0)
            alive &= same.sum(0) >= PROBES - 1  # one hole in a scanned mesh is no edge
            extent[alive] = radius
        smooth = _upward(total / np.linalg.norm(total, axis=1, keepdims=True).clip(1e-6))
        return smooth, extent


def _on_cover(
    cover: Raised,
    thickest: float,
    start: Float[ndarray, "n 3"],
    direction: Float[ndarray, "n 3"],
    length: Float[ndarray, " n"],
    distance: Float[ndarray, " n"],
    normal: Float[ndarray, "n 3"],
) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
    """Distances and normals of hits on surfaces that look up, moved up onto the cover.

    A plane that is raised by h is met h n_z / (-d . n) earlier; never before the start, where the cover grew over a particle.
    """
    into = -(direction * normal).sum(1)
    near = np.isfinite(distance) & (normal[:, 2] > 0) & (distance <= length + thickest / GRAZING)
    which = near.nonzero()[0]
    if len(which) == 0:
        return distance, normal
    base = start[which] + direction[which] * distance[which, None]
    height = cover.height(base.astype(np.float64))
    distance, normal = distance.copy(), normal.copy()
    distance[which] -= height * normal[which, 2] / np.maximum(into[which], GRAZING)
    distance[which] = distance[which].clip(0.0)
    thick = height > 1e-3  # a thinner one has the slope of what it lies on
    normal[which[thick]] = cover.normal(base[thick].astype(np.float64))
    return distance, normal


def _upward(normal: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    return np.where(normal[:, 2:] < 0, -normal, normal)


def _tangents(normal: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"]]:
    """Two directions along the surface (Duff et al., "Building an orthonormal basis, revisited", 2017), for upward normals."""
    x, y, z = normal.T
    b = -x * y / (1 + z)
    return np.stack([1 - x * x / (1 + z), b, -x], 1), np.stack([b, 1 - y * y / (1 + z), -y], 1)


def _turned(normal: Float[ndarray, "n 3"], spin: Float[ndarray, " n"]) -> Float[ndarray, "n 4"]:
    """Quaternions (wxyz) that spin about z and then take z to the normal the short way."""
    half = np.pi * spin
    # Short way from z to an upward normal: (1 + n_z, z cross n), normalised; times the spin (cos, 0, 0, sin).
    w, x, y = 1 + normal[:, 2], -normal[:, 1], normal[:, 0]
    size = np.sqrt(w * w + x * x + y * y)
    w, x, y = w / size, x / size, y / size
    c, s = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * s, y * c - x * s, w * s], 1).astype(np.float32)


def sample_triangles(corners: Float[ndarray, "f 3 3"], spacing: float) -> Float[ndarray, "s 3"]:
    """Points on triangles, no point of a triangle farther than `spacing` from one of them."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1) if len(corners) else np.zeros(0)
    # Triangles of a similar size are sampled together, so that one large one does not refine all the small ones.
    steps = 2 ** np.ceil(np.log2(np.maximum(edges / spacing, 1.0))).astype(int)
    points = [np.zeros((0, 3))]
    for count in np.unique(steps):
        first, second = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        u, v = (grid[first + second <= count] / count for grid in (first, second))
        weights = np.stack([1 - u - v, u, v], 1)
        points.append(np.einsum("sc,fcd->fsd", weights, corners[steps == count]).reshape(-1, 3))
    return np.concatenate(points)
