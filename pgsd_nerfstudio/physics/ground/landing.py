"""Landing: where a path makes contact with the surface, whether the particle stays there, and its pose at rest.

Each path is tested with one ray per particle and frame against the mesh itself, so that no particle passes through; particles
far from any surface need no ray. On cover, contact is made with its top. A landed particle is projected onto the closest point
of the mesh. Whether it stays depends on the slope only: it always stays up to `holds_degrees`, never from `slips_degrees` on,
and with a linearly falling chance in between. A particle that does not stay slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.sampling import points_within

if TYPE_CHECKING:
    from pgsd_nerfstudio.surface.mesh import Hits, SurfaceMesh

CELL = 0.12  # m; smallest cell of the map of the surface
MAX_CELLS = 20_000_000  # of that map; larger scenes have larger cells
BAND = 3  # cells around the surface that count as near: a path shorter than (BAND - 1) cells cannot reach it from outside
PROBE_RINGS = (0.25, 0.5, 1.0)  # radii of the rings, relative to SurfaceResponse.probe
PROBES = 8  # rays per ring
SMALLEST = 0.15  # relative to SurfaceResponse.probe; extent where the first ring finds no surface, as on a blade of grass
ROUGH = 0.35  # rise per run up to which the neighbourhood counts as the same surface
GRAZING = 0.2  # smallest sine of the angle between path and surface with which a path is shortened by the cover


@runtime_checkable
class Raised(Protocol):
    """A cover on the surface; `cover.Cover` has it."""

    def height(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Thickness along z in metres.

        Args:
            points: m, on the surface.
        """
        ...

    def normal(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Unit normals of the top of the cover.

        Args:
            points: m, on the surface.
        """
        ...

    @property
    def thickest(self) -> float:
        """Largest thickness, m."""
        ...


class Meeting(NamedTuple):
    """Contacts of paths with the surface."""

    which: Float[ndarray, " h"]
    """Index of each path that has a contact."""
    points: Float[ndarray, "h 3"]
    """m."""
    normals: Float[ndarray, "h 3"]
    """Unit normals on the side from which the path came."""


class RestPose(NamedTuple):
    """Poses of landed particles."""

    positions: Float[ndarray, "h 3"]
    """m."""
    quats: Float[ndarray, "h 4"]
    """wxyz; they take the z axis to the surface normal."""
    extents: Float[ndarray, " h"]
    """Radius in metres over which the surface around the contact is flat and unbroken."""


@dataclass(frozen=True)
class Ground:
    """A surface prepared for contacts, with a map of the cells near it."""

    surface: SurfaceMesh
    response: SurfaceResponse
    lower: Float[ndarray, "3"]
    """Corner of the first cell, metres."""
    near: Bool[ndarray, "x y z"]
    """Cells within BAND cells of the surface."""
    cell: float
    """Edge of a cell, metres."""

    @staticmethod
    def of(surface: SurfaceMesh, response: SurfaceResponse, domain: Domain) -> Ground:
        """Map the surface within the domain.

        Args:
            surface: the mesh, in metres.
            response: how particles land on it.
            domain: the simulated air.
        """
        lower = np.asarray(domain.lower, np.float64)
        cell = max(CELL, (domain.volume / MAX_CELLS) ** (1 / 3))
        shape = tuple(np.ceil(np.asarray(domain.size) / cell).astype(int) + 1)
        near = torch.zeros(shape)
        room = BAND * cell  # around the domain; a surface there makes cells at the border near
        for points in points_within(surface, lower - room, lower + cell * np.asarray(shape) + room, cell / 2):
            cells = np.floor((points - lower) / cell).astype(int)
            cells = cells[((cells >= -BAND) & (cells < np.asarray(shape) + BAND)).all(1)].clip(0, np.asarray(shape) - 1)
            near[tuple(cells.T)] = 1.0
        for axis in range(3):  # grow a cube axis by axis
            pooled = near.movedim(axis, 2).reshape(1, -1, shape[axis])
            pooled = torch.nn.functional.max_pool1d(pooled, 2 * BAND + 1, 1, BAND)
            near = pooled.reshape(near.movedim(axis, 2).shape).movedim(2, axis)
        return Ground(surface, response, lower, near.numpy() > 0, cell)

    def meet(self, start: Float[ndarray, "n 3"], stop: Float[ndarray, "n 3"], cover: Raised | None = None) -> Meeting:
        """First contacts of straight paths with the surface or the cover on it.

        Args:
            start: of each path, m.
            stop: end of each path, m.
            cover: None where the surface is bare.
        """
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
            distance, normal = _raised(cover, thickest, start[tried], direction, length[tried], distance, normal)
        met = distance <= length[tried]
        which = tried[met]
        return Meeting(which, start[which] + direction[met] * distance[met, None], normal[met])

    def _cast(self, origins: Float[ndarray, "n 3"], directions: Float[ndarray, "n 3"]) -> Hits:
        as_single = (torch.from_numpy(np.ascontiguousarray(rays, np.float32)) for rays in (origins, directions))
        return self.surface.cast(*as_single)

    def open_above(self, points: Float[ndarray, "n 3"], toward: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether the surface does not hide each point from the sky.

        Args:
            points: m.
            toward: directions of view, of any length.
        """
        if len(points) == 0 or len(self.surface.triangles) == 0:
            return np.ones(len(points), bool)
        direction = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        hits = self._cast(points, direction)
        return ~np.isfinite(hits.distance.numpy())

    def holds(self, normals: Float[ndarray, "h 3"], draw: Float[ndarray, " h"]) -> Bool[ndarray, " h"]:
        """Whether particles stay at their contacts; they never stay on a surface that faces down.

        Args:
            normals: unit normals at the contacts.
            draw: a number from 0..1 for each particle.
        """
        slope = np.degrees(np.arccos(normals[:, 2].clip(-1, 1)))
        low, high = self.response.holds_degrees, self.response.slips_degrees
        return draw < (high - slope) / max(high - low, 1e-6)

    def rest(
        self, points: Float[ndarray, "h 3"], spin: Float[ndarray, " h"], covers: Float[ndarray, " h"] | None = None
    ) -> RestPose:
        """Poses of particles that land at their contacts, with their thin axis along the surface normal.

        Args:
            points: contacts, m.
            spin: turns about the normal.
            covers: thickness in metres of the cover that raises each particle; None where the surface is bare.
        """
        raised = np.zeros((len(points), 3))
        if covers is not None:
            raised[:, 2] = covers
        points = points - raised
        if len(points) == 0:
            return RestPose(np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32), np.zeros(0, np.float32))
        closest = self.surface.closest(torch.from_numpy(points.astype(np.float32)))
        at, normal = closest.points.numpy(), _upward(closest.normals.numpy())
        normal, extent = self._probe(at, normal)
        quats = _rotations(normal, spin)
        return RestPose((at + self.response.settle * normal + raised).astype(np.float32), quats, extent)

    def _probe(
        self, at: Float[ndarray, "h 3"], normal: Float[ndarray, "h 3"]
    ) -> tuple[Float[ndarray, "h 3"], Float[ndarray, " h"]]:
        """Normals averaged over the neighbourhood of each point, and the radius to which the surface is unbroken around it.

        Rays are cast along the normal onto rings around the point. The surface is unbroken where they hit it within ROUGH of
        the plane.
        """
        first, second = _tangents(normal)
        turns = 2 * np.pi * np.arange(PROBES) / PROBES
        around = np.cos(turns)[:, None, None] * first + np.sin(turns)[:, None, None] * second  # [PROBES, h, 3]
        extent = np.full(len(at), SMALLEST * self.response.probe, np.float32)
        unbroken, total = np.ones(len(at), bool), 2.0 * normal
        for share in PROBE_RINGS:
            radius = share * self.response.probe
            tolerance = ROUGH * radius + 0.01
            origin = at + radius * around + 2 * tolerance * normal
            down = np.broadcast_to(-normal, origin.shape)
            hits = self._cast(origin.reshape(-1, 3), down.reshape(-1, 3))
            distance = hits.distance.numpy().reshape(PROBES, -1)
            same = np.abs(distance - 2 * tolerance) <= tolerance
            normals = hits.normal.numpy().reshape(PROBES, -1, 3)
            total = total + np.where((same & unbroken)[..., None], normals, 0.0).sum(0)
            unbroken &= same.sum(0) >= PROBES - 1  # a single miss is a hole in a scanned mesh rather than an edge
            extent[unbroken] = radius
        smooth = _upward(total / np.linalg.norm(total, axis=1, keepdims=True).clip(1e-6))
        return smooth, extent


