"""The cover that landed matter makes: a thickness on the scene's surfaces, never steeper than its angle of repose.

Thickness is counted upwards, on the levels of `columns`. What a particle leaves is spread over a disc, as its patch is drawn.
Where the raised surface is steeper than the angle of repose, cover runs down until it is not (`toppling`); a `film` clings to
any slope. Cover falls over edges onto what is below, and is lost where nothing is; at the border of the domain the surface is
taken to go on as it comes, under the same cover. What lies only grows. Volume is kept to round-off: deposited = held + lost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.columns import Columns
from pgsd_nerfstudio.physics.ground.toppling import topple
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
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"a cover needs a positive {name}, got {getattr(self, name):g}")
        if not 0 < self.repose_degrees < 90:
            raise ValueError(f"the angle of repose must lie in 0-90 degrees, got {self.repose_degrees:g}")
        if not 0 <= self.film < math.inf:
            raise ValueError(f"a film must not be negative, got {self.film:g} m")


class Cover:
    """Thickness of cover on every level; `deposit`, then `relax`, then ask for `height` and `normal`."""

    def __init__(self, columns: Columns, config: CoverConfig) -> None:
        self.columns, self.config = columns, config
        self.heights: Float[ndarray, " l"] = np.zeros(len(columns.base))  # m
        self.lost = 0.0  # m^3 so far that ran off where nothing is
        self._rested = self.heights.copy()  # when all of it was last at rest
        self._changed = np.zeros(len(columns.base), np.bool_)  # since they last were at rest

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, config: CoverConfig | None = None) -> Cover:
        """No cover yet, on all surfaces of a domain that look up."""
        config = config or CoverConfig()
        return Cover(Columns.of(surface, domain, config.cell, config.gap), config)

    def deposit(self, points: Float[ndarray, "n 3"], volumes: Float[ndarray, " n"], radii: Float[ndarray, " n"]) -> float:
        """Add m^3 of cover at points, each spread over a disc of its radius in metres (a paraboloid: thickest in the middle).

        The disc is horizontal and ends where its sheet does; a radius that reaches no middle of a square fills one square.
        Returns the volume of points that belong to no level, also of those that are no numbers, which is not added.

        Raises:
            ValueError: a volume or radius is negative or not finite, or there are not as many of them as points.
        """
        volumes, radii = _amounts("volumes", volumes, len(points), "m^3"), _amounts("radii", radii, len(points), "m")
        points = np.ascontiguousarray(points, np.float64)
        level = self.find(points)
        _spread(level, points, volumes, radii, self.heights, self._changed, self.columns)
        return float(volumes[level < 0].sum())

    def relax(self) -> bool:
        """Let what is too steep run down; True when all of it has found its place, False where `most_moves` was not enough.

        The next call goes on where this one stopped.
        """
        c, config = self.columns, self.config
        steep = math.tan(math.radians(config.repose_degrees)) * c.cell
        most = config.most_moves * len(self.heights)
        start = self._changed.nonzero()[0]
        left, lost = topple(start, self.heights, self._rested, c, steep, config.film, config.slack, most)
        self.lost += lost * c.cell**2
        self._changed[:] = False
        self._changed[left] = True
        if len(left) == 0:
            self._rested[:] = self.heights
        return len(left) == 0

    def find(self, points: Float[ndarray, "n 3"]) -> Int[ndarray, " n"]:
        """Level that each point belongs to: in its cover or near its surfaces; -1 where there is none."""
        return self.columns.find(points, self.heights, self.config.tolerance)

    def height(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Thickness in metres at points on or near the surface, smooth within a sheet; 0 where there is no level."""
        return _read(self.find(points), np.ascontiguousarray(points, np.float64), self.heights, self.columns)

    def above(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Height in metres of points above the bare surface beneath them, not negative; 0 where there is no level."""
        level, above = self.find(points), np.zeros(len(points))
        known = level >= 0
        above[known] = points[known, 2] - self.columns.base[level[known]]
        return above.clip(0.0)

    def normal(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Unit normals of the raised surface, smooth within a sheet; straight up where there is no level."""
        slopes = _slopes(self.find(points), np.ascontiguousarray(points, np.float64), self.heights, self.columns)
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
        changed = self._changed.nonzero()[0]
        rested = self._rested if len(changed) else self._rested[:0]  # at rest it says nothing new
        return {"heights": self.heights.copy(), "rested": rested.copy(), "changed": changed, "lost": np.array([self.lost])}

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """The state that `snapshot` gave.

        Raises:
            ValueError: it is that of another surface.
        """
        if arrays["heights"].shape != self.heights.shape:
            found = len(arrays["heights"])
            raise ValueError(f"the state of a cover with {len(self.heights)} levels was expected, got one with {found}")
        self.heights = arrays["heights"].copy()
        self._changed = np.zeros(len(self.heights), np.bool_)
        self._changed[arrays["changed"]] = True
        self._rested = (arrays["rested"] if len(arrays["changed"]) else self.heights).copy()
        self.lost = float(arrays["lost"][0])


def _amounts(name: str, values: Float[ndarray, " n"], count: int, unit: str) -> Float[ndarray, " n"]:
    values = np.ascontiguousarray(values, np.float64)
    if values.shape != (count,):
        raise ValueError(f"{name} of cover must be one for each of {count} points, got {values.shape}")
    wrong = ~(np.isfinite(values) & (values >= 0))
    if wrong.any():
        raise ValueError(f"{name} of cover must be finite and not negative, got {values[wrong][0]:g} {unit}")
    return values


@numba.njit(cache=True, nogil=True, inline="always")
def _walk(level, i, j, neighbours):
    """Level that is i and j squares away on the same sheet, diagonals first; negative where the sheet ends before."""
    right = 0 if i > 0 else 2
    ahead = 1 if j > 0 else 3
    corner = (4 if j > 0 else 7) if i > 0 else (5 if j > 0 else 6)
    i, j = abs(i), abs(j)
    while level >= 0 and (i > 0 or j > 0):
        level = neighbours[level, corner if i > 0 and j > 0 else (right if i > 0 else ahead)]
        i, j = max(i - 1, 0), max(j - 1, 0)
    return level


@numba.njit(cache=True, nogil=True)
def _spread(level, points, volumes, radii, heights, touched, columns):
    lower, cell = columns.lower, columns.cell
    nx, ny = columns.shape
    for n in range(len(level)):
        own = level[n]
        if own < 0:
            continue
        reach = int(min(radii[n] / cell, float(max(nx, ny)))) + 1
        x, y = columns.column[own] // ny, columns.column[own] % ny
        u = (points[n, 0] - lower[0]) / cell - x - 0.5
        v = (points[n, 1] - lower[1]) / cell - y - 0.5
        inverse = (cell / radii[n]) ** 2 if radii[n] > 0.0 else np.inf
        thickness, total = volumes[n] / (cell * cell), 0.0
        for passing in range(2):  # first how much weight finds a place, then the volume
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    weight = 1.0 - ((i - u) ** 2 + (j - v) ** 2) * inverse
                    if weight > 0.0:
                        onto = _walk(own, i, j, columns.neighbours)
                        if onto >= 0 and passing == 0:
                            total += weight
                        elif onto >= 0:
                            heights[onto] += thickness * weight / total
                            touched[onto] = True
            if total <= 0.0:
                heights[own] += thickness
                touched[own] = True
                break


@numba.njit(cache=True, nogil=True, inline="always")
def _around(own, u, v, columns):
    """The levels of the sheet at the corners of the square of middles around a point, and their weights; -1 for none."""
    ny = columns.shape[1]
    x, y = columns.column[own] // ny, columns.column[own] % ny
    u = min(max((u - columns.lower[0]) / columns.cell - x - 0.5, -0.5), 0.5)
    v = min(max((v - columns.lower[1]) / columns.cell - y - 0.5, -0.5), 0.5)
    i, j = (1 if u >= 0 else -1), (1 if v >= 0 else -1)
    neighbours = columns.neighbours
    levels = (own, _walk(own, i, 0, neighbours), _walk(own, 0, j, neighbours), _walk(own, i, j, neighbours))
    u, v = abs(u), abs(v)
    shares = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    return levels, shares


@numba.njit(cache=True, nogil=True)
def _read(level, points, heights, columns):
    """Bilinear thickness; where the sheet ends, the levels that exist share the weight."""
    found = np.zeros(len(level))
    for n in range(len(level)):
        if level[n] >= 0:
            levels, shares = _around(level[n], points[n, 0], points[n, 1], columns)
            total = 0.0
            for m in range(4):
                if levels[m] >= 0:
                    found[n] += shares[m] * heights[levels[m]]
                    total += shares[m]
            found[n] /= total
    return found


@numba.njit(cache=True, nogil=True)
def _slopes(level, points, heights, columns):
    """Rise per run of the raised surface along x and y: central differences at the middles, bilinear between them."""
    found = np.zeros((len(level), 2))
    for n in range(len(level)):
        if level[n] >= 0:
            levels, shares = _around(level[n], points[n, 0], points[n, 1], columns)
            total = 0.0
            for m in range(4):
                own = levels[m]
                if own < 0:
                    continue
                total += shares[m]
                for axis in range(2):
                    plus, minus = columns.neighbours[own, axis], columns.neighbours[own, axis + 2]
                    steps = (plus >= 0) + (minus >= 0)
                    plus, minus = (plus if plus >= 0 else own), (minus if minus >= 0 else own)
                    if steps > 0:
                        rise = columns.base[plus] + heights[plus] - columns.base[minus] - heights[minus]
                        found[n, axis] += shares[m] * rise / (steps * columns.cell)
            found[n] /= total
    return found
