"""Log of a chunk: it collects the rows, births and ends of particles frame by frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, Integer
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import LANDED, Bodies, RunState, random_orientations
from pgsd_nerfstudio.physics.curve import along_curve
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.record.chunks import Chunk

SPARE = 1.1  # room for rows, relative to as many in each frame as in the present one


class Log:
    """Rows, births and ends in the frames of one chunk."""

    def __init__(self, start: int, frames: int, born: int) -> None:
        """Start an empty log.

        Args:
            start: first frame of the chunk.
            frames: number of frames.
            born: number of particles before the chunk.
        """
        self.start, self.frames = start, frames
        self.first = self.born = born
        self._ids, self._positions = np.empty(0, np.int32), np.empty((0, 3), np.float32)  # rows, with room to spare
        self._counts = np.zeros(frames, np.int32)
        self._births: list[tuple[int, Bodies]] = []
        self._ends: list[tuple[ndarray, int, int]] = []
        self._kinds: list[Bodies] = []
        self._landed: list[tuple[Bodies, ndarray]] = []

    def enter(self, bodies: Bodies, frame: int) -> Bodies:
        """Record new particles; returns them with their ids."""
        ids = np.arange(self.born, self.born + len(bodies), dtype=np.int32)
        self.born += len(bodies)
        new = Bodies(ids, *(value for name, value in vars(bodies).items() if name != "ids"))
        self._births.append((frame, new))
        self.see(new, frame)
        if new.kinds.any():
            self._kinds.append(new)
        return new

    def see(self, bodies: Bodies, frame: int) -> None:
        """Record the positions of particles in a frame."""
        first = int(self._counts.sum())
        last = first + len(bodies)
        if last > len(self._ids):
            frames_left = self.frames - (frame - self.start)
            room = last + int(SPARE * frames_left * len(bodies))
            self._ids, ids = np.empty(room, np.int32), self._ids
            self._positions, positions = np.empty((room, 3), np.float32), self._positions
            self._ids[:first], self._positions[:first] = ids[:first], positions[:first]
        self._ids[first:last], self._positions[first:last] = bodies.ids, bodies.positions
        self._counts[frame - self.start] += len(bodies)

    def become(self, bodies: Bodies) -> None:
        """Record particles whose kinds have changed."""
        self._kinds.append(bodies)

    def end(self, ids: Int[ndarray, " n"], frame: int, how: int) -> None:
        """Record particles that are not active from `frame` on.

        Args:
            ids: the particles.
            frame: exclusive end of their active frames.
            how: LANDED, ABSORBED, LEFT or UNSEEN.
        """
        self._ends.append((ids, frame, how))

    def land(self, bodies: Bodies, covers: ndarray, frame: int) -> None:
        """Record particles that land.

        Args:
            bodies: the particles at their contacts.
            covers: [n] thickness of the cover beneath each, m.
            frame: their last active frame.
        """
        self.end(bodies.ids, frame + 1, LANDED)
        self._landed.append((bodies, covers.astype(np.float32)))

    def chunk(self, ground: Ground, seed: int, state: RunState) -> Chunk:
        """The record of the chunk.

        Args:
            ground: gives landed particles their poses.
            seed: of the orientations of new particles.
            state: at the end of the chunk.
        """
        new = Bodies.join([Bodies.none(), *(entering for _, entering in self._births)])
        landed = Bodies.join([Bodies.none(), *(bodies for bodies, _ in self._landed)])
        covers = np.concatenate([np.zeros(0, np.float32), *(covers for _, covers in self._landed)])
        if len(landed):
            # Neighbours are posed one after the other, since they meet the same triangles.
            order = along_curve(landed.positions, landed.positions.min(0), landed.positions.max(0))
            landed, covers = landed.select(order), covers[order]
        rest = ground.rest(landed.positions, landed.spins, covers)
        changed = Bodies.join([Bodies.none(), *self._kinds])
        rows = int(self._counts.sum())
        return Chunk(
            start=self.start,
            frames=self.frames,
            row_ids=self._ids[:rows],
            row_counts=self._counts,
            row_positions=self._positions[:rows],
            births=_joined([np.full(len(entering), frame, np.int32) for frame, entering in self._births], np.int32),
            diameters=new.diameters,
            represents=new.represents,
            reaches=new.reaches,
            quats=random_orientations([seed, self.start, 0x0417], self.born - self.first),
            kind_ids=changed.ids,
            kind_bits=changed.kinds,
            ended_ids=_joined([ids for ids, _, _ in self._ends], np.int32),
            ended_frames=_joined([np.full(len(ids), end, np.int32) for ids, end, _ in self._ends], np.int32),
            ended_how=_joined([np.full(len(ids), how, np.uint8) for ids, _, how in self._ends], np.uint8),
            rest_ids=landed.ids,
            rest_positions=rest.positions,
            rest_quats=rest.quats,
            rest_extents=rest.extents,
            rest_covers=covers,
            rest_represents=landed.represents,
            state=state,
        )


def _joined(parts: list[Integer[ndarray, " _"]], dtype: type) -> Integer[ndarray, " n"]:
    return np.concatenate([np.zeros(0, dtype), *parts])
