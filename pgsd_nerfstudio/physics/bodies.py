"""Particles on their way, and everything that the next frame of a simulation depends on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

GRAVITY = 9.81  # m/s^2, in all motion here; the fits in laws.fall_speeds were made with the standard 9.80665
LANDED, ABSORBED, LEFT, UNSEEN = 0, 1, 2, 3  # how a particle ended; what ended none of these ways still moves
ENDS = {"landed": LANDED, "absorbed": ABSORBED, "left": LEFT, "unseen": UNSEEN}
SPLASHED, SLID, DENSE = 1, 2, 4  # bits of what a particle ever was: droplet of a splash, sliding, dense matter


@dataclass(frozen=True)
class Bodies:
    """n particles on their way; what one of them needs to go on."""

    ids: Int[ndarray, " n"]
    positions: Float[ndarray, "n 3"]
    velocities: Float[ndarray, "n 3"]
    diameters: Float[ndarray, " n"]
    speeds: Float[ndarray, " n"]
    """Terminal, m/s."""
    sways: Float[ndarray, " n"]
    """Flutter: speed in m/s, rate in Hz, phase in turns."""
    hertz: Float[ndarray, " n"]
    phases: Float[ndarray, " n"]
    holds: Float[ndarray, " n"]
    """Draw from 0..1 that decides whether it stays on a slope."""
    spins: Float[ndarray, " n"]
    """Turns about the normal when it lies."""
    represents: Float[ndarray, " n"]
    """Real particles that it stands for."""
    kinds: Int[ndarray, " n"]
    """Bits SPLASHED, SLID and DENSE."""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, which: ndarray) -> Bodies:
        return Bodies(*(getattr(self, f.name)[which] for f in fields(self)))

    @staticmethod
    def join(parts: Sequence[Bodies]) -> Bodies:
        return Bodies(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Bodies)))

    def marked(self, kind: int) -> Bodies:
        """The same particles, which now have been of that kind too."""
        return replace(self, kinds=self.kinds | np.uint8(kind))

    @staticmethod
    def none() -> Bodies:
        widths = {"positions": (0, 3), "velocities": (0, 3)}
        types = {"ids": np.int32, "kinds": np.uint8}
        return Bodies(*(np.zeros(widths.get(f.name, 0), types.get(f.name, np.float32)) for f in fields(Bodies)))


@dataclass(frozen=True)
class RunState:
    """Everything the next frame depends on."""

    flying: Bodies
    sliding: Bodies
    dense: Bodies
    deposits: Mapping[str, ndarray]
    """What lies on surfaces, and the dense matter's own state: see `deposits.Deposits`."""
    born: int
    """Particles so far; the next id."""
    carry: float
    """Fraction of a particle that is due at the top."""

    @staticmethod
    def empty() -> RunState:
        return RunState(Bodies.none(), Bodies.none(), Bodies.none(), {}, 0, 0.0)

    @property
    def moving(self) -> int:
        """Particles on their way."""
        return len(self.flying) + len(self.sliding) + len(self.dense)

    def arrays(self) -> dict[str, ndarray]:
        """All arrays by name."""
        groups = {"flying": self.flying, "sliding": self.sliding, "dense": self.dense}
        named = {f"{group}.{f.name}": getattr(bodies, f.name) for group, bodies in groups.items() for f in fields(Bodies)}
        return named | {f"deposits.{name}": value for name, value in self.deposits.items()}

    @staticmethod
    def of(arrays: Mapping[str, ndarray], born: int, carry: float) -> RunState:
        """From what `arrays` gave."""
        flying, sliding, dense = (
            Bodies(*(arrays[f"{group}.{f.name}"] for f in fields(Bodies))) for group in ("flying", "sliding", "dense")
        )
        deposits = {name.removeprefix("deposits."): value for name, value in arrays.items() if name.startswith("deposits.")}
        return RunState(flying, sliding, dense, deposits, born, carry)
