"""The region of sight: the air where cameras see particles, and the air from which particles may still come into view.

A cell of the domain is seen if any part of it may be in a camera's pyramid of view. A cell is needed if some displacement from
it to a seen cell is possible. The bounds of the displacement after t seconds are:

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

The domain is periodic in x and y: a particle that leaves at one side enters at the opposite side. Possible displacements
therefore form one pattern on a torus, the same for all cells, and the needed cells are the seen cells convolved with that
pattern: one Fourier transform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.fft import next_fast_len

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.boundary_layer import law_of_the_wall
from pgsd_nerfstudio.scene.cameras import Cameras

CELL = 0.25  # m
MOST = 500_000  # cells; larger domains get larger cells
DEVIATIONS = 3.0  # standard deviations of gusts and of the turbulent walk
GUST_RATES = (0.2, 1.25)  # lowest and highest, as `wind` draws them: hertz times `gust_seconds`
WIDEST_SWAY, SLOWEST_SWAY = 1.7, 0.6  # bounds of the flutter's speed and hertz that `Air.newborn` draws, as factors
LAPS = 2  # times around the domain that are told apart; a particle that moves farther may be anywhere
INSTANTS = np.concatenate([[0.0], np.geomspace(1e-3, 1e6, 2048)])  # s; 1% apart


@dataclass(frozen=True)
class Sight:
    """Cells of a domain that are seen and needed; there are no cells where all air is seen."""

    lower: Float[ndarray, "3"]
    """Corner of the first cell, m."""
    cell: Float[ndarray, "3"]
    """Edges of a cell, m."""
    seen_cells: Bool[ndarray, "x y z"]
    needed_cells: Bool[ndarray, "x y z"]

    @staticmethod
    def everything() -> Sight:
        """All air is seen and needed."""
        none = np.ones((0, 0, 0), bool)
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
        seen = _seen(lower, cell, shape, _planes(cameras, distance, margin))
        needed = seen
        if seen.any():
            reach = _reach(wind, domain.upper[2], slowest, fastest)
            needed = _swept(seen, _pattern(shape, cell, reach, wind.direction_degrees))
        return Sight(lower, cell, seen, needed)

    @property
    def share(self) -> float:
        """Share of the domain that is needed, 0-1."""
        return float(self.needed_cells.mean()) if self.needed_cells.size else 1.0

    def needed(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether a particle at each point is seen or may still come into view.

        Args:
            points: m; outside of the domain x and y are wrapped and z is clipped.
        """
        return self._look_up(self.needed_cells, points)

    def seen(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether a camera may see a particle at each point.

        Args:
            points: m; outside of the domain x and y are wrapped and z is clipped.
        """
        return self._look_up(self.seen_cells, points)

    def _look_up(self, cells: Bool[ndarray, "x y z"], points: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        if not cells.size:
            return np.ones(len(points), bool)
        at = np.floor((points - self.lower) / self.cell).astype(np.int64)
        return cells.ravel()[np.ravel_multi_index(tuple(at.T), cells.shape, mode=("wrap", "wrap", "clip"))]


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


def _planes(cameras: Cameras, distance: float, margin: float) -> Float[ndarray, "t 6 4"]:
    """Planes `margin` metres outside of each pyramid of view: normal . x + offset >= 0 inside. Equal cameras are merged."""
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
    return np.unique(np.concatenate([normals @ viewmats[:, :3, :3], offsets], 2), axis=0)


def _seen(
    lower: Float[ndarray, "3"], cell: Float[ndarray, "3"], shape: Int[ndarray, "3"], planes: Float[ndarray, "t 6 4"]
) -> Bool[ndarray, "x y z"]:
    """Cells that are seen by a camera: no plane of its pyramid has the whole cell outside.

    The pyramid cuts one interval out of each column of cells.
    """
    x, y = (lower[axis] + cell[axis] * (np.arange(shape[axis]) + 0.5) for axis in range(2))
    edges = np.zeros((shape[0] * shape[1], shape[2] + 1), np.int32)  # +1 where an interval begins, -1 behind its end
    for plane in planes:
        normal, offset = plane[:, :3], plane[:, 3] + np.abs(plane[:, :3]) @ cell / 2 + 1e-6
        flat = normal[:, :1, None] * x[:, None] + normal[:, 1:2, None] * y + offset[:, None, None]
        # Height at which a plane cuts the line through a column's centres; a nearly upright plane cuts it far away.
        slope = np.where(np.abs(normal[:, 2]) < 1e-9, 1e-9, normal[:, 2])
        height = ((-flat / slope[:, None, None] - lower[2]) / cell[2] - 0.5).clip(-1, shape[2])
        first = np.ceil(height[slope > 0].max(0, initial=0.0)).astype(int).ravel()
        behind = np.floor(height[slope < 0].min(0, initial=shape[2] - 1)).astype(int).ravel() + 1
        columns = np.flatnonzero(first < behind)
        edges[columns, first[columns]] += 1
        edges[columns, behind[columns]] -= 1
    return (np.cumsum(edges, 1)[:, :-1] > 0).reshape(shape)


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
) -> Bool[ndarray, "x y dz"]:
    """Which displacements in cells are possible: x and y modulo the domain, then down by -(z - 1) ... z - 1 cells.

    Each axis gives the intervals of time in which it allows the displacement; the displacement is possible if they have one in
    common. Points in cells n apart are n - 1 to n + 1 cells apart; the bounds take the distance that is easiest to reach.
    """
    fall = cell[2] * np.arange(1 - shape[2], shape[2])
    early = np.searchsorted(reach.down, fall - cell[2])
    possible = reach.at_least_down <= (fall + cell[2])[:, None]
    early = np.maximum(early, possible.argmax(1))
    late = np.where(possible.any(1), len(reach.down) - 1 - possible[:, ::-1].argmax(1), -1)

    # All cells up to LAPS around the domain, laid out in a plane. A particle that had time to move farther may be anywhere.
    farthest = np.hypot(np.maximum(reach.with_wind, reach.against_wind), reach.across)
    size = shape[:2] * cell[:2]
    laps = np.minimum(LAPS, np.ceil(farthest[late.max()] / size)).astype(int)
    x, y = (cell[axis] * np.arange(-(laps[axis] + 1) * shape[axis], (laps[axis] + 1) * shape[axis]) for axis in range(2))
    angle = math.radians(direction_degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    along, across = cos * x[:, None] + sin * y, cos * y - sin * x[:, None]
    slack_along = abs(cos) * cell[0] + abs(sin) * cell[1]
    slack_across = abs(sin) * cell[0] + abs(cos) * cell[1]
    arrival = np.maximum(
        np.searchsorted(reach.with_wind, along - slack_along), np.searchsorted(reach.against_wind, -along - slack_along)
    )
    arrival = np.maximum(arrival, np.searchsorted(reach.across, np.abs(across) - slack_across))
    arrival = arrival.reshape(2 * (laps[0] + 1), shape[0], 2 * (laps[1] + 1), shape[1]).min((0, 2))
    arrival = np.minimum(arrival, np.searchsorted(farthest, ((laps + 1) * size - cell[:2]).min()))
    return np.maximum(arrival[:, :, None], early) <= late


def _swept(seen: Bool[ndarray, "x y z"], pattern: Bool[ndarray, "x y dz"]) -> Bool[ndarray, "x y z"]:
    """Cells from which some displacement of the pattern leads to a seen cell."""
    layers = seen.shape[2]
    # A displacement d leads from i to i + d in x and y and to i - d in z: a correlation in x and y, a convolution in z with
    # offset layers - 1.
    turned = np.roll(pattern[::-1, ::-1], 1, (0, 1)).astype(float)
    # With so many layers, entries that wrap around the end stay outside of the layers that are kept.
    shape = (*seen.shape[:2], next_fast_len(2 * layers - 1, real=True) or 0)
    spectrum = np.fft.rfftn(seen.astype(float), shape, (0, 1, 2)) * np.fft.rfftn(turned, shape, (0, 1, 2))
    return np.fft.irfftn(spectrum, shape, (0, 1, 2))[:, :, layers - 1 : 2 * layers - 1] > 0.5
