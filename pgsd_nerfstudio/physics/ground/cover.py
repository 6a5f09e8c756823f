"""The cover of landed particles: a thickness on the scene's surfaces whose top is never steeper than its angle of repose.

Thickness is measured along z on the levels of `columns`. The layer of a particle is spread over a disc, as its patch is drawn.
Where the top of the cover is steeper than the angle of repose, cover runs down (`toppling`); a `film` clings to any slope.
Cover falls over edges onto the level below, and is lost where there is none. At the border of the domain the surface is taken
to go on with the same slope, under the same cover. Cover at rest never becomes thinner. Volume is conserved to round-off:
deposited = held + lost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.columns import Columns
from pgsd_nerfstudio.physics.ground.toppling import topple
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


@dataclass(frozen=True, kw_only=True)
class CoverConfig:
    """Resolution and slopes of the cover."""

    cell: float = 0.05
    """Edge of the squares on which thickness is kept, in metres."""
    gap: float = 0.10
    """Metres. A surface closer beneath another one holds no cover of its own."""
    repose_degrees: float = 45.0
    """Angle of repose: the steepest slope of cover thicker than `film`."""
    film: float = 0.005
    """Thickness in metres that clings to any slope."""
    tolerance: float = 0.15
    """Metres that a point may be below a level or above its cover and still belong to it, since squares are sloped inside."""
    slack: float = 1e-4
    """Metres by which a level's top may be too high before cover runs down."""
    most_moves: int = 200
    """Moves of cover that one `relax` may make, per level."""

    def __post_init__(self) -> None:
        for name in ("cell", "gap", "tolerance", "slack", "most_moves"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"a cover needs a positive {name}, got {getattr(self, name):g}")
        if not 0 < self.repose_degrees < 90:
            raise ValueError(f"the angle of repose must lie in 0-90 degrees, got {self.repose_degrees:g}")
        if not 0 <= self.film < math.inf:
            raise ValueError(f"a film must not be negative, got {self.film:g} m")


