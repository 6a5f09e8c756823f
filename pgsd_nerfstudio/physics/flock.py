"""The flying particles of a run, in arrays that keep their place from frame to frame.

Every frame a few particles in a hundred go and as many come. Making all arrays anew for them would cost as much as the flight.
Here those that stay are copied once, from one set of arrays with room to spare into another.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.bodies import Bodies

SPARE = 1.25  # room for particles, relative to those that are there when it is made
_NAMES = tuple(f.name for f in fields(Bodies))


class Flock:
    """Particles that are moved in place, taken out and added."""

    def __init__(self, bodies: Bodies) -> None:
        """Copy particles.

        Args:
            bodies: the first ones.
        """
        self._count = 0
        self._now, self._next = _room(bodies, 0), _room(bodies, 0)
        self.add(bodies)

    def __len__(self) -> int:
        return self._count

    @property
    def bodies(self) -> Bodies:
        """The particles. Their arrays are views, which hold until particles are taken out or added."""
        return Bodies(*(self._now[name][: self._count] for name in _NAMES))

    def keep(self, stays: Int[ndarray, " s"]) -> None:
        """Take out all other particles; those that stay keep their order.

        Args:
            stays: indices of the particles that stay, ascending, uint32.
        """
        if len(stays) == self._count:
            return
        for name in _NAMES:
            now, then = self._now[name], self._next[name]
            _gather(now.reshape(-1), then.reshape(-1), stays, now.size // len(now))
        self._now, self._next = self._next, self._now
        self._count = len(stays)

    def add(self, bodies: Bodies) -> None:
        """Add particles at the end.

        Args:
            bodies: the particles, which are copied.
        """
        count = self._count + len(bodies)
        if count > len(self._now["ids"]):
            before, self._now = self._now, _room(bodies, int(SPARE * count))
            self._next = _room(bodies, int(SPARE * count))
            for name in _NAMES:
                self._now[name][: self._count] = before[name][: self._count]
        for name in _NAMES:
            self._now[name][self._count : count] = getattr(bodies, name)
        self._count = count


def _room(like: Bodies, count: int) -> dict[str, ndarray]:
    return {name: np.empty((count, *getattr(like, name).shape[1:]), getattr(like, name).dtype) for name in _NAMES}


@kernel()
def _gather(now, then, stays, wide):
    if wide == 1:
        for k in range(len(stays)):
            then[k] = now[stays[k]]
        return
    for k in range(len(stays)):
        start = np.uint64(stays[k]) * np.uint64(3)
        then[3 * k], then[3 * k + 1], then[3 * k + 2] = now[start], now[start + np.uint64(1)], now[start + np.uint64(2)]