def _raised(
    cover: Raised,
    thickest: float,
    start: Float[ndarray, "n 3"],
    direction: Float[ndarray, "n 3"],
    length: Float[ndarray, " n"],
    distance: Float[ndarray, " n"],
    normal: Float[ndarray, "n 3"],
) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
    """Distances and normals of hits, moved up onto the cover where the surface faces up.

    A path reaches a plane that is raised by h earlier by the distance h n_z / (-d . n). The distance is 0 where the cover grew
    over a particle.
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
    thick = height > 1e-3  # thinner cover has the slope of the surface
    normal[which[thick]] = cover.normal(base[thick].astype(np.float64))
    return distance, normal


def _upward(normal: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    return np.where(normal[:, 2:] < 0, -normal, normal)


def _tangents(normal: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"]]:
    """Two unit vectors square to upward normals (Duff et al., "Building an orthonormal basis, revisited", 2017)."""
    x, y, z = normal.T
    b = -x * y / (1 + z)
    return np.stack([1 - x * x / (1 + z), b, -x], 1), np.stack([b, 1 - y * y / (1 + z), -y], 1)


def _rotations(normal: Float[ndarray, "n 3"], spin: Float[ndarray, " n"]) -> Float[ndarray, "n 4"]:
    """Quaternions (wxyz) that rotate by `spin` turns about z and then take z to the normal by the smallest rotation."""
    half = np.pi * spin
    # The smallest rotation from z to an upward normal is (1 + n_z, z cross n), normalised; the spin is (cos, 0, 0, sin).
    w, x, y = 1 + normal[:, 2], -normal[:, 1], normal[:, 0]
    size = np.sqrt(w * w + x * x + y * y)
    w, x, y = w / size, x / size, y / size
    c, s = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * s, y * c - x * s, w * s], 1).astype(np.float32)
