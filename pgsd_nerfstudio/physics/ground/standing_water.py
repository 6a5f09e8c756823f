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
from typing import Any

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CELL = 0.03  # m; edge of a cell of the map
MAX_CELLS = 400_000  # of the map; larger grounds have larger cells
DEEPEST = 0.012  # m; deeper hollows drain above this depth, into soil, joints or a gully
SMOOTHED = 0.09  # m; standard deviation over which the roughness of a scanned mesh is averaged
MENDED = (0.27, 0.12, 0.1)  # m, m, m^2: width of the median that takes dents out of a mesh, deepest dent, largest hole
UNDER = 0.3  # m above the ground's plane from where ground is looked for below tables and roofs
LEVELLED = (0.15, 0.10, 0.06, 0.04, 0.03, 0.03)  # m around the ground within which heights tell its plane, round by round
TILTED = 2.5  # degrees by which a capture's up may be wrong
SAME = 0.04  # m; greatest difference in height of neighbouring cells of one surface
WAVES = (0.25, 2.0)  # m; shortest and longest wavelength of the unevenness that a mesh does not resolve
SMALLEST = 0.01  # m^2; smaller hollows hold no water that one would see as a puddle
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
        top = domain.upper[2]
        ground = heights_below(surface, at, np.full(len(at), top))
        level = _level(at, ground)
        sheltered = heights_below(surface, at, level[0] + at @ level[1:] + UNDER)
        roofed = (ground > level[0] + at @ level[1:] + 1.5 * UNDER) & np.isfinite(sheltered)
        ground = np.where(roofed, sheltered, ground).reshape(shape)
        plane = (level[0] + at @ level[1:]).reshape(shape)
        ground = _smoothed(_mended(ground - plane, cell), SMOOTHED / cell) + unevenness * _uneven(at, seed).reshape(shape)
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
            labels, count = _patches(deep)
            if count == 0:
                break
            lowest = np.array(ndimage.minimum_position(heights, labels, np.arange(1, count + 1)))
            drains[tuple(lowest.T)] = heights[tuple(lowest.T)] + DEEPEST
            filled, parent, order = flood(heights, drains)
        basin, count = _basins(known & (filled > heights), filled, cell, order)
        rained_on = known if under_sky is None else known & under_sky
        into, catchment = _ways(basin.reshape(-1), parent, order, rained_on.reshape(-1), count)
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
        return _filled_in(self.ground)


