"""When the weather reaches a place: at once, gradually everywhere, or behind a front that moves across the scene with the wind.

A front is a vertical plane square to the mean wind. It is in the domain's upwind corner at time 0, moves evenly, and reaches
the downwind corner at the onset: the arrival time of a place is linear in its coordinate along the wind. The speed of the front
therefore follows from the onset and not from the wind; `air` deals with the difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.clock import Domain

INSTANT = 1e-9  # s; two times that differ by less are the same


@dataclass(frozen=True)
class Arrival:
    """Arrival times of a timeline in a domain."""

    timeline: Timeline
    along: Float[ndarray, "2"]
    """Direction to which the wind blows, a unit vector."""
    upwind: float
    """Coordinate along the wind of the domain's upwind corner, m."""
    spans: Float[ndarray, "2"]
    """Extents of the domain's sides along x and y, measured along the wind, m. Their sum is the way from corner to corner."""

    @staticmethod
    def of(timeline: Timeline, domain: Domain, wind: Wind) -> Arrival:
        """The arrival times of a timeline in a domain, with a front square to the mean wind."""
        angle = math.radians(wind.direction_degrees)
        along = np.array([math.cos(angle), math.sin(angle)])
        lower, upper = np.asarray(domain.lower[:2]), np.asarray(domain.upper[:2])
        upwind = float(np.minimum(lower * along, upper * along).sum())
        return Arrival(timeline, along, upwind, np.abs(along) * (upper - lower))

    @property
    def is_front(self) -> bool:
        """Whether the weather arrives behind a front rather than everywhere."""
        return self.timeline.arrives == "as a front" and self.timeline.starts_clear

    def front_position(self, seconds: float) -> float:
        """Coordinate of the front along the wind in metres, also outside of the domain; infinite without an onset.

        Args:
            seconds: time since the start of the run.

        Raises:
            ValueError: this weather arrives everywhere.
        """
        if self.timeline.arrives != "as a front":
            raise ValueError(f'only what arrives "as a front" has a front, this weather arrives "{self.timeline.arrives}"')
        if not self.timeline.starts_clear:
            return math.inf
        return self.upwind + float(self.spans.sum()) * seconds / self.timeline.onset

    def times(
        self,
        points: Float[ndarray, "n 3"],
        draws: Float[ndarray, " n"] | None = None,
    ) -> Float[ndarray, " n"]:
        """Arrival time of the weather at each point in seconds; zeros without an onset.

        Args:
            points: m.
            draws: numbers from 0..1. Weather that arrives everywhere reaches a point at that fraction of the onset; a front
                does not need them.

        Raises:
            ValueError: the weather arrives everywhere within an onset, and there are no draws.
        """
        if not self.timeline.starts_clear:
            return np.zeros(len(points))
        if self.is_front:
            return self.timeline.onset * (points[:, :2].astype(np.float64) @ self.along - self.upwind) / self.spans.sum()
        if draws is None:
            raise ValueError("what arrives everywhere comes to each point at random: draws from 0..1 are needed, one a point")
        return self.timeline.onset * np.asarray(draws, np.float64)

    def passed(self, points: Float[ndarray, "n 3"], seconds: float) -> Bool[ndarray, " n"]:
        """Which points a front has reached; all points where the weather arrives everywhere.

        Args:
            points: m.
            seconds: time since the start of the run.
        """
        if not self.is_front or seconds >= self.timeline.onset:
            return np.ones(len(points), bool)
        return self.times(points) <= seconds

    def share(self, seconds: float) -> float:
        """Share of the weather that is in the domain, 0..1; with a front it is the share of the plan behind the front.

        Args:
            seconds: time since the start of the run.
        """
        if not self.is_front:
            return self.timeline.share(seconds)
        # Along the wind the plan's points are distributed as the sum of two uniform draws, with this distribution function.
        behind, (short, long) = float(self.spans.sum()) * self.timeline.share(seconds), np.sort(self.spans)
        if short < 1e-9 * long:
            return min(behind / float(long), 1.0)
        corners = np.array([behind, behind - short, behind - long, behind - short - long]).clip(0.0) ** 2
        return float((corners @ [1.0, -1.0, -1.0, 1.0]) / (2 * short * long))

    def is_over(self, seconds: float) -> bool:
        """Whether no more particles enter.

        Args:
            seconds: time since the start of the run.
        """
        return seconds > self.timeline.ends + INSTANT
