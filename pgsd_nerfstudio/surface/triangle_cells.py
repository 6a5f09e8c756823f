"""The triangles of a surface by the cells of a `Clearance`, for short ways and points close to the surface (`short_ways`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.surface.clearance import Clearance, box_of_cells, cells_of_triangles
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


class TriangleCells(NamedTuple):
    """f triangles in and around a box, numbered so that neighbours are beside each other in memory."""

    clearance: Clearance
    """Of the cells."""
    first: Int[ndarray, " c+1"]
    """First of `members` of each cell, int32; cells follow each other as those of the clearance in memory."""
    members: Int[ndarray, " m"]
    """Triangles that may lie in each cell, int32."""
    triangles: Int[ndarray, "f 3"]
    """Vertices of each triangle, int32."""
    vertices: Float[ndarray, "v 3"]
    """In metres, float32."""
    normals: Float[ndarray, "v 3"]
    """Unit normals of the vertices, float32."""
    across: Int[ndarray, " 3f"]
    """Side at which each side of a triangle meets another one, -1 where none; side 3 f + k goes from corner k to the next."""

    @staticmethod
    def of(surface: SurfaceMesh, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]) -> TriangleCells:
        """The triangles in and around a box.

        Args:
            surface: the mesh, in metres.
            lower: corner of the box, m.
            upper: opposite corner of the box, m.
        """
        start, cell, shape = box_of_cells(lower, upper)
        first, members, order = _listed(
            *cells_of_triangles(surface, start, cell, shape), int(np.prod(shape)), len(surface.triangles)
        )
        clearance = Clearance.around((first[1:] > first[:-1]).reshape(shape), start, cell)
        triangles = surface.triangles.numpy(force=True)[order].astype(np.int32)
        used = _in_order(triangles.reshape(-1), len(surface.vertices))
        vertices, normals = (values.numpy(force=True)[used] for values in (surface.vertices, surface.vertex_normals))
        return TriangleCells(clearance, first, members, triangles, vertices, normals, _across(triangles, len(used)))


@kernel()
def _listed(cells, owners, cell_count, triangle_count):
    """Sort triangles by cell, and number them in the order in which the cells list them.

    Returns:
        First member of each cell, the members, and the old number of each triangle that is in any cell.
    """
    first = np.zeros(cell_count + 1, np.int32)
    for n in range(len(cells)):
        first[cells[n] + 1] += 1
    for c in range(cell_count):
        first[c + 1] += first[c]
    place, members = first[:-1].copy(), np.empty(len(cells), np.int32)
    for n in range(len(cells)):
        members[place[cells[n]]] = owners[n]
        place[cells[n]] += 1
    return first, members, _in_order(members, triangle_count)


@kernel()
def _in_order(numbers, count):
    """Number things in the order in which they are listed, in place; returns the old number of each that is listed."""
    new, order, found = np.full(count, -1, np.int32), np.empty(count, np.int32), 0
    for n in range(len(numbers)):
        old = numbers[n]
        if new[old] < 0:
            new[old], order[found] = found, old
            found += 1
        numbers[n] = new[old]
    return order[:found]


@kernel()
def _across(triangles, count):
    """The side of another triangle at each side of a triangle; see `TriangleCells`."""
    first = np.zeros(count + 1, np.int32)  # sides sorted by their lower vertex
    for f in range(len(triangles)):
        for k in range(3):
            first[min(triangles[f, k], triangles[f, (k + 1) % 3]) + 1] += 1
    for vertex in range(count):
        first[vertex + 1] += first[vertex]
    last, sides, ends = first[:-1].copy(), np.empty(3 * len(triangles), np.int32), np.empty(3 * len(triangles), np.int32)
    across = np.full(3 * len(triangles), -1, np.int32)
    for f in range(len(triangles)):
        for k in range(3):
            a, b = triangles[f, k], triangles[f, (k + 1) % 3]
            low, high = min(a, b), max(a, b)
            place = last[low]
            for n in range(first[low], place):  # of those before it, one with the same other end that is still alone
                if ends[n] == high and across[sides[n]] < 0 and sides[n] // 3 != f:
                    across[sides[n]], across[3 * f + k] = 3 * f + k, sides[n]
                    break
            sides[place], ends[place] = 3 * f + k, high
            last[low] = place + 1
    return across
