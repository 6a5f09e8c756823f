"""A layered height field of a scene: above every square of the plan, the heights of all surfaces that face up.

A square with a table over a floor has two levels. Rays are cast down through the mesh, again below each hit; a surface closer
beneath another one than `gap` belongs to the same object and makes no level. Each level knows the level in each of the eight
squares around it that continues its sheet, and where its sheet ends: at a drop (the edge of a table), at a wall, or at the
border of the domain. It has eight neighbours rather than four because heaps with four neighbours become pyramids.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_COLUMNS = 400_000
STEEPEST = math.tan(math.radians(75.0))  # largest rise per edge of a square between neighbours of one sheet
BELOW_UNDERSIDE = 1e-3  # m below a surface that faces down, at which the next ray starts
WALL, DROP, BORDER = -1, -2, -3  # ends of a sheet, in place of a neighbour
NOWHERE = -1  # in place of the level beyond an end
AROUND = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)])
# The diagonals beside direction k < 4 are 4 + k and 4 + (k + 3) % 4; the direction opposite to k is (k + 2) % 4.


class Columns(NamedTuple):
    """The levels of all columns, ordered by column and, within it, from the top down."""

    lower: Float[ndarray, "2"]
    """Corner of the plan, metres."""
    cell: float
    """Edge of a square, metres."""
    shape: tuple[int, int]
    first: Int[ndarray, " c+1"]
    """First level of each column."""
    column: Int[ndarray, " l"]
    base: Float[ndarray, " l"]
    """Height of each level, metres."""
    neighbours: Int[ndarray, "l 8"]
    """Level that continues the sheet in each direction of AROUND, or WALL, DROP, BORDER."""
    beyond: Int[ndarray, "l 8"]
    """At a DROP the level below it, at a WALL the level on top of it; NOWHERE if there is none."""

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, cell: float, gap: float) -> Columns:
        """The columns of a surface.

        Args:
            surface: the mesh, in metres.
            domain: its plan and heights bound the columns.
            cell: edge of a square in metres; it grows where there would be more than 400,000 squares.
            gap: metres; a surface closer beneath another one makes no level.
        """
        cell = max(cell, math.sqrt(domain.area / MAX_COLUMNS))
        nx, ny = (max(1, math.ceil(edge / cell)) for edge in domain.size[:2])
        lower = np.asarray(domain.lower[:2], np.float64)
        column, base = _levels(surface, lower, cell, (nx, ny), domain, gap)
        order = np.lexsort((-base, column))
        column, base = column[order].astype(np.int32), base[order]
        first = np.searchsorted(column, np.arange(nx * ny + 1)).astype(np.int32)
        neighbours = np.full((len(base), 8), BORDER, np.int32)
        beyond = np.full((len(base), 8), NOWHERE, np.int32)
        columns = Columns(lower, cell, (nx, ny), first, column, base, neighbours, beyond)
        _link(columns, AROUND, cell * STEEPEST)
        return columns

    @property
    def centres(self) -> Float[ndarray, "l 3"]:
        """Middle of the square of each level, at the level's height, in metres."""
        at = np.stack(np.unravel_index(self.column, self.shape), 1)
        return np.column_stack([self.lower + self.cell * (at + 0.5), self.base])

    def find(self, points: Float[ndarray, "n 3"], heights: Float[ndarray, " l"], tolerance: float) -> Int[ndarray, " n"]:
        """The level that each point belongs to; -1 where there is none.

        A point belongs to the nearest level of its own square. If there is none, it belongs to the nearest level of the squares
        around, since at an edge the middle of its square may be beyond the surface. A point with NaN belongs to no level.

        Args:
            points: m.
            heights: thickness of the cover on each level, m.
            tolerance: metres that a point may be below a level or above its cover.
        """
        return _find(np.ascontiguousarray(points, np.float64), self, heights, tolerance)


def _levels(
    surface: SurfaceMesh, lower: Float[ndarray, "2"], cell: float, shape: tuple[int, int], domain: Domain, gap: float
) -> tuple[Int[ndarray, " l"], Float[ndarray, " l"]]:
    """Columns and heights of the surfaces that face up within the domain."""
    columns, heights = [np.zeros(0, np.int64)], [np.zeros(0)]
    which = np.arange(shape[0] * shape[1]) if len(surface.triangles) else np.zeros(0, np.int64)
    at = lower + cell * (np.stack(np.unravel_index(which, shape), 1) + 0.5)
    origin = np.column_stack([at, np.full(len(at), domain.upper[2])])
    while len(which):  # rays start 1 mm or more lower each time, until they hit nothing
        down = torch.tensor([0.0, 0.0, -1.0]).expand(len(origin), 3)
        hits = surface.cast(torch.from_numpy(origin.astype(np.float32)), down)
        distance, upward = hits.distance.numpy().astype(np.float64), hits.normal.numpy()[:, 2] > 0
        hit = np.isfinite(distance) & (origin[:, 2] - distance >= domain.lower[2])
        which, origin, upward = which[hit], origin[hit], upward[hit]
        z = origin[:, 2] - distance[hit]
        columns.append(which[upward])
        heights.append(z[upward])
        # A surface within `gap` below one that faces up is its underside; below one that faces down nothing is skipped.
        origin[:, 2] = z - np.where(upward, gap, BELOW_UNDERSIDE)
    return np.concatenate(columns), np.concatenate(heights)


@kernel()
def _link(columns, around, reach):
    base, first = columns.base, columns.first
    nx, ny = columns.shape
    for level in range(len(base)):
        x, y = columns.column[level] // ny, columns.column[level] % ny
        for k in range(8):
            i, j = x + around[k, 0], y + around[k, 1]
            if i < 0 or j < 0 or i >= nx or j >= ny:
                continue
            near, closest = -1, reach  # diagonals have the same reach, so that a step is a drop in all directions or in none
            under, over = -1, -1  # the highest level below this one and the lowest above
            for m in range(first[i * ny + j], first[i * ny + j + 1]):
                apart = abs(base[m] - base[level])
                if apart <= closest:
                    near, closest = m, apart
                if base[m] >= base[level]:
                    over = m
                elif under < 0:
                    under = m
            if near >= 0:
                columns.neighbours[level, k] = near
            elif under < 0 and over >= 0:
                columns.neighbours[level, k] = -1
                columns.beyond[level, k] = over
            else:
                columns.neighbours[level, k] = -2
                columns.beyond[level, k] = under


@kernel()
def _find(points, columns, heights, tolerance):
    lower, cell, base, first = columns.lower, columns.cell, columns.base, columns.first
    nx, ny = columns.shape
    found = np.full(len(points), -1, np.int64)
    for n in range(len(points)):
        u, v, z = (points[n, 0] - lower[0]) / cell, (points[n, 1] - lower[1]) / cell, points[n, 2]
        if not (u >= 0.0 and v >= 0.0 and u <= nx and v <= ny):
            continue
        x, y = min(int(u), nx - 1), min(int(v), ny - 1)
        for ring in range(2):
            best = tolerance
            for i in range(max(x - ring, 0), min(x + ring + 1, nx)):
                for j in range(max(y - ring, 0), min(y + ring + 1, ny)):
                    for m in range(first[i * ny + j], first[i * ny + j + 1]):
                        apart = max(base[m] - z, z - base[m] - heights[m], 0.0)
                        if apart < best or (apart == best and found[n] < 0):
                            best = apart
                            found[n] = m
            if found[n] >= 0:
                break
    return found
