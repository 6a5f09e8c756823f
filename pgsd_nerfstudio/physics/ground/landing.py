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
from pgsd_nerfstudio.physics.curve import along_curve
from pgsd_nerfstudio.physics.ground.paths import rays_along, within_reach
from pgsd_nerfstudio.physics.ground.probing import SMALLEST, probed
from pgsd_nerfstudio.surface.fusion import open3d
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

if TYPE_CHECKING:
    from pgsd_nerfstudio.surface.mesh import SurfaceMesh

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
    """A surface prepared for contacts, with its triangles by small cells."""

    surface: SurfaceMesh
    response: SurfaceResponse
    cells: TriangleCells

    @staticmethod
    def of(surface: SurfaceMesh, response: SurfaceResponse, domain: Domain) -> Ground:
        """Map the surface within the domain.

        Args:
            surface: the mesh, in metres.
            response: how particles land on it.
            domain: the simulated air.
        """
        return Ground(surface, response, TriangleCells.of(surface, np.asarray(domain.lower), np.asarray(domain.upper)))

    def meet(self, start: Float[ndarray, "n 3"], stop: Float[ndarray, "n 3"], cover: Raised | None = None) -> Meeting:
        """First contacts of straight paths with the surface or the cover on it.

        Args:
            start: of each path, m.
            stop: end of each path, m.
            cover: None where the surface is bare.
        """
        thickest = cover.thickest if cover is not None else 0.0
        tried = self.cells.clearance.near(start, stop, thickest)
        if len(tried) == 0 or len(self.surface.triangles) == 0:
            return Meeting(tried[:0], start[:0], start[:0])
        # Rays of neighbours one after the other take a third of the time.
        tried = tried[along_curve(start[tried], *self._box)]
        rays, lengths = rays_along(start, stop, tried)
        found = self.surface.hits_of(open3d().core.Tensor(rays))
        mesh = self.surface.vertex_normals.numpy(), self.surface.triangles.numpy(force=True)
        hit, normal = within_reach(*found, rays, lengths, thickest, GRAZING, *mesh)
        ray, distance = rays[hit], found.distance[hit]
        if cover is not None and thickest > 0:
            distance, normal = _raised(cover, ray[:, :3], ray[:, 3:], distance, normal)
            met = (distance <= lengths[hit]).nonzero()[0]
            hit, ray, distance, normal = hit[met], ray[met], distance[met], normal[met]
        order = np.argsort(tried[hit])
        points = ray[order, :3] + ray[order, 3:] * distance[order, None]
        return Meeting(tried[hit[order]], points, normal[order])

    @property
    def _box(self) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
        """Corners of the map, m."""
        where = self.cells.clearance
        return where.lower, where.lower + where.cell * np.array(where.parts.shape)

    def open_above(self, points: Float[ndarray, "n 3"], toward: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether the surface does not hide each point from the sky.

        Args:
            points: m.
            toward: directions of view, of any length.
        """
        if len(points) == 0 or len(self.surface.triangles) == 0:
            return np.ones(len(points), bool)
        direction = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        order = along_curve(points, *self._box)
        found = np.empty(len(points), bool)
        found[order] = np.isinf(self.surface.first_hits(points[order], direction[order]).distance)
        return found

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
        if len(points) == 0 or len(self.surface.triangles) == 0:
            return RestPose(np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32), np.zeros(0, np.float32))
        points = points - raised
        at, normal, extent, found = probed(self.cells, points, self.response.probe)
        lost = (found < 0).nonzero()[0]
        if len(lost):  # on the highest heaps of dense matter, and outside of the domain
            closest = self.surface.closest(torch.from_numpy(points[lost].astype(np.float32)))
            at[lost], normal[lost] = closest.points.numpy(), _upward(closest.normals.numpy())
            extent[lost] = SMALLEST * self.response.probe
        quats = _rotations(normal, spin)
        return RestPose((at + self.response.settle * normal + raised).astype(np.float32), quats, extent)


def _raised(
    cover: Raised,
    start: Float[ndarray, "n 3"],
    direction: Float[ndarray, "n 3"],
    distance: Float[ndarray, " n"],
    normal: Float[ndarray, "n 3"],
) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
    """Distances and normals of hits, moved up onto the cover where the surface faces up.

    A path reaches a plane that is raised by h earlier by the distance h n_z / (-d . n). The distance is 0 where the cover grew
    over a particle.
    """
    into = -(direction * normal).sum(1)
    which = (normal[:, 2] > 0).nonzero()[0]
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


def _rotations(normal: Float[ndarray, "n 3"], spin: Float[ndarray, " n"]) -> Float[ndarray, "n 4"]:
    """Quaternions (wxyz) that rotate by `spin` turns about z and then take z to the normal by the smallest rotation."""
    half = np.pi * spin
    # The smallest rotation from z to an upward normal is (1 + n_z, z cross n), normalised; the spin is (cos, 0, 0, sin).
    w, x, y = 1 + normal[:, 2], -normal[:, 1], normal[:, 0]
    size = np.sqrt(w * w + x * x + y * y)
    w, x, y = w / size, x / size, y / size
    c, s = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * s, y * c - x * s, w * s], 1).astype(np.float32)
