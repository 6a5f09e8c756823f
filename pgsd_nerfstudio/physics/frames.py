"""From one frame to the next: fly, meet the surface, slide, move as a whole, leave, enter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy import ndarray

from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.splash import splashed
from pgsd_nerfstudio.physics.bodies import ABSORBED, DENSE, LEFT, SLID, UNSEEN, Bodies, RunState
from pgsd_nerfstudio.physics.ground.deposits import Deposits
from pgsd_nerfstudio.physics.ground.landing import Meeting
from pgsd_nerfstudio.physics.ground.sliding import LIFT, slide
from pgsd_nerfstudio.physics.record.chunks import Chunk
from pgsd_nerfstudio.physics.record.log import Log

CLEAR = 0.01  # m off the surface at which what glides along it goes on


def simulate_chunk(air: Air, deposits: Deposits, state: RunState, start: int, frames: int) -> Chunk:
    """Simulate `frames` frames from `start` on.

    Raises:
        ValueError: a position or velocity became NaN or infinite.
    """
    deposits.restore(state.deposits)
    log = Log(start, frames, state.born)
    walk = _Walk(air, deposits, log, state)
    for frame in range(start, start + frames):
        walk.begin() if frame == 0 else walk.advance(frame)
    return log.chunk(air.ground, air.seed, walk.state())


class _Walk:
    """Particles on their way through the frames of a chunk."""

    def __init__(self, air: Air, deposits: Deposits, log: Log, state: RunState) -> None:
        self.air, self.deposits, self.log = air, deposits, log
        self.flying = Bodies.join([state.flying])  # a copy: flying changes it in place
        self.sliding, self.dense, self.carry = state.sliding, state.dense, state.carry

    def state(self) -> RunState:
        return RunState(self.flying, self.sliding, self.dense, self.deposits.snapshot(), self.log.born, self.carry)

    def begin(self) -> None:
        """Frame 0: what is in the air from the start."""
        self.flying = self.log.enter(self.air.arriving(0), 0)

    def advance(self, frame: int) -> None:
        """From the frame before to `frame`."""
        air, log = self.air, self.log
        before = self.flying.positions.copy()
        air.fly(self.flying, frame)
        meeting = air.ground.meet(before, self.flying.positions, self.deposits.cover)
        self.flying.positions[meeting.which] = meeting.points
        aloft, gone = self._leave(meeting, frame)
        took_off = self._slide(frame)
        self._move_dense(frame)
        touched = self.flying.select(meeting.which)
        flying, droplets = self._touch(touched, meeting, frame)
        entering, self.carry = air.entering(gone, self.carry, frame)
        log.see(aloft, frame)
        stay = Bodies.join([aloft, took_off, flying])
        self.flying = Bodies.join([stay, log.enter(droplets, frame), log.enter(entering, frame)])
        self.deposits.age(air.step)
        for bodies in (self.flying, self.sliding, self.dense):
            _check(bodies, frame)

    def _leave(self, meeting: Meeting, frame: int) -> tuple[Bodies, Bodies]:
        """What stays in the air untouched, and what left the box of air.

        What no camera can see any more ends too, and what flew out ahead of the weather's front.
        """
        air, bodies, log = self.air, self.flying, self.log
        lower, upper = np.asarray(air.domain.lower, np.float32), np.asarray(air.domain.upper, np.float32)
        out = ((bodies.positions < lower) | (bodies.positions > upper)).any(1)
        touched = np.zeros(len(bodies), bool)
        touched[meeting.which] = True
        ahead = ~touched & ~out & ~air.arrival.passed(bodies.positions, frame * air.step)
        unseen = ~(touched | out | ahead) & ~air.sight.needed(bodies.positions)
        gone = bodies.select(out & ~touched)
        log.end(gone, frame, LEFT)
        log.end(bodies.select(ahead), frame, LEFT)
        log.end(bodies.select(unseen), frame, UNSEEN)
        return bodies.select(~(touched | out | ahead | unseen)), gone

    def _slide(self, frame: int) -> Bodies:
        """Move sliders; returns those that fly again. Those that found rest lie down."""
        air, log = self.air, self.log
        moved = slide(self.sliding, air.ground.surface, air.effect.surface.friction, air.step)
        log.see(moved.bodies, frame)
        rests = moved.rests
        self._lie(moved.bodies.select(rests), frame)
        self.sliding = moved.bodies.select(~(rests | moved.flies))
        return moved.bodies.select(moved.flies)

    def _move_dense(self, frame: int) -> None:
        """Hand crowded sliders over, and move what is dense as a whole."""
        matter, log = self.deposits.dense, self.log
        if matter is None:
            return
        volumes = self.deposits.volumes(self.sliding)
        crowded = matter.crowded(self.sliding, volumes, self.dense, self.deposits.volumes(self.dense))
        if len(self.dense):
            moved = matter.step(self.air.step)
            bodies = replace(
                self.dense,
                positions=moved.positions.astype(np.float32),
                velocities=moved.velocities.astype(np.float32),
            )
            log.see(bodies.select(~moved.left), frame)
            log.end(bodies.select(moved.left), frame, LEFT)
            self._lie(bodies.select(moved.rests), frame, heaped=True)
            self.dense = bodies.select(~(moved.rests | moved.left))
        if crowded.any():
            handed = self.sliding.select(crowded).marked(DENSE)
            log.become(handed)
            matter.add(handed, volumes[crowded])
            self.sliding = self.sliding.select(~crowded)
            self.dense = Bodies.join([self.dense, handed])

    def _touch(self, touched: Bodies, meeting: Meeting, frame: int) -> tuple[Bodies, Bodies]:
        """What happens to particles at their contacts; returns those that fly on, and new droplets without ids."""
        air, log, response = self.air, self.log, self.air.effect.surface
        log.see(touched, frame)
        if response.landing == "glides":
            into = (touched.velocities * meeting.normals).sum(1, keepdims=True)
            return (
                replace(
                    touched,
                    positions=(touched.positions + CLEAR * meeting.normals).astype(np.float32),
                    velocities=(touched.velocities - into * meeting.normals).astype(np.float32),
                ),
                Bodies.none(),
            )
        if response.landing in ("wets", "vanishes"):
            droplets, share = Bodies.none(), np.zeros(len(touched))
            if response.splash is not None:
                rng = air.draws(frame, 0x59A5)
                droplets, share = splashed(air, response.splash, touched, meeting.normals, rng)
            self.deposits.wet(touched, 1 - share)
            log.end(touched, frame + 1, ABSORBED)
            return Bodies.none(), droplets
        hold = air.ground.holds(meeting.normals, touched.holds)
        self._lie(touched.select(hold), frame)
        slips = touched.select(~hold).marked(SLID)
        normals = meeting.normals[~hold]
        along = slips.velocities - (slips.velocities * normals).sum(1, keepdims=True) * normals
        # Off the surface, on the side from which they came: sliding has no other memory of it.
        lifted = slips.positions + LIFT * normals
        slips = replace(slips, positions=lifted.astype(np.float32), velocities=along.astype(np.float32))
        log.become(slips)
        self.sliding = Bodies.join([self.sliding, slips])
        return Bodies.none(), Bodies.none()

    def _lie(self, bodies: Bodies, frame: int, *, heaped: bool = False) -> None:
        """Particles whose way ends here, on the cover that they make thicker."""
        cover = self.deposits.cover
        before = np.zeros(len(bodies)) if cover is None else cover.height(bodies.positions.astype(np.float64))
        covers = self.deposits.lay(bodies, heaped=heaped)
        if not heaped:
            # They touched the cover as it was, and lie on it as it has become: the surface beneath is where it was.
            bodies = replace(bodies, positions=bodies.positions.copy())
            bodies.positions[:, 2] += (covers - before).astype(np.float32)
        self.log.land(bodies, covers, frame)


def _check(bodies: Bodies, frame: int) -> None:
    for name in ("positions", "velocities"):
        values: ndarray = getattr(bodies, name)
        bad = int((~np.isfinite(values)).any(1).sum())
        if bad:
            raise ValueError(f"the {name} of {bad} particles are NaN or infinite in frame {frame}")
