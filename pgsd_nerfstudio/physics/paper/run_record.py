"""Record of a run of the paper's solver, collected frame by frame into one history.

In the paper, a particle below the movement threshold has collided, wherever it is. Near the mesh it is projected onto the
closest point; elsewhere it hangs where it stopped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import ANY_DISTANCE, LANDED, LEFT, Bodies, RunState, random_orientations
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.ground.landing import SMALLEST, Ground, RestPose
from pgsd_nerfstudio.physics.record.chunks import Chunk, assemble
from pgsd_nerfstudio.physics.record.history import ParticleHistory


class _Stop(NamedTuple):
    ids: Int[ndarray, " e"]
    end: int
    how: int


class RunRecord:
    """Rows, births and ends so far; positions in metres."""

    def __init__(self, ground: Ground, near: float, diameter: float) -> None:
        """Start an empty record.

        Args:
            ground: the surface for contacts.
            near: metres from the mesh within which a stopped particle is projected onto it.
            diameter: of every particle, m.
        """
        self.ground, self.near, self.diameter = ground, near, diameter
        self.born, self.hanging = 0, 0
        self._births: list[tuple[int, int]] = []
        self._rows: list[tuple[ndarray, int, ndarray]] = []
        self._stops: list[_Stop] = []
        self._rests: list[tuple[ndarray, RestPose]] = []

    def birth(self, frame: int, count: int) -> Int[ndarray, " n"]:
        """Record new particles at `frame`; returns their ids."""
        self._births.append((frame, count))
        self.born += count
        return np.arange(self.born - count, self.born, dtype=np.int32)

    def at(self, frame: int, ids: Int[ndarray, " n"], positions: Float[ndarray, "n 3"]) -> None:
        """Record positions of active particles in a frame, including those that stop in it.

        Args:
            frame: the frame.
            ids: the particles.
            positions: m.
        """
        self._rows.append((ids, frame, positions.astype(np.float32)))

    def left(self, frame: int, ids: Int[ndarray, " n"]) -> None:
        """Record particles that are outside of the domain at `frame`."""
        self._stops.append(_Stop(ids, frame, LEFT))

    def stopped(
        self, frame: int, ids: Int[ndarray, " n"], positions: Float[ndarray, "n 3"], spins: Float[ndarray, " n"]
    ) -> None:
        """Record particles that made contact or came to rest.

        Args:
            frame: their last active frame.
            ids: the particles.
            positions: m.
            spins: turns about the surface normal.
        """
        self._stops.append(_Stop(ids, frame + 1, LANDED))
        close = self._close(positions)
        self.hanging += int((~close).sum())
        landed = self.ground.rest(positions[close], spins[close])
        upright = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (int((~close).sum()), 1))
        extent = np.full(len(upright), SMALLEST * self.ground.response.probe, np.float32)
        self._rests.append((ids[close], landed))
        self._rests.append((ids[~close], RestPose(positions[~close].astype(np.float32), upright, extent)))

    def history(self, clock: Clock, bodies: Bodies, seed: int, about: Mapping[str, Any]) -> ParticleHistory:
        """The history of the run.

        Args:
            clock: shown frame rate and number of frames.
            bodies: particles that are active at the end.
            seed: of the orientations.
            about: plain values to keep with the history.
        """
        nothing, no_bits = np.zeros(0, np.int32), np.zeros(0, np.uint8)
        no_rest = self.ground.rest(np.zeros((0, 3)), np.zeros(0))
        rests = [(nothing, no_rest), *self._rests]
        chunk = Chunk(
            start=0,
            frames=clock.frames,
            row_ids=np.concatenate([ids for ids, _, _ in self._rows]),
            row_counts=np.bincount(
                [frame for _, frame, _ in self._rows], [len(ids) for ids, _, _ in self._rows], clock.frames
            ).astype(np.int32),
            row_positions=np.concatenate([positions for _, _, positions in self._rows]),
            births=np.concatenate([np.full(count, frame, np.int32) for frame, count in self._births]),
            diameters=np.full(self.born, self.diameter, np.float32),
            represents=np.ones(self.born, np.float32),
            reaches=np.full(self.born, ANY_DISTANCE),
            quats=random_orientations([seed, 0x0417], self.born),
            kind_ids=nothing,
            kind_bits=no_bits,
            ended_ids=np.concatenate([nothing, *(stop.ids for stop in self._stops)]),
            ended_frames=np.concatenate([nothing, *(np.full(len(stop.ids), stop.end, np.int32) for stop in self._stops)]),
            ended_how=np.concatenate([no_bits, *(np.full(len(stop.ids), stop.how, np.uint8) for stop in self._stops)]),
            rest_ids=np.concatenate([ids for ids, _ in rests]),
            rest_positions=np.concatenate([rest.positions for _, rest in rests]),
            rest_quats=np.concatenate([rest.quats for _, rest in rests]),
            rest_extents=np.concatenate([rest.extents for _, rest in rests]),
            rest_covers=np.zeros(sum(len(ids) for ids, _ in rests), np.float32),
            rest_represents=np.ones(sum(len(ids) for ids, _ in rests), np.float32),
            state=replace(RunState.empty(), flying=bodies, born=self.born),
        )
        return assemble([chunk], clock, {**about, "hanging": self.hanging})

    def _close(self, positions: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Which positions are within `near` of the mesh."""
        return self.ground.surface.closest(torch.from_numpy(positions.astype(np.float32))).distance.numpy() <= self.near
