"""Standing water: rain that runs off over the ground, gathers in its hollows, fills them and spills into the next.

The ground is a map of heights seen from above, or from below what stands on it. Hollows and the way of the water follow from a
flood of the map from its outlets upward, lowest cell first (priority-flood: Barnes, Lehman & Mulla, "Priority-flood: An optimal
depression-filling and watershed-labeling algorithm for digital elevation models", 2014). A cell gives its water to the cell
from which the flood reached it, so all of it ends in a hollow or at an outlet. A full hollow hands on what more it gets. At any
time the water that has fallen is in the film, in the hollows or has run off; nothing else takes any.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.flooding import basins_of, flood, ways_of
from pgsd_nerfstudio.physics.ground.ground_map import filled_in, ground_plane, heights_below, mended, patches, smoothed, uneven
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CELL = 0.03  # m; edge of a cell of the map
MAX_CELLS = 400_000  # of the map; larger grounds have larger cells
DEEPEST = 0.012  # m; deeper hollows drain above this depth, into soil, joints or a gully
SMOOTHED = 0.09  # m; standard deviation over which the roughness of a scanned mesh is averaged
UNDER = 0.3  # m above the ground's plane from where ground is looked for below tables and roofs
FILM = 2e-4  # m of water that clings to rough ground before any runs off
_ROUNDS = 12  # of draining deep hollows; each leaves shallower ones


@dataclass(frozen=True, eq=False)
class Pools:
    """Water in b hollows at one time, m^3, and what is elsewhere."""

    volumes: Float[ndarray, " b"]
    levels: Float[ndarray, " b"]
    """Height of each water surface, m; that of the hollow's lowest cell where it is empty."""
    film: float
    """m^3 on all ground."""
    ran_off: float
    """m^3 that have left through the outlets."""

    @property
    def held(self) -> float:
        """m^3 in film and hollows; fallen = held + ran_off."""
        return self.film + float(self.volumes.sum())