def depth_over(pools: Pools, basin: Int[ndarray, " n"], floor: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Depth of water as of `StandingWater.depth`, at points of which `StandingWater.under` is known."""
    if len(pools.levels) == 0:
        return np.full(len(basin), -1.0)
    wet = (basin >= 0) & (pools.volumes[basin] > 0)
    return np.where(wet, pools.levels[basin] - floor, -1.0)


def heights_below(surface: SurfaceMesh, at: Float[ndarray, "n 2"], start: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Height of the first surface below places, m; NaN where there is none or where its underside is met.

    Args:
        surface: the mesh in metres.
        at: places, m.
        start: heights above them, m.
    """
    origins = np.concatenate([at, start[:, None]], 1).astype(np.float32)
    down = np.zeros_like(origins)
    down[:, 2] = -1.0
    hits = surface.cast(origins, down)
    distance, upward = hits.distance.numpy().astype(np.float64), hits.normal.numpy()[:, 2] > 0
    return np.where(np.isfinite(distance) & upward, start - distance, np.nan)


def _level(at: Float[ndarray, "n 2"], heights: Float[ndarray, " n"]) -> Float[ndarray, "3"]:
    """The plane of the ground if it is nearly level, else that of z = 0.

    The up of a capture is known to a degree or two only, and water would run off ground that is level in truth.
    """
    known = np.isfinite(heights)
    columns = np.concatenate([np.ones((len(at), 1)), at], 1)
    plane = np.zeros(3)
    for band in LEVELLED:
        near = known & (np.abs(heights - columns @ plane) < band)
        if near.sum() < 3:
            return np.zeros(3)
        plane = np.linalg.lstsq(columns[near], heights[near], rcond=None)[0]
    return plane if math.hypot(*plane[1:]) < math.tan(math.radians(TILTED)) else np.zeros(3)


def _patches(cells: Bool[ndarray, "x y"]) -> tuple[Int[ndarray, "x y"], int]:
    """Number from 1 on of the connected patch of each cell, 0 outside, and how many there are."""
    found: Any = ndimage.label(cells, np.ones((3, 3)))
    return found


def _filled_in(ground: Float[ndarray, "x y"]) -> Float[ndarray, "x y"]:
    """Heights of which unknown ones are those of the nearest known cell."""
    nearest: Any = ndimage.distance_transform_edt(~np.isfinite(ground), return_distances=False, return_indices=True)
    return ground[tuple(nearest)]


def _mended(ground: Float[ndarray, "x y"], cell: float) -> Float[ndarray, "x y"]:
    """Heights without the small holes and dents of a scanned mesh, through which no water leaves."""
    width, dent, hole = MENDED
    unknown = ~np.isfinite(ground)
    if unknown.all():
        return ground
    labels, count = _patches(unknown)
    small = np.append(False, np.bincount(labels.ravel(), minlength=count + 1)[1:] * cell**2 < hole)
    whole = _filled_in(ground)
    median = ndimage.median_filter(whole, size=2 * round(width / cell / 2) + 1, mode="nearest")
    flat = np.where(np.abs(whole - median) < dent, median, whole)
    return np.where(unknown & ~small[labels], np.nan, flat)


def _smoothed(ground: Float[ndarray, "x y"], sigma: float) -> Float[ndarray, "x y"]:
    """Heights averaged over neighbours of the same surface, so that tables and walls keep their edges."""
    result = ground
    for _ in range(max(round(2 * sigma**2), 1)):  # each round adds half a cell squared to the variance along both axes
        total, weight = np.nan_to_num(result), np.isfinite(result).astype(float)
        own = total.copy()
        for axis in range(2):
            for step in (1, -1):
                other = np.roll(result, step, axis)
                same = np.abs(other - result) < SAME  # false where either is unknown
                edge = 0 if step == 1 else -1
                np.moveaxis(same, axis, 0)[edge] = False
                total = total + np.where(same, np.nan_to_num(other), 0.0) * 0.5
                weight = weight + 0.5 * same
        result = np.where(weight > 0, total / np.maximum(weight, 1e-9), own)
        result = np.where(np.isfinite(ground), result, np.nan)
    return result


def _uneven(points: Float[ndarray, "n 2"], seed: int) -> Float[ndarray, " n"]:
    """A smooth random function of place with mean square 1; longer waves are higher."""
    rng = np.random.default_rng([seed, 0x0B01])
    shortest, longest = WAVES
    lengths = longest * (shortest / longest) ** rng.random(40)
    turns, phases = rng.random((2, 40)) * 2 * np.pi
    heights = lengths / np.sqrt((lengths**2).sum())
    result = np.zeros(len(points))
    for length, turn, phase, height in zip(lengths, turns, phases, heights, strict=True):
        along = points[:, 0] * math.cos(turn) + points[:, 1] * math.sin(turn)
        result += math.sqrt(2) * height * np.sin(2 * np.pi * along / length + phase)
    return result


def _basins(
    water: ndarray, filled: Float[ndarray, "x y"], cell: float, order: Int[ndarray, " n"]
) -> tuple[Int[ndarray, "x y"], int]:
    """Number of the hollow of each cell, those reached by the flood last first, and how many there are.

    The flood goes upstream, so a hollow that it reaches later can only spill into one that it reached before.
    """
    if not water.any():
        return np.full(water.shape, -1), 0
    labels, _ = _patches(water)
    # Neighbouring hollows of different level touch where one spills into the other.
    levels = np.unique(np.stack([labels[water], filled[water].view(np.int64)]), axis=1, return_inverse=True)
    separate = np.zeros(water.shape, int)
    separate[water] = np.ravel(levels[1]) + 1
    count = levels[0].shape[1]
    large = np.bincount(separate.ravel(), minlength=count + 1) * cell**2 >= SMALLEST
    large[0] = False
    reached = np.full(count + 1, -1)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    np.maximum.at(reached, separate.ravel(), rank)
    kept = np.flatnonzero(large)
    kept = kept[np.argsort(-reached[kept])]
    number = np.full(count + 1, -1)
    number[kept] = np.arange(len(kept))
    return number[separate], len(kept)


@numba.njit(cache=True)
def flood(heights: ndarray, drains: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Flood a map from its border, from unknown cells (-inf) and from drains upward.

    Args:
        heights: [x, y] m.
        drains: [x, y] height above which a cell drains, m; -inf: it does not.

    Returns:
        The filled heights; the cell, as a flat index, from which the flood reached each cell, -1 for an outlet; and all cells
        in the order in which the flood left them.
    """
    nx, ny = heights.shape
    n = nx * ny
    filled = np.full(n, np.inf)
    parent = np.full(n, -1, np.int64)
    order = np.empty(n, np.int64)
    heap_height = np.empty(n + 1)
    heap_cell = np.empty(n + 1, np.int64)
    size = 0
    seen = np.zeros(n, np.bool_)
    for i in range(nx):
        for j in range(ny):
            at = i * ny + j
            edge = i == 0 or j == 0 or i == nx - 1 or j == ny - 1 or heights[i, j] == -np.inf
            if edge or drains[i, j] > -np.inf:
                filled[at] = heights[i, j] if edge else max(heights[i, j], drains[i, j])
                seen[at] = True
                size = _push(heap_height, heap_cell, size, filled[at], at)
    done = 0
    while size > 0:
        level, at = heap_height[0], heap_cell[0]
        size = _pop(heap_height, heap_cell, size)
        order[done] = at
        done += 1
        i, j = at // ny, at % ny
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b = i + di, j + dj
                if a < 0 or b < 0 or a >= nx or b >= ny:
                    continue
                other = a * ny + b
                if not seen[other]:
                    seen[other] = True
                    filled[other] = max(level, heights[a, b])
                    parent[other] = at
                    size = _push(heap_height, heap_cell, size, filled[other], other)
    return filled.reshape(nx, ny), parent, order


@numba.njit(cache=True)
def _push(heights: ndarray, cells: ndarray, size: int, height: Any, cell: int) -> int:
    """Add to a binary heap; returns its size."""
    at = size
    while at > 0:
        up = (at - 1) // 2
        if heights[up] <= height:
            break
        heights[at], cells[at] = heights[up], cells[up]
        at = up
    heights[at], cells[at] = height, cell
    return size + 1


@numba.njit(cache=True)
def _pop(heights: ndarray, cells: ndarray, size: int) -> int:
    """Remove the lowest of a binary heap; returns its size."""
    size -= 1
    height, cell = heights[size], cells[size]
    at = 0
    while True:
        down = 2 * at + 1
        if down >= size:
            break
        if down + 1 < size and heights[down + 1] < heights[down]:
            down += 1
        if heights[down] >= height:
            break
        heights[at], cells[at] = heights[down], cells[down]
        at = down
    heights[at], cells[at] = height, cell
    return size


@numba.njit(cache=True)
def _ways(basin: ndarray, parent: ndarray, order: ndarray, rained_on: ndarray, count: int) -> tuple[ndarray, ndarray]:
    """The hollow that each hollow spills into, and the number of cells whose water comes to each first."""
    n = len(order)
    first = np.full(n, -1, np.int64)  # hollow that a cell's water comes to first
    into = np.full(count, -1, np.int64)
    catchment = np.zeros(count)
    for k in range(n):  # downstream cells come first
        at = order[k]
        own, way = basin[at], parent[at]
        below = first[way] if way >= 0 else -1
        first[at] = own if own >= 0 else below
        if own >= 0 and below != own:
            into[own] = below
        if rained_on[at] and first[at] >= 0:
            catchment[first[at]] += 1.0
    return into, catchment
