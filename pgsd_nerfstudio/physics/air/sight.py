"""The region of sight: the air where cameras see particles, and the air from which particles may still come into view.

A cell of the domain is seen if any part of it may be in a camera's pyramid of view, from the distance of the nearest camera
that sees it. A cell is needed if some displacement from it to a seen cell is possible, and its distance is the least of those
cells: a particle is simulated where it may come within its reach (`reach`) of a camera. The bounds of the displacement after t
seconds are:

- Down, it is between slowest t - r(t) and fastest t + r(t), from the range of terminal speeds.
- Along the mean wind, it is between -G(t) - r(t) and full t + G(t) + r(t). The mean wind is anything from 0 (near the ground,
  in the lee of obstacles) to `full`, the wind at the top of the domain. Across the wind it is G(t) / 2 + r(t) to either side.
- G bounds the gusts by DEVIATIONS standard deviations. A sine of frequency f and variance 1 in the wind moves air no farther
  than min(t, 1 / (pi f)) in the mean square, and `wind` draws f evenly in log f between the ends of GUST_RATES / gust_seconds.
  The growth of the wind with height adds nothing for a falling particle (second mean value theorem).
- r bounds a random walk by DEVIATIONS standard deviations. The walk has the rms and the eddy time T = (largest eddy) / (2 pi
  (rms + slowest / 4)) of the turbulence and the variance 2 rms^2 T (t - T (1 - exp(-t / T))) (Taylor, "Diffusion by continuous
  movements", 1922: straight at first, then diffusion). The quarter was fitted to the walks of falling particles, which pass
  slowly through eddies along their path. The diffusivity adds to the variance, and the widest circle of the flutter to the
  horizontal bounds.

Inertia adds nothing, since velocities under drag are means of past settled velocities.

Possible displacements form one pattern, the same for all cells, and the needed cells are the seen cells convolved with that
pattern: one Fourier transform for the cells within each of a ladder of distances, whose steps are NEARER.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.fft import irfftn, next_fast_len, rfftn

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.boundary_layer import law_of_the_wall
from pgsd_nerfstudio.scene.cameras import Cameras

CELL = 0.25  # m
MOST = 150_000  # cells; larger domains get larger cells
CLOSEST = 0.4  # m; nearer to a camera no more particles are told apart than at this distance
NEARER = 1.15  # ratio of the distances that are told apart; a needed cell takes the lower one
DEVIATIONS = 3.0  # standard deviations of gusts and of the turbulent walk
GUST_RATES = (0.2, 1.25)  # lowest and highest, as `wind` draws them: hertz times `gust_seconds`
WIDEST_SWAY, SLOWEST_SWAY = 1.7, 0.6  # bounds of the flutter's speed and hertz that `Air.newborn` draws, as factors
INSTANTS = np.concatenate([[0.0], np.geomspace(1e-3, 1e6, 2048)])  # s; 1% apart


@dataclass(frozen=True)
class Sight:
    """Cells of a domain, and how near cameras come to them; there are no cells where all air is seen."""

    lower: Float[ndarray, "3"]
    """Corner of the first cell, m."""
    cell: Float[ndarray, "3"]
    """Edges of a cell, m."""
    seen_distances: Float[ndarray, "x y z"]
    """Distance in metres, float32, of the nearest camera that sees a part of each cell; infinite where none does."""
    needed_distances: Float[ndarray, "x y z"]
    """Least distance in metres, float32, at which a particle of each cell is or may come to be seen, at least CLOSEST; infinite
    where it never is."""

    @staticmethod
    def everything() -> Sight:
        """All air is seen and needed, from no distance."""
        none = np.ones((0, 0, 0), np.float32)
        return Sight(np.zeros(3), np.ones(3), none, none)

    @staticmethod
    def of(
        domain: Domain, cameras: Cameras, *, distance: float, margin: float, slowest: float, fastest: float, wind: Wind
    ) -> Sight:
        """The region of sight of cameras; without cameras, everything.

        Args:
            domain: the simulated air.
            cameras: rigid, in metres.
            distance: depth in metres up to which particles are seen.
            margin: metres by which each pyramid of view is widened.
            slowest: smallest terminal speed of the particles, m/s.
            fastest: largest terminal speed of the particles, m/s.
            wind: the wind that carries them.

        Raises:
            ValueError: a length or speed is negative or infinite, or slowest > fastest.
        """
        if not (0 < distance < math.inf and 0 <= margin < math.inf):
            raise ValueError(f"sight needs a finite distance > 0 and margin >= 0, got {distance:g} m and {margin:g} m")
        if not 0 <= slowest <= fastest < math.inf:
            raise ValueError(f"fall speeds must be 0 <= slowest <= fastest, got {slowest:g} and {fastest:g} m/s")
        if len(cameras) == 0:
            return Sight.everything()
        lower, size = np.asarray(domain.lower, float), np.asarray(domain.size, float)
        shape = _shape(size)
        cell = size / shape
        seen = np.full(tuple(shape), np.inf, np.float32)
        _see(seen, lower, cell, *_views(cameras, distance, margin))
        needed = seen
        if np.isfinite(seen).any():
            reach = _reach(wind, domain.upper[2], slowest, fastest)
            needed = _swept(seen, _pattern(shape, cell, reach, wind.direction_degrees))
        return Sight(lower, cell, seen, needed)

    @property
    def seen_cells(self) -> Bool[ndarray, "x y z"]:
        """Cells that a camera may see."""
        return np.isfinite(self.seen_distances)

    @property
    def needed_cells(self) -> Bool[ndarray, "x y z"]:
        """Cells that are seen, or from which a particle may come into view."""
        return np.isfinite(self.needed_distances)

    @property
    def share(self) -> float:
        """Share of the domain that is needed, 0-1."""
        return float(self.needed_cells.mean()) if self.needed_distances.size else 1.0

    def needed(self, points: Float[ndarray, "n 3"], reaches: Float[ndarray, " n"] | None = None) -> Bool[ndarray, " n"]:
        """Whether a particle at each point is seen within its reach, or may still come to be.

        Args:
            points: m; outside of the domain that of the nearest cell counts.
            reaches: m; None: at any distance.
        """
        distances = self.distances(points)
        return np.isfinite(distances) if reaches is None else distances <= reaches

    def distances(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Least distances in metres at which particles at these points are or may come to be seen; infinite for never.

        Args:
            points: m; outside of the domain that of the nearest cell counts.
        """
        return self._look_up(self.needed_distances, points)

    def seen(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether a camera may see a particle at each point.

        Args:
            points: m; outside of the domain that of the nearest cell counts.
        """
        return np.isfinite(self._look_up(self.seen_distances, points))

    def _look_up(self, cells: Float[ndarray, "x y z"], points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        if not cells.size:
            return np.zeros(len(points), np.float32)
        at = np.floor((points - self.lower) / self.cell).astype(np.int64)
        return cells.ravel()[np.ravel_multi_index(tuple(at.T), cells.shape, mode="clip")]


class Reach(NamedTuple):
    """Bounds of a particle's displacement in metres within each of the intervals between INSTANTS."""

    with_wind: Float[ndarray, " t"]
    against_wind: Float[ndarray, " t"]
    across: Float[ndarray, " t"]
    down: Float[ndarray, " t"]
    at_least_down: Float[ndarray, " t"]


def _shape(size: Float[ndarray, "3"]) -> Int[ndarray, "3"]:
    """Number of cells along each axis of a domain with `size` in metres."""
    cell = max(CELL, (size.prod() / MOST) ** (1 / 3))
    while np.ceil(size / cell).prod() > MOST:
        cell *= 1.01
    return np.ceil(size / cell).astype(int)


def _views(cameras: Cameras, distance: float, margin: float) -> tuple[Float[ndarray, "t 6 4"], Float[ndarray, "t 3"]]:
    """Planes `margin` metres outside of each pyramid of view, and the cameras' centres; equal cameras are merged.

    A plane is (normal, offset) with normal . x + offset >= 0 inside.
    """
    viewmats = cameras.viewmats.detach().cpu().double().numpy()
    corners = np.array([[0, 0, 1], [cameras.width, 0, 1], [cameras.width, cameras.height, 1], [0, cameras.height, 1]], float)
    rays = corners @ np.linalg.inv(cameras.Ks.detach().cpu().double().numpy()).transpose(0, 2, 1)
    sides = np.cross(rays, np.roll(rays, -1, 1))
    sides *= np.sign((sides * rays.mean(1, keepdims=True)).sum(2, keepdims=True))
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    depth = np.broadcast_to([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], (len(cameras), 2, 3))
    normals = np.concatenate([sides, depth], 1)
    offsets = normals @ viewmats[:, :3, 3:] + margin
    offsets[:, 5] += distance
    planes = np.concatenate([normals @ viewmats[:, :3, :3], offsets], 2)
    centers = -(viewmats[:, :3, :3].transpose(0, 2, 1) @ viewmats[:, :3, 3:])[:, :, 0]
    _, first = np.unique(planes.reshape(len(planes), -1), axis=0, return_index=True)
    return planes[first], centers[first]


@kernel()
def _see(seen, lower, cell, planes, centers):
    """Lower `seen` [x, y, z], metres, to the distance of a camera from each cell that no plane of its pyramid has outside."""
    half = 0.5 * math.sqrt(cell[0] ** 2 + cell[1] ** 2 + cell[2] ** 2)
    for view in range(len(planes)):
        for i in range(seen.shape[0]):
            x = lower[0] + cell[0] * (i + 0.5)
            for j in range(seen.shape[1]):
                y = lower[1] + cell[1] * (j + 0.5)
                first, last = 0.0, float(seen.shape[2] - 1)
                for plane in planes[view]:
                    slack = abs(plane[0]) * cell[0] + abs(plane[1]) * cell[1] + abs(plane[2]) * cell[2]
                    # The plane's value at the middle of the column's cell k is flat + rise k.
                    rise = plane[2] * cell[2]
                    flat = plane[0] * x + plane[1] * y + plane[2] * (lower[2] + 0.5 * cell[2]) + plane[3] + 0.5 * slack + 1e-6
                    if abs(rise) < 1e-9:
                        if flat < 0:
                            last = -1.0
                    elif rise > 0:
                        first = max(first, math.ceil(-flat / rise))
                    else:
                        last = min(last, math.floor(-flat / rise))
                for k in range(int(first), int(last) + 1):
                    z = lower[2] + cell[2] * (k + 0.5)
                    away = math.sqrt((x - centers[view, 0]) ** 2 + (y - centers[view, 1]) ** 2 + (z - centers[view, 2]) ** 2)
                    seen[i, j, k] = min(seen[i, j, k], max(away - half, 0.0))


def _reach(wind: Wind, top: float, slowest: float, fastest: float) -> Reach:
    """Bounds of the displacement, see the module. All grow with time except `at_least_down`, which may be negative at first."""
    begin, end = INSTANTS[:-1], INSTANTS[1:]
    full = wind.speed * float(law_of_the_wall(np.array([top]), wind.roughness, wind.reference_height)[0])
    still = wind.gust_seconds / (math.pi * np.geomspace(*GUST_RATES, 64))
    gust = DEVIATIONS * full * wind.gustiness * np.sqrt((np.minimum(end[:, None], still) ** 2).mean(1))
    variance = 2 * wind.diffusivity * end
    if wind.turbulence > 0:
        eddy = wind.largest_eddy / (2 * math.pi * (wind.turbulence + slowest / 4))
        # t - T (1 - exp(-t / T)); for small t that is a small difference, which t^2 / (2 T) bounds
        slowed = np.minimum(end + eddy * np.expm1(-end / eddy), end**2 / (2 * eddy))
        variance = variance + 2 * wind.turbulence**2 * eddy * slowed
    walk = DEVIATIONS * np.sqrt(variance)
    sway = WIDEST_SWAY * wind.flutter * end
    if wind.flutter_hertz > 0:
        sway = np.minimum(sway, WIDEST_SWAY * wind.flutter / (math.pi * SLOWEST_SWAY * wind.flutter_hertz))
    return Reach(
        with_wind=full * end + gust + walk + sway,
        against_wind=gust + walk + sway,
        across=gust / 2 + walk + sway,
        down=fastest * end + walk,
        at_least_down=slowest * begin - walk,
    )


def _pattern(
    shape: Int[ndarray, "3"], cell: Float[ndarray, "3"], reach: Reach, direction_degrees: float
) -> Bool[ndarray, "dx dy dz"]:
    """Which displacements in cells are possible: by -(n - 1) ... n - 1 cells along x, along y, and down.

    Each axis gives the intervals of time in which it allows the displacement; the displacement is possible if they have one in
    common. Points in cells n apart are n - 1 to n + 1 cells apart; the bounds take the distance that is easiest to reach.
    """
    fall = cell[2] * np.arange(1 - shape[2], shape[2])
    early = np.searchsorted(reach.down, fall - cell[2])
    possible = reach.at_least_down <= (fall + cell[2])[:, None]
    early = np.maximum(early, possible.argmax(1))
    late = np.where(possible.any(1), len(reach.down) - 1 - possible[:, ::-1].argmax(1), -1)

    x, y = (cell[axis] * np.arange(1 - shape[axis], shape[axis]) for axis in range(2))
    angle = math.radians(direction_degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    along, across = cos * x[:, None] + sin * y, cos * y - sin * x[:, None]
    slack_along = abs(cos) * cell[0] + abs(sin) * cell[1]
    slack_across = abs(sin) * cell[0] + abs(cos) * cell[1]
    arrival = np.maximum(
        np.searchsorted(reach.with_wind, along - slack_along), np.searchsorted(reach.against_wind, -along - slack_along)
    )
    arrival = np.maximum(arrival, np.searchsorted(reach.across, np.abs(across) - slack_across))
    return np.maximum(arrival[:, :, None], early) <= late


def _swept(seen: Float[ndarray, "x y z"], pattern: Bool[ndarray, "dx dy dz"]) -> Float[ndarray, "x y z"]:
    """Least distance of the seen cells to which the displacements of the pattern lead from each cell.

    Args:
        seen: m; infinite where a cell is not seen.
        pattern: possible displacements.
    """
    # A displacement d leads from i to i + d in x and y and to i - d in z: a correlation in x and y, a convolution in z. With
    # transforms of 2 n - 1 entries along each axis, those that wrap around the end stay outside of the n that are kept.
    shape = tuple(next_fast_len(2 * count - 1, real=True) or 0 for count in seen.shape)
    # Single precision tells 0 from 1 in sums of fewer than a million terms.
    steps = np.asarray(rfftn(pattern[::-1, ::-1].astype(np.float32), shape))
    kept = tuple(slice(count - 1, 2 * count - 1) for count in seen.shape)
    found = np.full(seen.shape, np.inf, np.float32)
    farthest, distance = float(seen[np.isfinite(seen)].max()), CLOSEST
    while True:
        within = seen <= NEARER * distance
        if within.any():
            reached = np.asarray(irfftn(np.asarray(rfftn(within.astype(np.float32), shape)) * steps, shape))
            needed = reached[kept] > 0.5
            found = np.where(needed & np.isinf(found), np.float32(distance), found)
        if NEARER * distance >= farthest:
            return found
        distance *= NEARER