@dataclass(frozen=True, eq=False)
class StandingWater:
    """Ground with b hollows, which are numbered downstream: a hollow hands on only to one with a larger number."""

    lower: Float[ndarray, "2"]
    """Centre of the first cell, m."""
    cell: float
    """Edge of a cell, m."""
    ground: Float[ndarray, "x y"]
    """Height of each cell above the plane that counts as level, m; NaN where there is no surface."""
    level: Float[ndarray, "3"]
    """That plane: its height in metres at the origin, and its rise along x and y."""
    under_sky: Bool[ndarray, "x y"]
    """Cells that rain falls on; the others are below tables and roofs, or have no surface."""
    basin: Int[ndarray, "x y"]
    """Number of the hollow that a cell is part of, -1 for none."""
    catchment: Float[ndarray, " b"]
    """m^2 of ground whose water comes to each hollow before any other."""
    into: Int[ndarray, " b"]
    """The hollow that each one spills into, -1 for an outlet."""
    brims: Float[ndarray, " b"]
    """Height at which each hollow spills, m."""

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, *, unevenness: float, seed: int = 0) -> StandingWater:
        """The hollows of a scene's ground.

        Args:
            surface: the mesh in metres.
            domain: bounds of the map.
            unevenness: standard deviation in metres of the ground's height below what the mesh resolves.
            seed: of the unevenness.
        """
        cell = max(CELL, math.sqrt(domain.area / MAX_CELLS))
        lower = np.asarray(domain.lower[:2], float) + cell / 2
        shape = tuple(np.maximum(np.floor(np.asarray(domain.size[:2]) / cell).astype(int), 1))
        x, y = (lower[k] + cell * np.arange(shape[k]) for k in range(2))
        at = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        top = float(domain.upper[2])
        ground = heights_below(surface, at, np.full(len(at), top))
        level = ground_plane(at, ground)
        sheltered = heights_below(surface, at, level[0] + at @ level[1:] + UNDER)
        roofed = (ground > level[0] + at @ level[1:] + 1.5 * UNDER) & np.isfinite(sheltered)
        ground = np.where(roofed, sheltered, ground).reshape(shape)
        plane = (level[0] + at @ level[1:]).reshape(shape)
        ground = smoothed(mended(ground - plane, cell), SMOOTHED / cell) + unevenness * uneven(at, seed).reshape(shape)
        return StandingWater.on(ground, lower, cell, level, ~roofed.reshape(shape))

    @staticmethod
    def on(
        ground: Float[ndarray, "x y"],
        lower: Float[ndarray, "2"],
        cell: float,
        level: Float[ndarray, "3"] | None = None,
        under_sky: Bool[ndarray, "x y"] | None = None,
    ) -> StandingWater:
        """The hollows of a map of heights.

        Args:
            ground: height of each cell, m; NaN where there is no surface, which is an outlet as the border of the map is.
            lower: centre of the first cell, m.
            cell: edge of a cell, m.
            level: the plane above which the heights are; None: z = 0.
            under_sky: cells that rain falls on; None: all.
        """
        known = np.isfinite(ground)
        heights = np.where(known, ground, -np.inf)
        drains = np.full(ground.shape, -np.inf)  # height above which a cell drains into the soil; -inf: it does not
        filled, parent, order = flood(heights, drains)
        for _ in range(_ROUNDS):
            deep = known & (filled > heights + DEEPEST * 1.0001)
            labels, count = patches(deep)
            if count == 0:
                break
            lowest = np.array(ndimage.minimum_position(heights, labels, np.arange(1, count + 1)))
            drains[tuple(lowest.T)] = heights[tuple(lowest.T)] + DEEPEST
            filled, parent, order = flood(heights, drains)
        basin, count = basins_of(known & (filled > heights), filled, cell, order)
        rained_on = known if under_sky is None else known & under_sky
        into, catchment = ways_of(basin.reshape(-1), parent, order, rained_on.reshape(-1), count)
        brims = np.zeros(count)
        held = basin >= 0
        brims[basin[held]] = filled[held]
        level = np.zeros(3) if level is None else level
        return StandingWater(lower, cell, ground, level, rained_on, basin, catchment * cell**2, into, brims)

    @property
    def area(self) -> float:
        """m^2 of ground that rain falls on."""
        return float(self.under_sky.sum()) * self.cell**2

    def after(self, fallen: float) -> Pools:
        """The water after rain.

        Args:
            fallen: m of water that has fallen on all ground.
        """
        film = min(fallen, FILM)
        volumes, levels = np.zeros(len(self.into)), np.zeros(len(self.into))
        coming, ran_off = (fallen - film) * self.catchment, 0.0
        ran_off += (fallen - film) * (self.area - float(self.catchment.sum()))
        for b, (heights, volume_at) in enumerate(self._curves):
            volumes[b] = min(coming[b], volume_at[-1])
            levels[b] = np.interp(volumes[b], volume_at, heights)
            over = coming[b] - volumes[b]
            if self.into[b] >= 0:
                coming[self.into[b]] += over
            else:
                ran_off += over
        return Pools(volumes, levels, film * self.area, ran_off)

    def depth(self, pools: Pools, points: Float[ndarray, "n 2"]) -> Float[ndarray, " n"]:
        """Height in metres of the water surface above the ground, negative on dry ground beside a pool; -1 away from all pools.

        Args:
            pools: of `after`.
            points: m.
        """
        basin, floor = self.under(points)
        return depth_over(pools, basin, floor)

    def under(self, points: Float[ndarray, "n 2"]) -> tuple[Int[ndarray, " n"], Float[ndarray, " n"]]:
        """The hollow of each point, -1 for none, and the height in metres of the ground there above the level plane.

        A hollow counts up to one cell beyond its rim, so that the edge of a pool runs between the centres of cells.

        Args:
            points: m.
        """
        place = (np.asarray(points, float) - self.lower) / self.cell
        inside = np.isfinite(place).all(1)
        inside &= ((place > -0.5) & (place < np.array(self.ground.shape) - 0.5)).all(1)
        x, y = np.rint(np.where(inside[:, None], place, 0)).astype(int).T
        basin = np.where(inside, self._around[x, y], -1)
        safe = np.where(inside[:, None], place, 0.0).T
        floor = ndimage.map_coordinates(self._known, safe, order=1, mode="nearest")
        return np.where(np.isfinite(self.ground[x, y]), basin, -1), floor

    def height(self, points: Float[ndarray, "n 2"], above_level: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        """The metric z in metres of heights above the level plane.

        Args:
            points: m.
            above_level: m.
        """
        return self.level[0] + np.asarray(points, float) @ self.level[1:] + above_level

    @cached_property
    def _curves(self) -> list[tuple[Float[ndarray, " k"], Float[ndarray, " k"]]]:
        """Heights of the surface of each hollow, and its volume in m^3 at each."""
        if len(self.into) == 0:
            return []
        curves = []
        which = np.flatnonzero(self.basin >= 0)
        which = which[np.argsort(self.basin.flat[which], kind="stable")]
        for b, cells in enumerate(np.split(which, np.searchsorted(self.basin.flat[which], np.arange(1, len(self.into))))):
            heights = np.append(np.sort(self.ground.flat[cells]), self.brims[b])
            steps = np.diff(heights) * np.arange(1, len(heights)) * self.cell**2
            curves.append((heights, np.concatenate([[0.0], np.cumsum(steps)])))
        return curves

    @cached_property
    def _around(self) -> Int[ndarray, "x y"]:
        """The hollow of each cell or of the cell beside it, -1 for none."""
        beside = ndimage.maximum_filter(self.basin, 3, mode="constant", cval=-1)
        return np.where(self.basin >= 0, self.basin, beside)

    @cached_property
    def _known(self) -> Float[ndarray, "x y"]:
        """Heights of the ground; unknown cells have that of the nearest known one."""
        unknown = ~np.isfinite(self.ground)
        if unknown.all():
            return np.zeros_like(self.ground)
        return filled_in(self.ground)


def depth_over(pools: Pools, basin: Int[ndarray, " n"], floor: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Depth of water as of `StandingWater.depth`, at points of which `StandingWater.under` is known."""
    if len(pools.levels) == 0:
        return np.full(len(basin), -1.0)
    wet = (basin >= 0) & (pools.volumes[basin] > 0)
    return np.where(wet, pools.levels[basin] - floor, -1.0)
