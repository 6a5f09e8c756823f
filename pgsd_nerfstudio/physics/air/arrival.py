"""When a weather reaches a place: at once, everywhere by and by, or behind a front that the wind carries across the scene.

A front is a vertical plane square to the mean wind. It stands in the domain's upwind corner at time 0 and moves evenly, so that
it has passed the downwind corner at the onset: the arrival time of a place is linear in its coordinate along the wind. How fast
the front goes thus follows from the onset, not from the wind; where both differ, see `air`.
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

INSTANT = 1e-9  # s; two times that differ by less are one


@dataclass(frozen=True)
class Arrival:
    """The course of a timeline over a box of air."""

    timeline: Timeline
    along: Float[ndarray, "2"]
    """Direction to which the wind blows, a unit vector."""
    upwind: float
    """Coordinate along the wind of the domain's upwind corner, m."""
    spans: Float[ndarray, "2"]
    """How far the domain's sides along x and y reach along the wind, m; together from its upwind to its downwind corner."""

    @staticmethod
    def of(timeline: Timeline, domain: Domain, wind: Wind) -> Arrival:
        """The course of that timeline in that box, with a front square to the mean wind."""
        angle = math.radians(wind.direction_degrees)
        along = np.array([math.cos(angle), math.sin(angle)])
        lower, upper = np.asarray(domain.lower[:2]), np.asarray(domain.upper[:2])
        upwind = float(np.minimum(lower * along, upper * along).sum())
        return Arrival(timeline, along, upwind, np.abs(along) * (upper - lower))

    @property
    def is_front(self) -> bool:
        """Whether the weather comes behind a front, rather than everywhere alike."""
        return self.timeline.arrives == "as a front" and self.timeline.starts_clear

    def front_position(self, seconds: float) -> float:
        """Coordinate along the wind, in metres, that the front is at; also before it has come in and after it has passed.

        Infinite without an onset, where all is behind it.

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
        points: Float[ndarray, "n 3"],  # m
        draws: Float[ndarray, " n"] | None = None,  # 0..1
    ) -> Float[ndarray, " n"]:
        """Seconds at which the weather is at each point; zeros without an onset.

        draws: what arrives everywhere comes to a point at that share of the onset; a front does not need them.

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
        """Which points no front is still to come to; all, where the weather arrives everywhere."""
        if not self.is_front or seconds >= self.timeline.onset:
            return np.ones(len(points), bool)
        return self.times(points) <= seconds

    def share(self, seconds: float) -> float:
        """How much of the weather is in the box by then, 0..1; of a front: the share of the plan that is behind it."""
        if not self.is_front:
            return self.timeline.share(seconds)
        # The plan reaches as far along the wind as the sum of two even draws: its area behind a front is their distribution.
        behind, (short, long) = float(self.spans.sum()) * self.timeline.share(seconds), np.sort(self.spans)
        if short < 1e-9 * long:
            return min(behind / float(long), 1.0)
        corners = np.array([behind, behind - short, behind - long, behind - short - long]).clip(0.0) ** 2
        return float((corners @ [1.0, -1.0, -1.0, 1.0]) / (2 * short * long))

    def is_over(self, seconds: float) -> bool:
        """Whether nothing new comes any more."""
        return seconds > self.timeline.ends + INSTANT
