"""One frame of a simulation: particles fly, make contact, slide, move as dense matter, leave and enter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy import ndarray

from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.emitters import Newcomers
from pgsd_nerfstudio.physics.air.leaving import Leaving
from pgsd_nerfstudio.physics.air.splash import splashed
from pgsd_nerfstudio.physics.bodies import (
    ABSORBED,
    ANY_DISTANCE,
    DENSE,
    DRIPPED,
    LEFT,
    SLID,
    SPLASHED,
    UNSEEN,
    Bodies,
    RunState,
)
from pgsd_nerfstudio.physics.curve import along_curve
from pgsd_nerfstudio.physics.flock import Flock
from pgsd_nerfstudio.physics.ground.deposits import Deposits
from pgsd_nerfstudio.physics.ground.drips import DIAMETER
from pgsd_nerfstudio.physics.ground.landing import Meeting
from pgsd_nerfstudio.physics.ground.sliding import LIFT, slide
from pgsd_nerfstudio.physics.record.chunks import Chunk
from pgsd_nerfstudio.physics.record.log import Log

CLEAR = 0.01  # m above the surface at which a gliding particle (fog) flies on after a contact


def simulate_chunk(air: Air, deposits: Deposits, state: RunState, start: int, frames: int) -> Chunk:
    """Simulate the frames of one chunk.

    Args:
        air: what does not change during the run.
        deposits: cover, wetness and dense matter; they take the state's values and change with the frames.
        state: the state before the first frame.
        start: first frame.
        frames: number of frames.

    Raises:
        ValueError: a position or velocity became NaN or infinite.
    """
    deposits.restore(state.deposits)
    log = Log(start, frames, state.born)
    simulation = _Simulation(air, deposits, log, state)
    for frame in range(start, start + frames):
        simulation.begin() if frame == 0 else simulation.advance(frame)
    return log.chunk(air.ground, air.seed, simulation.state())


class _Simulation:
    """Active particles during the frames of one chunk."""

    def __init__(self, air: Air, deposits: Deposits, log: Log, state: RunState) -> None:
        self.air, self.deposits, self.log = air, deposits, log
        self.flock = Flock(state.flying)
        self.sliding, self.dense, self.coming = state.sliding, state.dense, state.coming

    def state(self) -> RunState:
        flying = Bodies.join([self.flock.bodies])
        return RunState(flying, self.sliding, self.dense, self.coming, self.deposits.snapshot(), self.log.born)

    def begin(self) -> None:
        """Frame 0: particles that are in the air from the start enter."""
        self._enter(self._due(self.air.arriving(0), 0), 0)

    def advance(self, frame: int) -> None:
        """Advance from the frame before to `frame`."""
        air, log, flying = self.air, self.log, self.flock.bodies
        before = flying.positions.copy()
        air.fly(flying, frame)
        contacts = air.ground.meet(before, flying.positions, self.deposits.cover)
        flying.positions[contacts.which] = contacts.points
        in_contact = flying.select(contacts.which)
        self._leave(contacts, frame)
        log.see(self.flock.bodies, frame)
        took_off = self._slide(frame)
        self._move_dense(frame)
        gliding, droplets = self._resolve_contacts(in_contact, contacts, frame)
        self.flock.add(took_off)
        self.flock.add(gliding)
        self._enter(droplets, frame)
        self._enter(self._due(air.entering(frame), frame), frame)
        self._enter(self._dripping(frame), frame)
        self.deposits.age(air.step)
        for bodies in (self.sliding, self.dense):
            _check(bodies, frame)

    def _enter(self, bodies: Bodies, frame: int) -> None:
        """Let new particles into the air.

        They enter along a curve through the domain. Particles beside each other in memory then mostly stay beside each other in
        the air, where they read the same nodes of the wind, cells of maps, and triangles.
        """
        _check(bodies, frame)
        order = along_curve(bodies.positions, np.asarray(self.air.domain.lower), np.asarray(self.air.domain.upper))
        self.flock.add(self.log.enter(bodies.select(order), frame))

    def _due(self, new: Bodies, frame: int) -> Bodies:
        """New particles that matter in a frame, and those that have waited for it; the others wait."""
        late = self.coming.since == frame
        begins = self.air.unhidden(self.coming.select(late), frame)
        now = new.since <= frame
        self.coming = Bodies.join([self.coming.select(~late), new.select(~now)])
        return Bodies.join([new.select(now), begins])

    def _dripping(self, frame: int) -> Bodies:
        """Drops that let go of edges within the frame."""
        air = self.air
        places, stands_for = self.deposits.dripping((frame - 1) * air.step, frame * air.step)
        if len(places) == 0:
            return Bodies.none()
        size, reach = np.full(len(places), DIAMETER), np.full(len(places), ANY_DISTANCE)
        new = air.newborn(Newcomers(places, size, reach), np.zeros_like(places), air.draws(frame, 0xD819))
        new.represents[:] = stands_for
        return new.marked(DRIPPED)

    def _leave(self, contacts: Meeting, frame: int) -> None:
        """Take out the particles that have a contact, and those that end.

        A particle ends when it leaves the domain, when no camera can see it within its reach any more, and when it flies out
        ahead of the weather's front.
        """
        air, bodies, log = self.air, self.flock.bodies, self.log
        front = air.arrival.is_front and frame * air.step < air.effect.timeline.onset
        passed = air.arrival.passed(bodies.positions, frame * air.step) if front else None
        found = Leaving.of(bodies, contacts.which, air.domain, air.sight, passed, bodies.until < frame)
        if found.broken:
            _check(bodies, frame)
        for which, how in ((found.out, LEFT), (found.ahead, LEFT), (found.unseen, UNSEEN)):
            log.end(bodies.ids[which], frame, how)
        self.flock.keep(found.stays)

    def _slide(self, frame: int) -> Bodies:
        """Move sliders and land the slow ones; returns the sliders that fly again."""
        air, log = self.air, self.log
        moved = slide(self.sliding, air.ground.cells, air.effect.surface.friction, air.step)
        log.see(moved.bodies, frame)
        rests = moved.rests
        self._land(moved.bodies.select(rests), frame)
        self.sliding = moved.bodies.select(~(rests | moved.flies))
        return moved.bodies.select(moved.flies)

    def _move_dense(self, frame: int) -> None:
        """Move dense matter and add crowded sliders to it."""
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
            log.end(bodies.ids[moved.left], frame, LEFT)
            self._land(bodies.select(moved.rests), frame, heaped=True)
            self.dense = bodies.select(~(moved.rests | moved.left))
        if crowded.any():
            handed = self.sliding.select(crowded).marked(DENSE)
            log.become(handed)
            matter.add(handed, volumes[crowded])
            self.sliding = self.sliding.select(~crowded)
            self.dense = Bodies.join([self.dense, handed])

    def _resolve_contacts(self, bodies: Bodies, contacts: Meeting, frame: int) -> tuple[Bodies, Bodies]:
        """Let particles glide on, end, land or slide at their contacts, as the effect has it.

        Returns:
            The particles that glide on, and the new droplets of splashes, which have no ids yet.
        """
        air, log, response = self.air, self.log, self.air.effect.surface
        log.see(bodies, frame)
        if response.landing == "glides":
            into = (bodies.velocities * contacts.normals).sum(1, keepdims=True)
            return (
                replace(
                    bodies,
                    positions=(bodies.positions + CLEAR * contacts.normals).astype(np.float32),
                    velocities=(bodies.velocities - into * contacts.normals).astype(np.float32),
                ),
                Bodies.none(),
            )
        # What no camera would show here leaves nothing: those that are left stand for it too.
        needed = air.sight.needed(bodies.positions, bodies.reaches)
        log.end(bodies.ids[~needed], frame + 1, UNSEEN)
        bodies, contacts = bodies.select(needed), Meeting(*(values[needed] for values in contacts))
        stand_for = np.where(bodies.kinds & SPLASHED, bodies.represents, air.represents(bodies.positions, bodies.diameters))
        bodies = replace(bodies, represents=stand_for)
        if response.landing in ("wets", "vanishes"):
            droplets, share = Bodies.none(), np.zeros(len(bodies))
            if response.splash is not None:
                rng = air.draws(frame, 0x59A5)
                droplets, share = splashed(air, response.splash, bodies, contacts.normals, rng)
            self.deposits.wet(bodies, 1 - share)
            log.end(bodies.ids, frame + 1, ABSORBED)
            return Bodies.none(), droplets
        hold = air.ground.holds(contacts.normals, bodies.holds)
        self._land(bodies.select(hold), frame)
        slips = bodies.select(~hold).marked(SLID)
        normals = contacts.normals[~hold]
        along = slips.velocities - (slips.velocities * normals).sum(1, keepdims=True) * normals
        # A slider's position alone tells on which side of the surface it is, so it is lifted to the side it came from.
        lifted = slips.positions + LIFT * normals
        slips = replace(slips, positions=lifted.astype(np.float32), velocities=along.astype(np.float32))
        log.become(slips)
        self.sliding = Bodies.join([self.sliding, slips])
        return Bodies.none(), Bodies.none()

    def _land(self, bodies: Bodies, frame: int, *, heaped: bool = False) -> None:
        """Land particles on the cover, which they make thicker; see `Deposits.lay` for `heaped`."""
        cover = self.deposits.cover
        before = np.zeros(len(bodies)) if cover is None else cover.height(bodies.positions.astype(np.float64))
        covers = self.deposits.lay(bodies, heaped=heaped)
        if not heaped:
            # Contacts were made with the cover before it grew. Particles rise with it; the surface beneath has not moved.
            bodies = replace(bodies, positions=bodies.positions.copy())
            bodies.positions[:, 2] += (covers - before).astype(np.float32)
        self.log.land(bodies, covers, frame)


def _check(bodies: Bodies, frame: int) -> None:
    for name in ("positions", "velocities"):
        values: ndarray = getattr(bodies, name)
        bad = int((~np.isfinite(values)).any(1).sum())
        if bad:
            raise ValueError(f"the {name} of {bad} particles are NaN or infinite in frame {frame}")
