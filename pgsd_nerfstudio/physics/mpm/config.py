"""Numbers that decide how the dense regime is computed, not what it computes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Sleep:
    """When particles are taken to be at rest."""

    speed: float = 0.02
    """Speed in m/s below which a particle may fall asleep."""
    frames: int = 5
    """Consecutive steps during which a particle must be that slow and touch an obstacle or resting matter."""
    wake_speed: float = 0.2
    """Speed in m/s from which resting matter wakes: the common speed of resting and arriving matter if the two stayed together.
    Fresh snow at 1 m/s does not wake the snow below it, a snowball does. Infinity: resting matter wakes only by `Mpm.wake`."""

    def __post_init__(self) -> None:
        if not self.speed >= 0 or self.frames < 1:
            raise ValueError(f"sleep needs a speed >= 0 and at least one frame, got {self.speed:g} m/s and {self.frames}")
        if not self.wake_speed > self.speed:
            raise ValueError(
                f"the wake speed must exceed the speed of falling asleep, got {self.wake_speed:g} and {self.speed:g} m/s"
            )


@dataclass(frozen=True, kw_only=True)
class MpmConfig:
    """Numerics of the dense regime."""

    dx: float
    """Spacing of the grid in metres; eight particles per cell are usual."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """m/s^2."""
    courant: float = 0.5
    """Cells that sound and the fastest particle together may travel in a substep; a lone particle is stable up to 1."""
    max_dt: float | None = None
    """Longest substep in seconds; shortened where stability asks for it. None: as long as is stable."""
    max_substeps: int = 5000
    """Substeps that one step may need before it is refused."""
    max_cells: int = 50_000_000
    """Grid nodes that may be allocated; each takes 16 bytes (f32), and 24 for each part of the obstacle. Nodes far from
    all particles cost no time, but the obstacle fills them once."""
    sleep: Sleep | None = None
    """When particles come to rest and no longer cost time; None: never."""
    precision: Literal["f32", "f64"] = "f32"
    """Single precision suffices (positions differ by 1e-5 m after 500 steps); double is for tests."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to run."""
    threads: int = 0
    """Threads on the CPU; 0: all."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dx) and self.dx > 0):
            raise ValueError(f"the grid spacing dx must be positive and finite, got {self.dx:g} m")
        if not 0 < self.courant <= 1:
            raise ValueError(f"the Courant number must lie in 0-1, got {self.courant:g}; a lone particle is stable up to 1")
        if self.max_dt is not None and not self.max_dt > 0:
            raise ValueError(f"max_dt must be positive, got {self.max_dt:g} s")
        if not all(map(math.isfinite, self.gravity)):
            raise ValueError(f"gravity must be finite, got {self.gravity} m/s^2")
