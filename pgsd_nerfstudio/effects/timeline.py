"""When a weather comes and goes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Course of a weather over time; seconds count from the first frame."""

    onset: float = 0.0
    """Seconds within which it comes, from a clear start to all of it; 0: all of it is there in the first frame."""
    arrives: Literal["everywhere", "as a front"] = "everywhere"
    """everywhere: denser by and by. as a front: a wall that the wind carries across the scene within the onset."""
    ends: float = math.inf
    """Second after which nothing new comes; what is in the air still comes down, and what is wet dries."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.onset < math.inf:
            raise ValueError(f"an onset must be a number of seconds, not negative, got {self.onset:g}")
        if not self.ends >= self.onset:
            raise ValueError(f"a weather cannot end at {self.ends:g} s, before it has come at {self.onset:g} s")

    @property
    def starts_clear(self) -> bool:
        """Whether the first frame shows the untouched scene."""
        return self.onset > 0

    def share(self, seconds: float) -> float:
        """How much of it has come by then, 0..1: rises linearly within the onset, then stays (also after the end)."""
        return min(max(seconds / self.onset, 0.0), 1.0) if self.onset > 0 else 1.0

    def fallen(self, seconds: float) -> float:
        """Seconds of full weather that have come by then: the integral of its share until it ends."""
        until = min(max(seconds, 0.0), self.ends)
        ramp = min(until, self.onset)
        return (0.5 * ramp * ramp / self.onset if self.onset > 0 else 0.0) + max(until - self.onset, 0.0)