class Cover:
    """Thickness of the cover on every level. Call `deposit`, then `relax`, then read `height` and `normal`."""

    def __init__(self, columns: Columns, config: CoverConfig) -> None:
        self.columns, self.config = columns, config
        self.heights: Float[ndarray, " l"] = np.zeros(len(columns.base))  # thickness, m
        self.lost = 0.0  # m^3 so far that fell where there is no level
        self._rested = self.heights.copy()  # thickness when all cover was last at rest
        self._changed = np.zeros(len(columns.base), np.bool_)  # levels whose cover has changed since it was last at rest

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, config: CoverConfig | None = None) -> Cover:
        """A cover of thickness 0 on all surfaces that face up.

        Args:
            surface: the mesh, in metres.
            domain: bounds the cover.
            config: resolution and slopes; None: the defaults.
        """
        config = config or CoverConfig()
        return Cover(Columns.of(surface, domain, config.cell, config.gap), config)

    def deposit(self, points: Float[ndarray, "n 3"], volumes: Float[ndarray, " n"], radii: Float[ndarray, " n"]) -> float:
        """Add cover at points, each spread over a horizontal disc as a paraboloid that is thickest in the middle.

        The disc ends where its sheet ends. A disc that contains no middle of a square fills one square.

        Args:
            points: m.
            volumes: m^3.
            radii: of the discs, m.

        Returns:
            The volume in m^3 that is not added because its points belong to no level or are NaN.

        Raises:
            ValueError: a volume or radius is negative or not finite, or there are not as many of them as points.
        """
        volumes, radii = _amounts("volumes", volumes, len(points), "m^3"), _amounts("radii", radii, len(points), "m")
        points = np.ascontiguousarray(points, np.float64)
        level = self.find(points)
        _spread(level, points, volumes, radii, self.heights, self._changed, self.columns)
        return float(volumes[level < 0].sum())

    def relax(self) -> bool:
        """Let cover run down where it is too steep. The next call goes on where this one stopped.

        Returns:
            True when all cover is at rest, False where `most_moves` did not suffice.
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
        """Level whose surface or cover each point is in or near; -1 where there is none.

        Args:
            points: m.
        """
        return self.columns.find(points, self.heights, self.config.tolerance)

    def height(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Thickness of the cover in metres, continuous within a sheet; 0 without a level.

        Args:
            points: m, on or near a surface.
        """
        return _read(self.find(points), np.ascontiguousarray(points, np.float64), self.heights, self.columns)

    def above(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Height in metres above the bare surface beneath each point, not negative; 0 without a level.

        Args:
            points: m.
        """
        level, above = self.find(points), np.zeros(len(points))
        known = level >= 0
        above[known] = points[known, 2] - self.columns.base[level[known]]
        return above.clip(0.0)

    def normal(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """Unit normals of the top of the cover, continuous within a sheet; straight up without a level.

        Args:
            points: m, on or near a surface.
        """
        slopes = _slopes(self.find(points), np.ascontiguousarray(points, np.float64), self.heights, self.columns)
        normal = np.column_stack([-slopes, np.ones(len(slopes))])
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @property
    def volume(self) -> float:
        """Volume of the cover, m^3."""
        return float(self.heights.sum()) * self.columns.cell**2

    @property
    def thickest(self) -> float:
        """Largest thickness, m."""
        return float(self.heights.max(initial=0.0))

    def snapshot(self) -> dict[str, ndarray]:
        """The state as arrays, for `restore`."""
        changed = self._changed.nonzero()[0]
        rested = self._rested if len(changed) else self._rested[:0]  # at rest it equals the heights
        return {"heights": self.heights.copy(), "rested": rested.copy(), "changed": changed, "lost": np.array([self.lost])}

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """Take a state from `snapshot`.

        Raises:
            ValueError: the state belongs to another surface.
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


@kernel(inline="always")
def _level_at(level, i, j, neighbours):
    """Level i and j squares away on the same sheet, reached along diagonals first; negative where the sheet ends before."""
    right = 0 if i > 0 else 2
    ahead = 1 if j > 0 else 3
    corner = (4 if j > 0 else 7) if i > 0 else (5 if j > 0 else 6)
    i, j = abs(i), abs(j)
    while level >= 0 and (i > 0 or j > 0):
        level = neighbours[level, corner if i > 0 and j > 0 else (right if i > 0 else ahead)]
        i, j = max(i - 1, 0), max(j - 1, 0)
    return level


@kernel()
def _spread(level, points, volumes, radii, heights, changed, columns):
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
        for passing in range(2):  # first sum the weights on the sheet, then spread the volume
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    weight = 1.0 - ((i - u) ** 2 + (j - v) ** 2) * inverse
                    if weight > 0.0:
                        onto = _level_at(own, i, j, columns.neighbours)
                        if onto >= 0 and passing == 0:
                            total += weight
                        elif onto >= 0:
                            heights[onto] += thickness * weight / total
                            changed[onto] = True
            if total <= 0.0:
                heights[own] += thickness
                changed[own] = True
                break


@kernel(inline="always")
def _corners(own, u, v, columns):
    """Levels of the sheet at the four middles of squares around a point, negative where there is none, and their weights."""
    ny = columns.shape[1]
    x, y = columns.column[own] // ny, columns.column[own] % ny
    u = min(max((u - columns.lower[0]) / columns.cell - x - 0.5, -0.5), 0.5)
    v = min(max((v - columns.lower[1]) / columns.cell - y - 0.5, -0.5), 0.5)
    i, j = (1 if u >= 0 else -1), (1 if v >= 0 else -1)
    neighbours = columns.neighbours
    levels = (own, _level_at(own, i, 0, neighbours), _level_at(own, 0, j, neighbours), _level_at(own, i, j, neighbours))
    u, v = abs(u), abs(v)
    shares = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    return levels, shares


@kernel()
def _read(level, points, heights, columns):
    """Bilinear thickness; where the sheet ends, the existing levels share the weight."""
    found = np.zeros(len(level))
    for n in range(len(level)):
        if level[n] >= 0:
            levels, shares = _corners(level[n], points[n, 0], points[n, 1], columns)
            total = 0.0
            for m in range(4):
                if levels[m] >= 0:
                    found[n] += shares[m] * heights[levels[m]]
                    total += shares[m]
            found[n] /= total
    return found


@kernel()
def _slopes(level, points, heights, columns):
    """Rise per run of the top of the cover along x and y: central differences at the middles, bilinear between them."""
    found = np.zeros((len(level), 2))
    for n in range(len(level)):
        if level[n] >= 0:
            levels, shares = _corners(level[n], points[n, 0], points[n, 1], columns)
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
