"""Impacts of a simulation's drops: when, where, how large and how fast. Rings and crowns follow from them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import SPLASHED
from pgsd_nerfstudio.physics.record.history import ParticleHistory

CUT = 0.99  # of the step before; a drop whose last step is shorter has met something, others have left the air or the view
COPIES = 6  # impacts of one simulated drop at most, which stands for many
APART = 0.35  # m around it in which the others that it stands for fall


@dataclass(frozen=True, eq=False)
class Impacts:
    """i impacts in the order of time."""

    times: Float[ndarray, " i"]
    """Seconds from the beginning of the weather."""
    places: Float[ndarray, "i 3"]
    """Metres."""
    diameters: Float[ndarray, " i"]
    """Of the drops, metres."""
    speeds: Float[ndarray, " i"]
    """m/s."""

    @staticmethod
    def of(history: ParticleHistory) -> Impacts:
        """The impacts of drops; droplets of splashes make none.

        The last step of a drop is as much of a frame as it is long, relative to the step before. The other real drops that one
        represents fall around it within the time of a frame, at its height.

        Args:
            history: of the drops.
        """
        ends, births = history.ends.numpy(force=True).astype(np.int64), history.births.numpy(force=True)
        last = history.offsets[1:].numpy(force=True) - 1
        falls = (ends < history.frames) & ~history.collided.numpy(force=True) & (ends - births > 2)
        which = np.flatnonzero(falls & ((history.kinds.numpy(force=True) & SPLASHED) == 0))
        positions, rows = history.positions.numpy(force=True), last[which]
        at, before = positions[rows].astype(float), positions[rows - 1].astype(float)
        step = np.linalg.norm(before - positions[rows - 2], axis=1).clip(1e-9)
        part = np.linalg.norm(at - before, axis=1) / step
        met = part < CUT
        which, at, part, step = which[met], at[met], part[met], step[met]
        copies = np.round(history.represents.numpy(force=True)[which]).astype(int).clip(1, COPIES)
        own = np.repeat(np.arange(len(which)), copies)
        rng = np.random.default_rng(0x0717)
        other = np.append(False, own[1:] == own[:-1]) if len(own) else np.zeros(0, bool)
        radius, turn = APART * np.sqrt(rng.random(len(own))), 2 * np.pi * rng.random(len(own))
        late = rng.random(len(own))
        moved = np.where(other, radius, 0.0)[:, None] * np.stack([np.cos(turn), np.sin(turn), np.zeros(len(own))], 1)
        times = ((ends[which] - 2 + part)[own] - np.where(other, late, 0.0)) / history.fps
        diameters = history.diameters.numpy(force=True)[which].astype(float)
        found = Impacts(times, at[own] + moved, diameters[own], (step * history.fps)[own])
        return found.select(np.argsort(times, kind="stable"))

    def __len__(self) -> int:
        return len(self.times)

    def select(self, which: ndarray | slice) -> Impacts:
        """The chosen impacts, by mask, index or slice."""
        return Impacts(*(getattr(self, f.name)[which] for f in fields(self)))

    def between(self, first: float, last: float) -> Impacts:
        """The impacts within a time.

        Args:
            first: second.
            last: second.
        """
        begin, end = np.searchsorted(self.times, [first, last])
        return self.select(slice(int(begin), int(end)))
