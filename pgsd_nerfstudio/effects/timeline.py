"""The timeline of a weather: how it arrives and when it ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Course of a weather over time; seconds count from the first frame."""

    onset: float = 0.0
    """Seconds in which the weather grows from a clear start to its full strength; 0: the first frame has full weather."""
    arrives: Literal["everywhere", "as a front"] = "everywhere"
    """everywhere: the weather grows evenly. as a front: the wind carries a wall across the scene within the onset."""
    ends: float = math.inf
    """Second after which no new particles are emitted. Those in the air still fall, and wet surfaces dry."""

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
        """Share of the full weather at a second, 0..1. It rises linearly within the onset and then stays, after the end too."""
        return min(max(seconds / self.onset, 0.0), 1.0) if self.onset > 0 else 1.0

    def fallen(self, seconds: float) -> float:
        """Seconds of full weather up to a second: the integral of the share until the weather ends."""
        until = min(max(seconds, 0.0), self.ends)
        ramp = min(until, self.onset)
        return (0.5 * ramp * ramp / self.onset if self.onset > 0 else 0.0) + max(until - self.onset, 0.0)
