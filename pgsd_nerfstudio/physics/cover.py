"""The cover that landed matter makes: a thickness on the scene's surfaces, never steeper than its angle of repose.

Thickness is counted upwards, on the levels of `columns`. What a particle leaves is spread over a disc, as its patch is drawn.
Where the raised surface is steeper than the angle of repose, cover moves to the lowest neighbour until it is not, the sandpile
rule (Bak, Tang & Wiesenfeld 1987, with real heights); a `film` of it clings to any slope. The result grows only: what moves is
never more than what a place has too much. Volume is kept to round-off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.columns import Columns
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


@dataclass(frozen=True, kw_only=True)
class CoverConfig:
    """How cover lies."""

    cell: float = 0.05
    """Edge of the squares on which thickness is kept, in metres."""
    gap: float = 0.10
    """Surfaces closer beneath another one than this, in metres, hold no cover of their own."""
    repose_degrees: float = 45.0
    """Angle of repose: the steepest slope of what is thicker than `film`."""
    film: float = 0.005
    """Thickness in metres that clings to any slope on which it was put."""
    tolerance: float = 0.15
    """How far in metres a point may lie above or below a level that it belongs to; slopes within a square need some."""
    slack: float = 1e-4
    """Metres by which a step may be too high before it gives way."""
    most_moves: int = 200
    """Moves per level of the field that one `relax` may take."""

    def __post_init__(self) -> None:
        for name in ("cell", "gap", "tolerance", "slack", "most_moves"):
            if not getattr(self, name) > 0:
                raise ValueError(f"a cover needs a positive {name}, got {getattr(self, name):g}")
        if not 0 < self.repose_degrees < 90:
            raise ValueError(f"the angle of repose must lie in 0-90 degrees, got {self.repose_degrees:g}")
        if not self.film >= 0:
            raise ValueError(f"a film must not be negative, got {self.film:g} m")


class Cover:
    """Thickness of cover on every level; `deposit`, then `relax`, then ask for `height` and `normal`."""

    def __init__(self, columns: Columns, config: CoverConfig) -> None:
        self.columns, self.config = columns, config
        self.heights: Float[ndarray, "l"] = np.zeros(len(columns))  # m
        self._changed: list[ndarray] = []

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, config: CoverConfig | None = None) -> Cover:
        """No cover yet, on all surfaces of a domain that look up."""
        config = config or CoverConfig()
        return Cover(Columns.of(surface, domain, config.cell, config.gap), config)

    def deposit(self, points: Float[ndarray, "n 3"], volumes: Float[ndarray, "n"], radii: Float[ndarray, "n"]) -> float:
        """Add m^3 of cover at points, each spread over a disc of its radius in metres (a paraboloid: thickest in the middle).

        Returns the volume of points that belong to no level, which is not added.

        Raises:
            ValueError: a volume is negative or not finite.
        """
        volumes, radii = (np.ascontiguousarray(values, np.float64) for values in (volumes, radii))
        if not (np.isfinite(volumes).all() and (volumes >= 0).all()):
            raise ValueError(f"volumes of cover must be finite and not negative, found {volumes.min(initial=0.0):g} m^3")
        c = self.columns
        level = c.find(points, self.heights, self.config.tolerance)
        touched = np.zeros(len(c), np.bool_)
        missed = _spread(
            level, points[:, :2].astype(np.float64), volumes, radii, self.heights, touched, c.column, c.base, c.first,
            c.lower, c.cell, *c.shape,
        )  # fmt: skip
        self._changed.append(touched.nonzero()[0])
        return missed

    def relax(self) -> bool:
        """Let what is too steep run down; True when all of it has found its place, False where `most_moves` was not enough."""
        start = np.unique(np.concatenate([np.zeros(0, np.int64), *self._changed]))
        if len(start) == 0:
            return True
        self._changed = []
        c, config = self.columns, self.config
        moves = config.most_moves * max(len(c), 1)
        steep = math.tan(math.radians(config.repose_degrees)) * c.cell
        left = _topple(start, self.heights, c.base, c.neighbours, c.below, steep, config.film, config.slack, moves)
        if len(left):
            self._changed.append(left)
        return len(left) == 0

    def height(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Thickness in metres at points on or near the surface, smooth within a sheet; 0 where there is no level."""
        return self._ask(points)[0]

    def above(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Height in metres of points above the bare surface beneath them, not negative; 0 where there is no level."""
        level = self.columns.find(points, self.heights, self.config.tolerance)
        if len(self.columns) == 0:
            return np.zeros(len(points))
        return np.where(level >= 0, points[:, 2] - self.columns.base[level], 0.0).clip(0.0)

    def normal(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Unit normals of the raised surface; straight up where there is no level."""
        _, slopes = self._ask(points)
        normal = np.column_stack([-slopes, np.ones(len(slopes))])
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @property
    def volume(self) -> float:
        """m^3 of cover."""
        return float(self.heights.sum()) * self.columns.cell**2

    @property
    def thickest(self) -> float:
        """m."""
        return float(self.heights.max(initial=0.0))

    def snapshot(self) -> dict[str, ndarray]:
        """Its state."""
        return {"heights": self.heights.copy(), "changed": np.concatenate([np.zeros(0, np.int64), *self._changed])}

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """The state that `snapshot` gave."""
        self.heights, self._changed = arrays["heights"].copy(), [arrays["changed"].copy()]

    def _ask(self, points: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n"], Float[ndarray, "n 2"]]:
        c = self.columns
        level = c.find(points, self.heights, self.config.tolerance)
        heights, slopes = np.zeros(len(points)), np.zeros((len(points), 2))
        at = points[:, :2].astype(np.float64)
        _read(level, at, self.heights, c.column, c.base, c.neighbours, c.lower, c.cell, c.shape[1], heights, slopes)
        return heights, slopes


@numba.njit(cache=True, nogil=True)
def _spread(level, at, volumes, radii, heights, touched, column, base, first, lower, cell, nx, ny):
    missed = 0.0
    area = cell * cell
    for n in range(len(level)):
        own = level[n]
        if own < 0:
            missed += volumes[n]
            continue
        radius = max(radii[n], 1e-9)
        reach = int(radius / cell) + 1
        x, y = column[own] // ny, column[own] % ny
        for passing in range(2):
            if passing == 0:
                total = 0.0
            for i in range(max(x - reach, 0), min(x + reach + 1, nx)):
                for j in range(max(y - reach, 0), min(y + reach + 1, ny)):
                    du = lower[0] + (i + 0.5) * cell - at[n, 0]
                    dv = lower[1] + (j + 0.5) * cell - at[n, 1]
                    square = (du * du + dv * dv) / (radius * radius)
                    if square >= 1.0:
                        continue
                    gap, best = 0.05 + 1.7 * math.sqrt(du * du + dv * dv), -1
                    for m in range(first[i * ny + j], first[i * ny + j + 1]):
                        apart = abs(base[m] - base[own])
                        if apart <= gap:
                            gap, best = apart, m
                    if best < 0:
                        continue
                    if passing == 0:
                        total += 1.0 - square
                    else:
                        heights[best] += volumes[n] / area * (1.0 - square) / total
                        touched[best] = True
            if total == 0.0:
                heights[own] += volumes[n] / area
                touched[own] = True
                break
    return missed


@numba.njit(cache=True, nogil=True)
def _topple(start, heights, base, neighbours, below, steep, film, slack, most):
    """Levels are visited from a queue; one that gave or got is visited again with those around it. Returns what was left."""
    count = len(heights)
    queued = np.zeros(count, np.bool_)
    queue = np.empty(count + 1, np.int64)
    head, size = 0, 0
    for level in start:
        queue[size] = level
        queued[level] = True
        size += 1
    moves = 0
    while size > 0 and moves < most:
        level = queue[head]
        head = (head + 1) % (count + 1)
        size -= 1
        queued[level] = False
        loose = heights[level] - film
        if loose <= slack:
            continue
        worst, onto, give = slack, -1, 0.0
        top = base[level] + heights[level]
        for k in range(8):
            step = steep * (1.0 if k < 4 else 1.4142135623730951)
            other = neighbours[level, k]
            if other >= 0:
                excess = top - base[other] - heights[other] - step
                share = 0.5 * excess
            elif other == -2 and below[level, k] >= 0:
                # Beyond an edge there is nothing to lean on: as if the surface went on bare, half a square away.
                other = below[level, k]
                excess = loose - 0.5 * step
                share = excess
            else:
                continue
            excess /= 1.0 if k < 4 else 1.4142135623730951  # the steepest, not the lowest
            if excess > worst:
                worst, onto, give = excess, other, share
        if onto < 0:
            continue
        moves += 1
        give = min(give, loose)
        heights[level] -= give
        heights[onto] += give
        for k in range(-2, 8):
            near = level if k == -2 else (onto if k == -1 else neighbours[level, k])
            if near >= 0 and not queued[near]:
                queued[near] = True
                queue[(head + size) % (count + 1)] = near
                size += 1
    left = np.empty(size, np.int64)
    for n in range(size):
        left[n] = queue[(head + n) % (count + 1)]
    return left


@numba.njit(cache=True, nogil=True)
def _read(level, at, heights, column, base, neighbours, lower, cell, ny, out, slopes):
    """Bilinear thickness and the slope of the raised surface; where the sheet ends, its last values go on."""
    for n in range(len(level)):
        own = level[n]
        if own < 0:
            continue
        x, y = column[own] // ny, column[own] % ny
        u = (at[n, 0] - lower[0]) / cell - x - 0.5
        v = (at[n, 1] - lower[1]) / cell - y - 0.5
        u, v = min(max(u, -0.5), 0.5), min(max(v, -0.5), 0.5)
        across = 0 if u >= 0 else 2
        along = 1 if v >= 0 else 3
        corner = (4 if v >= 0 else 7) if u >= 0 else (5 if v >= 0 else 6)
        a, b, c = neighbours[own, across], neighbours[own, along], neighbours[own, corner]
        ha = heights[a] if a >= 0 else heights[own]
        hb = heights[b] if b >= 0 else heights[own]
        hc = heights[c] if c >= 0 else (heights[own] if (a < 0 and b < 0) else (ha if b < 0 else hb))
        u, v = abs(u), abs(v)
        out[n] = (1 - u) * (1 - v) * heights[own] + u * (1 - v) * ha + (1 - u) * v * hb + u * v * hc
        for axis in range(2):
            plus, minus = neighbours[own, axis], neighbours[own, axis + 2]
            if plus < 0:
                plus = own
            if minus < 0:
                minus = own
            if plus != minus:
                run = cell * (2.0 if (plus != own and minus != own) else 1.0)
                slopes[n, axis] = (base[plus] + heights[plus] - base[minus] - heights[minus]) / run
