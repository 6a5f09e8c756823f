"""What happens in a chunk, noted frame by frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import LANDED, Bodies, RunState
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.record.chunks import Chunk


class Log:
    """Rows, births and ends of the frames of one chunk."""

    def __init__(self, start: int, frames: int, born: int) -> None:
        self.start, self.frames = start, frames
        self.first = self.born = born
        self._rows: list[tuple[ndarray, int, ndarray]] = []
        self._births: list[tuple[int, Bodies]] = []
        self._ends: list[tuple[ndarray, int, int]] = []
        self._kinds: list[Bodies] = []
        self._lying: list[tuple[Bodies, ndarray]] = []

    def enter(self, bodies: Bodies, frame: int) -> Bodies:
        """New particles; hands them back with their ids."""
        ids = np.arange(self.born, self.born + len(bodies), dtype=np.int32)
        self.born += len(bodies)
        new = Bodies(ids, *(value for name, value in vars(bodies).items() if name != "ids"))
        self._births.append((frame, new))
        self.see(new, frame)
        if new.kinds.any():
            self._kinds.append(new)
        return new

    def see(self, bodies: Bodies, frame: int) -> None:
        """Where particles are in a frame."""
        self._rows.append((bodies.ids, frame, bodies.positions.copy()))

    def become(self, bodies: Bodies) -> None:
        """Particles whose kinds have changed."""
        self._kinds.append(bodies)

    def end(self, bodies: Bodies, frame: int, how: int) -> None:
        """Particles that are not active from `frame` on."""
        self._ends.append((bodies.ids, frame, how))

    def land(self, bodies: Bodies, covers: ndarray, frame: int) -> None:
        """Particles whose last active frame is `frame`, and the thickness of the cover on which they lie."""
        self.end(bodies, frame + 1, LANDED)
        self._lying.append((bodies, covers.astype(np.float32)))

    def chunk(self, ground: Ground, seed: int, state: RunState) -> Chunk:
        """All of it as arrays; lays down what has landed."""
        new = Bodies.join([Bodies.none(), *(entering for _, entering in self._births)])
        lying = Bodies.join([Bodies.none(), *(bodies for bodies, _ in self._lying)])
        covers = np.concatenate([np.zeros(0, np.float32), *(covers for _, covers in self._lying)])
        rest = ground.rest(lying.positions, lying.spins, covers)
        quats = np.random.default_rng([seed, self.start, 0x0417]).normal(size=(self.born - self.first, 4))
        changed = Bodies.join([Bodies.none(), *self._kinds])
        row_ids = _joined([ids for ids, _, _ in self._rows], np.int32)
        row_frames = _joined([np.full(len(ids), frame, np.int32) for ids, frame, _ in self._rows], np.int32)
        return Chunk(
            start=self.start,
            frames=self.frames,
            row_ids=row_ids,
            row_frames=row_frames,
            row_positions=np.concatenate([np.zeros((0, 3), np.float32), *(at for _, _, at in self._rows)]),
            births=_joined([np.full(len(entering), frame, np.int32) for frame, entering in self._births], np.int32),
            diameters=new.diameters,
            represents=new.represents,
            quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            kind_ids=changed.ids,
            kind_bits=changed.kinds,
            ended_ids=_joined([ids for ids, _, _ in self._ends], np.int32),
            ended_frames=_joined([np.full(len(ids), end, np.int32) for ids, end, _ in self._ends], np.int32),
            ended_how=_joined([np.full(len(ids), how, np.uint8) for ids, _, how in self._ends], np.uint8),
            rest_ids=lying.ids,
            rest_positions=rest.positions,
            rest_quats=rest.quats,
            rest_extents=rest.extents,
            rest_covers=covers,
            state=state,
        )


def _joined(parts: list[Int[ndarray, " n"]], dtype: type) -> Int[ndarray, " n"]:
    return np.concatenate([np.zeros(0, dtype), *parts])
