"""A layered height field of a scene: above every square of the plan, the heights of all surfaces that look up.

A table over a floor has two levels there. Rays fall through the mesh from above, again and again below each hit; what lies
closer beneath another surface than `gap` belongs to the same thing. Each level knows the level in each of the eight squares
around it that continues its sheet, and where its sheet ends: at a drop (the edge of a table) or at a wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_COLUMNS = 400_000
MOST_LEVELS = 12  # in a column
STEEPEST = math.tan(math.radians(75.0))  # rise per run up to which two neighbours belong to one sheet
WALL, DROP = -1, -2  # in place of a neighbour
AROUND = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)])  # opposite: plus 2 within each half


@dataclass(frozen=True)
class Columns:
    """The levels of all columns, ordered by column and, within it, from the top down."""

    lower: Float[ndarray, "2"]
    """Corner of the plan, metres."""
    cell: float
    """Edge of a square, metres."""
    shape: tuple[int, int]
    first: Int[ndarray, "c+1"]
    """First level of each column."""
    column: Int[ndarray, "l"]
    base: Float[ndarray, "l"]
    """Height of each level, metres."""
    neighbours: Int[ndarray, "l 8"]
    """Level that continues the sheet in the directions of AROUND, or WALL or DROP."""
    below: Int[ndarray, "l 8"]
    """Where there is a DROP: the level onto which things fall there, or WALL."""

    def __len__(self) -> int:
        return len(self.base)

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, cell: float, gap: float) -> Columns:
        """Of a surface, within the plan of a domain; squares grow where there would be more than 400,000."""
        cell = max(cell, math.sqrt(domain.area / MAX_COLUMNS))
        nx, ny = (max(1, math.ceil(edge / cell)) for edge in domain.size[:2])
        lower = np.asarray(domain.lower[:2], np.float64)
        column, base = _levels(surface, lower, cell, (nx, ny), domain, gap)
        order = np.lexsort((-base, column))
        column, base = column[order], base[order]
        first = np.searchsorted(column, np.arange(nx * ny + 1))
        neighbours = np.full((len(base), 8), WALL, np.int64)
        below = np.full((len(base), 8), WALL, np.int64)
        _link(column, base, first, nx, ny, AROUND, cell * STEEPEST, neighbours, below)
        return Columns(lower, cell, (nx, ny), first, column, base, neighbours, below)

    def find(self, points: Float[ndarray, "n 3"], heights: Float[ndarray, "l"], tolerance: float) -> Int[ndarray, "n"]:
        """Level on whose raised surface each point lies, within `tolerance` metres of height; -1 where there is none."""
        found = np.full(len(points), -1, np.int64)
        _find(
            np.ascontiguousarray(points, np.float64),
            self.lower,
            self.cell,
            self.shape[0],
            self.shape[1],
            self.first,
            self.base,
            heights,
            tolerance,
            found,
        )
        return found


def _levels(
    surface: SurfaceMesh, lower: Float[ndarray, "2"], cell: float, shape: tuple[int, int], domain: Domain, gap: float
) -> tuple[Int[ndarray, "l"], Float[ndarray, "l"]]:
    """Columns and heights of the surfaces that look up within the domain."""
    columns, heights = [np.zeros(0, np.int64)], [np.zeros(0)]
    if len(surface.triangles) == 0:
        return columns[0], heights[0]
    which = np.arange(shape[0] * shape[1])
    at = lower + cell * (np.stack(np.unravel_index(which, shape), 1) + 0.5)
    top = float(surface.bounds[1, 2]) + 1.0
    origin = np.column_stack([at, np.full(len(at), top)])
    for _ in range(4 * MOST_LEVELS):
        down = torch.tensor([0.0, 0.0, -1.0]).expand(len(origin), 3)
        hits = surface.cast(torch.from_numpy(origin.astype(np.float32)), down)
        distance, upward = hits.distance.numpy().astype(np.float64), hits.normal.numpy()[:, 2] > 0
        hit = np.isfinite(distance) & (origin[:, 2] - distance > domain.lower[2] - gap)
        z = origin[hit, 2] - distance[hit]
        kept = upward[hit] & (z <= domain.upper[2])
        columns.append(which[hit][kept])
        heights.append(z[kept])
        # The underside of what was hit belongs to it; what looks down by itself is passed at once.
        origin, which = origin[hit], which[hit]
        origin[:, 2] = z - np.where(upward[hit], gap, 1e-3)
        if len(which) == 0:
            break
    return np.concatenate(columns), np.concatenate(heights)


@numba.njit(cache=True, nogil=True)
def _link(column, base, first, nx, ny, around, reach, neighbours, below):
    for level in range(len(base)):
        x, y = column[level] // ny, column[level] % ny
        for k in range(8):
            i, j = x + around[k, 0], y + around[k, 1]
            if i < 0 or j < 0 or i >= nx or j >= ny:
                continue
            other = i * ny + j
            near, gap, lower = -1, reach * (1.0 if k < 4 else 1.4142135623730951), -1
            for m in range(first[other], first[other + 1]):
                apart = abs(base[m] - base[level])
                if apart <= gap:
                    near, gap = m, apart
                if base[m] < base[level] and lower < 0:
                    lower = m
            if near >= 0:
                neighbours[level, k] = near
            elif lower >= 0:
                neighbours[level, k] = -2
                below[level, k] = lower


@numba.njit(cache=True, nogil=True)
def _find(points, lower, cell, nx, ny, first, base, heights, tolerance, found):
    for n in range(len(points)):
        u, v = (points[n, 0] - lower[0]) / cell, (points[n, 1] - lower[1]) / cell
        if not (u >= 0.0 and v >= 0.0 and u < nx and v < ny):
            continue
        x, y, z = int(u), int(v), points[n, 2]
        best = tolerance
        # The square itself first; at an edge its middle may lie beyond the surface, then those around.
        for ring in range(2):
            for i in range(max(x - ring, 0), min(x + ring + 1, nx)):
                for j in range(max(y - ring, 0), min(y + ring + 1, ny)):
                    for m in range(first[i * ny + j], first[i * ny + j + 1]):
                        apart = abs(z - base[m] - heights[m])
                        if abs(z - base[m]) < apart:
                            apart = abs(z - base[m])
                        if apart <= best:
                            best = apart
                            found[n] = m
            if found[n] >= 0:
                break
