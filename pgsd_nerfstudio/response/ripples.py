"""Ripples on standing water: the rings of the drops that fell into it, which spread and fade (physics.laws.water_waves)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.effects.matter import Material
from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.ground.standing_water import StandingWater
from pgsd_nerfstudio.physics.laws.water_waves import Ring, crater_depth
from pgsd_nerfstudio.response.impacts import Impacts

SPREADS = (0.0025, 0.0035, 0.0050)  # m; craters of the tables
CRATER = 1.3  # spread of a crater relative to the diameter of its drop
WAVES = 0.05  # share of an impact's energy that goes into waves; a drop leaves most of it to the splash
DEPTH = 0.006  # m, of the water of all rings
SECONDS, RADIUS, DT, DR = 0.7, 0.3, 0.001, 0.0005  # length, reach and steps of the tables
NEAR_GROUND = 0.03  # m; a drop that ends so near to the ground of a hollow has fallen into it
MOST = 1500  # rings at a time, those of the deepest craters; what smaller drops add is lost among them
STEEPEST = 0.5  # slope that linear waves do not exceed here
BIN = 0.12  # m; edge of the squares by which points near a ring are found


@dataclass(frozen=True, eq=False)
class Ripples:
    """The rings of i impacts, in the order of time."""

    times: Float[ndarray, " i"]
    """Seconds from the beginning of the weather."""
    places: Float[ndarray, "i 2"]
    """Metres."""
    depths: Float[ndarray, " i"]
    """Of the craters, m."""
    tables: Int[ndarray, " i"]
    """Number of the table of each ring."""

    @staticmethod
    def of(impacts: Impacts, water: StandingWater, material: Material) -> Ripples:
        """The rings of the drops that fell into hollows.

        Args:
            impacts: of drops.
            water: the hollows.
            material: gives the mass of a drop.
        """
        basin, floor = water.under(impacts.places[:, :2])
        above = impacts.places[:, 2] - water.height(impacts.places[:, :2], floor)
        hits = impacts.select((basin >= 0) & (np.abs(above) < NEAR_GROUND))
        energy = WAVES * 0.5 * np.asarray(material.mass(hits.diameters)) * hits.speeds**2
        table = np.abs(np.log(CRATER * hits.diameters[:, None] / np.array(SPREADS))).argmin(1)
        return Ripples(hits.times, hits.places[:, :2], crater_depth(energy, np.array(SPREADS)[table]), table)

    def active(self, seconds: float) -> tuple[int, int]:
        """First and exclusive last number of the impacts whose rings move at a second."""
        first, last = np.searchsorted(self.times, [seconds - SECONDS + DT, seconds])
        return int(first), int(last)

    def slopes(self, points: Float[ndarray, "n 2"], seconds: float) -> Float[ndarray, "n 2"]:
        """Slopes of the water along x and y.

        Args:
            points: m.
            seconds: since the beginning of the weather.
        """
        first, last = self.active(seconds)
        result = np.zeros((len(points), 2))
        if first == last or len(points) == 0:
            return result
        lower = points.min(0) - 1e-6
        shape = np.floor((points.max(0) - lower) / BIN).astype(np.int64) + 1
        bins = np.floor((points - lower) / BIN).astype(np.int64)
        key = bins[:, 0] * shape[1] + bins[:, 1]
        order = np.argsort(key, kind="stable")
        starts = np.searchsorted(key[order], np.arange(shape[0] * shape[1] + 1))
        which = np.arange(first, last)
        if len(which) > MOST:
            which = which[np.argpartition(-self.depths[which], MOST)[:MOST]]
        rings = (self.places[which], seconds - self.times[which], self.depths[which], self.tables[which])
        found = _add(np.ascontiguousarray(points[order]), starts, lower, shape, *rings, _tables())
        result[order] = found
        size = np.hypot(*result.T)[:, None]
        return result / np.maximum(1.0, size / STEEPEST)

    @property
    def count(self) -> int:
        """Number of impacts."""
        return len(self.times)


@lru_cache(maxsize=1)
def _tables() -> Float[ndarray, "k t r"]:
    """Slopes of rings of craters of 1 m depth."""
    size = {"seconds": SECONDS, "radius": RADIUS, "dt": DT, "dr": DR}
    return np.stack([Ring.of(spread, DEPTH, **size).slopes for spread in SPREADS])


@lru_cache(maxsize=1)
def crests() -> tuple[Float[ndarray, "k t 2"], Float[ndarray, "k t 2"]]:
    """Radii in metres of the steepest place of each ring and of that of the other sign beside it, and their slopes."""
    tables = _tables()
    radii = np.arange(tables.shape[2]) * DR
    # What matters to the eye is the slope times the length of the crest's arc.
    first = (np.abs(tables) * np.sqrt(radii)).argmax(2)
    at = np.take_along_axis(tables, first[:, :, None], 2)[:, :, 0]
    near = np.exp(-((radii - radii[first][:, :, None]) ** 2) / (2 * 0.012**2))
    second = (np.maximum(-tables * np.sign(at)[:, :, None], 0) * near).argmax(2)
    beside = np.take_along_axis(tables, second[:, :, None], 2)[:, :, 0]
    return np.stack([radii[first], radii[second]], -1), np.stack([at, beside], -1)


@kernel()
def _add(
    points: ndarray, starts: ndarray, lower: ndarray, shape: ndarray,
    places: ndarray, ages: ndarray, depths: ndarray, numbers: ndarray, tables: ndarray,
) -> ndarray:  # fmt: skip
    """Sum of the slopes of rings at points that are sorted by square; `starts` has the first point of each square."""
    found = np.zeros((len(points), 2))
    for i in range(len(places)):
        when = ages[i] / DT
        row = int(when)
        if row + 1 >= tables.shape[1]:
            continue
        late = when - row
        table = tables[numbers[i]]
        reach = min(RADIUS, 0.05 + 0.6 * ages[i])  # waves of these lengths are not faster
        x, y = places[i]
        left, right = math.floor((x - reach - lower[0]) / BIN), math.floor((x + reach - lower[0]) / BIN)
        near, away = math.floor((y - reach - lower[1]) / BIN), math.floor((y + reach - lower[1]) / BIN)
        for a in range(max(left, 0), min(right, shape[0] - 1) + 1):
            begin, end = max(near, 0), min(away, shape[1] - 1)
            if begin > end:
                continue
            for n in range(starts[a * shape[1] + begin], starts[a * shape[1] + end + 1]):
                dx, dy = points[n, 0] - x, points[n, 1] - y
                r = math.sqrt(dx * dx + dy * dy)
                if r >= reach or r < 1e-4:
                    continue
                place = r / DR
                column = int(place)
                if column + 1 >= tables.shape[2]:
                    continue
                part = place - column
                now = table[row, column] * (1 - part) + table[row, column + 1] * part
                then = table[row + 1, column] * (1 - part) + table[row + 1, column + 1] * part
                slope = depths[i] * (now * (1 - late) + then * late) / r
                found[n, 0] += slope * dx
                found[n, 1] += slope * dy
    return found


def tilted(slopes: Float[ndarray, "n 2"]) -> torch.Tensor:
    """Unit normals [n, 3] of water of these slopes."""
    normals = np.concatenate([-slopes, np.ones((len(slopes), 1))], 1)
    return torch.from_numpy(normals / np.linalg.norm(normals, axis=1, keepdims=True)).float()
