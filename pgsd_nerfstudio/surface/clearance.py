"""A map of how far the surface is at least from every cell of a box: it tells which paths cannot reach the surface.

A cell is occupied if a triangle may lie in it. The clearance of a cell is the distance between it and the nearest occupied one,
which is never more than the distance from any point of the cell to the surface. A path is followed in steps as long as the
clearance where it is ("sphere tracing", Hart 1996), and is free if it ends before it comes to a cell without clearance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CELL = 0.07  # m; smallest edge of a cell
MAX_CELLS = 6_000_000  # a byte each; larger boxes have larger cells
REACH = 8  # cells; distances beyond are not told apart
PARTS = 16  # of a cell in which clearance is counted
SLACK = 0.05  # parts of a cell by which clearance is less: rays are cast in float32
ROOM = 1e-4  # cells by which a triangle may lie beside a cell that it occupies


class Clearance(NamedTuple):
    """Clearance in the cells of a box and of REACH cells around it."""

    lower: Float[ndarray, "3"]
    """Corner of the first cell, metres."""
    cell: float
    """Edge of a cell, metres."""
    parts: UInt8[ndarray, "x y z"]
    """Distance from the surface in sixteenths of a cell, rounded down; at most REACH cells, 0 in and beside occupied cells."""

    @staticmethod
    def of(surface: SurfaceMesh, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], cell: float = CELL) -> Clearance:
        """The clearance of a surface in and around a box.

        Args:
            surface: the mesh, in metres.
            lower: corner of the box, m.
            upper: opposite corner of the box, m.
            cell: edge of a cell in metres; it grows where there would be more than MAX_CELLS.
        """
        start, cell, shape = box_of_cells(lower, upper, cell)
        return Clearance.around(occupied_cells(surface, start, cell, shape), start, cell)

    @staticmethod
    def around(occupied: Bool[ndarray, "x y z"], lower: Float[ndarray, "3"], cell: float) -> Clearance:
        """The clearance of cells that are occupied.

        Args:
            occupied: cells of a box.
            lower: corner of the first cell, m.
            cell: edge of a cell, m.
        """
        return Clearance(lower, cell, _parts(occupied))

    def near(self, start: Float[ndarray, "n 3"], stop: Float[ndarray, "n 3"], room: float = 0.0) -> Int[ndarray, " c"]:
        """Indices of the straight paths that may come within `room` of the surface, ascending; all others cannot.

        A path of no length counts as free, and one outside of the map does not.

        Args:
            start: of each path, m.
            stop: end of each path, m.
            room: m.
        """
        return _near(start, stop, room, self.lower, self.cell, self.parts)


def box_of_cells(
    lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], cell: float = CELL
) -> tuple[Float[ndarray, "3"], float, tuple[int, int, int]]:
    """Corner of the first cell in metres, edge of a cell, and numbers of cells that cover a box and REACH cells around it.

    Args:
        lower: corner of the box, m.
        upper: opposite corner of the box, m.
        cell: edge of a cell in metres; it grows where there would be more than MAX_CELLS.
    """
    lower, size = np.asarray(lower, np.float64), np.asarray(upper, np.float64) - np.asarray(lower, np.float64)
    while math.prod((size / cell + 2 * REACH + 1).tolist()) > MAX_CELLS:
        cell *= 1.05
    x, y, z = (np.ceil(size / cell).astype(int) + 2 * REACH).tolist()
    return lower - REACH * cell, float(cell), (x, y, z)


def occupied_cells(
    surface: SurfaceMesh, lower: Float[ndarray, "3"], cell: float, shape: tuple[int, int, int]
) -> Bool[ndarray, "x y z"]:
    """Cells of a box in which a triangle lies, and a few more that it nearly touches.

    Args:
        surface: the mesh, in metres.
        lower: corner of the first cell, m.
        cell: edge of a cell, m.
        shape: cells along each axis.
    """
    occupied = np.zeros(math.prod(shape), np.bool_)
    occupied[cells_of_triangles(surface, lower, cell, shape)[0]] = True
    return occupied.reshape(shape)


def cells_of_triangles(
    surface: SurfaceMesh, lower: Float[ndarray, "3"], cell: float, shape: tuple[int, int, int]
) -> tuple[Int[ndarray, " m"], Int[ndarray, " m"]]:
    """Flat indices of the cells in which triangles lie, or nearly, and the triangle of each, in the order of the triangles.

    Args:
        surface: the mesh, in metres.
        lower: corner of the first cell, m.
        cell: edge of a cell, m.
        shape: cells along each axis.
    """
    vertices = (surface.vertices.numpy(force=True).astype(np.float64) - lower) / cell
    return _cells_of(vertices, surface.triangles.numpy(force=True), shape)


@kernel()
def _longer(values, count):
    grown = np.empty(2 * count + 1024, np.int32)
    grown[: len(values)] = values
    return grown


@kernel()
def _cells_of(vertices, triangles, shape):
    """Cells and owners, see `cells_of_triangles`; vertices in cells.

    In the plan across the axis of a triangle's largest normal component, squares are left out that an edge separates from it.
    Along that axis the plane of the triangle bounds the cells.
    """
    cells, owners, count = np.empty(6 * len(triangles) + 1024, np.int32), np.empty(6 * len(triangles) + 1024, np.int32), 0
    stride = (shape[1] * shape[2], shape[2], 1)
    at, low, high, normal = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    begin, end = np.empty(3, np.int64), np.empty(3, np.int64)
    half = 0.5 + ROOM
    for f in range(len(triangles)):
        outside, several = False, 0
        for axis in range(3):
            a, b, c = vertices[triangles[f, 0], axis], vertices[triangles[f, 1], axis], vertices[triangles[f, 2], axis]
            at[0, axis], at[1, axis], at[2, axis] = a, b, c
            low[axis], high[axis] = min(a, b, c) - ROOM, max(a, b, c) + ROOM
            if not (high[axis] >= 0.0 and low[axis] < shape[axis]):
                outside = True
                break
            begin[axis], end[axis] = int(max(low[axis], 0.0)), int(min(high[axis], shape[axis] - 1.0))
            several += end[axis] > begin[axis]
        if outside:
            continue
        if several <= 1:  # a row of cells
            number = (end[0] - begin[0]) + (end[1] - begin[1]) + (end[2] - begin[2]) + 1
            if count + number > len(cells):
                cells, owners = _longer(cells, count + number), _longer(owners, count + number)
            for i in range(begin[0], end[0] + 1):
                for j in range(begin[1], end[1] + 1):
                    for k in range(begin[2], end[2] + 1):
                        cells[count], owners[count] = i * stride[0] + j * stride[1] + k, f
                        count += 1
            continue
        deep = 0
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            normal[axis] = (at[1, u] - at[0, u]) * (at[2, v] - at[0, v]) - (at[1, v] - at[0, v]) * (at[2, u] - at[0, u])
            if abs(normal[axis]) > abs(normal[deep]):
                deep = axis
        u, v = (deep + 1) % 3, (deep + 2) % 3
        flat = normal[deep] != 0.0  # a triangle without area occupies all cells of its box
        slope_u, slope_v = (-normal[u] / normal[deep], -normal[v] / normal[deep]) if flat else (0.0, 0.0)
        thick = (abs(slope_u) + abs(slope_v)) * half + ROOM
        for i in range(begin[u], end[u] + 1):
            for j in range(begin[v], end[v] + 1):
                lowest, highest = begin[deep], end[deep]
                if flat:
                    apart = False
                    for edge in range(3):
                        other = (edge + 1) % 3
                        edge_u, edge_v = at[other, u] - at[edge, u], at[other, v] - at[edge, v]
                        side = edge_u * (j + 0.5 - at[edge, v]) - edge_v * (i + 0.5 - at[edge, u])  # positive inside
                        if normal[deep] < 0.0:
                            side = -side
                        apart |= side + (abs(edge_u) + abs(edge_v)) * half < 0.0
                    if apart:
                        continue
                    middle = at[0, deep] + slope_u * (i + 0.5 - at[0, u]) + slope_v * (j + 0.5 - at[0, v])
                    lowest = max(lowest, math.floor(max(middle - thick, -1.0)))
                    highest = min(highest, math.floor(min(middle + thick, shape[deep] + 1.0)))
                if count + highest + 1 - lowest > len(cells):
                    cells = _longer(cells, count + highest + 1 - lowest)
                    owners = _longer(owners, count + highest + 1 - lowest)
                for k in range(lowest, highest + 1):
                    cells[count], owners[count] = i * stride[u] + j * stride[v] + k * stride[deep], f
                    count += 1
    return cells[:count], owners[:count]


@kernel()
def _parts(occupied):
    """Clearance of all cells: with d cells from one to the other along an axis, |d| - 1 lie between them.

    Outermost cells count as occupied, since nothing is known about what is beyond them.
    """
    nx, ny, nz = occupied.shape
    far = np.uint8(REACH * REACH)
    now = np.where(occupied, np.uint8(0), far)
    now[0], now[-1], now[:, 0], now[:, -1], now[:, :, 0], now[:, :, -1] = 0, 0, 0, 0, 0, 0
    grown = now.copy()
    for axis in range(3):
        if axis > 0:
            grown[:] = now
        for d in range(-REACH, REACH + 1):
            between = np.uint8(max(abs(d) - 1, 0) ** 2)
            dx, dy, dz = d if axis == 0 else 0, d if axis == 1 else 0, d if axis == 2 else 0
            for x in range(max(0, -dx), min(nx, nx - dx)):
                for y in range(max(0, -dy), min(ny, ny - dy)):
                    own, other = grown[x, y, max(0, -dz) : min(nz, nz - dz)], now[x + dx, y + dy, max(0, dz) : min(nz, nz + dz)]
                    for z in range(len(own)):
                        own[z] = min(own[z], np.uint8(other[z] + between))
        now, grown = grown, now
    parts = np.empty(256, np.uint8)
    for square in range(256):
        parts[square] = max(math.floor(PARTS * min(math.sqrt(square), float(REACH)) - SLACK), 0)
    found = np.empty((nx, ny, nz), np.uint8)
    flat, squares = found.reshape(-1), now.reshape(-1)
    for c in range(len(flat)):
        flat[c] = parts[squares[c]]
    return found


@kernel()
def _near(start, stop, room, lower, cell, parts):
    found, count = np.empty(len(start), np.int64), 0
    inverse, part = np.float32(1.0 / cell), np.float32(cell / PARTS)
    low_x, low_y, low_z = np.float32(lower[0] / cell), np.float32(lower[1] / cell), np.float32(lower[2] / cell)
    nx, ny, nz = parts.shape
    for n in range(len(start)):
        x, y, z = start[n, 0], start[n, 1], start[n, 2]
        way_x, way_y, way_z = stop[n, 0] - x, stop[n, 1] - y, stop[n, 2] - z
        square = way_x * way_x + way_y * way_y + way_z * way_z
        gone, length = np.float32(0.0), np.float32(-1.0)
        while True:
            i, j, k = int(x * inverse - low_x), int(y * inverse - low_y), int(z * inverse - low_z)
            if i < 1 or j < 1 or k < 1 or i >= nx or j >= ny or k >= nz:
                clear = np.float32(-1.0)
            else:
                clear = parts[i, j, k] * part - room
            if length < 0.0:
                if (clear > 0.0 and clear * clear > square) or square == 0.0:
                    break
                length = np.float32(math.sqrt(square))
            gone += clear
            if clear > 0.0 and gone > length:
                break
            if not clear > 0.0:
                found[count] = n
                count += 1
                break
            share = gone / length
            x, y, z = start[n, 0] + share * way_x, start[n, 1] + share * way_y, start[n, 2] + share * way_z
    return found[:count].copy()
