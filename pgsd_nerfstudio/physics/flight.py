"""From one frame to the next: fly, land, leave, enter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.airborne import Flutter, advance
from pgsd_nerfstudio.physics.chunks import LANDED, LEFT, SLID, Bodies, Chunk, State
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.contact import Ground
from pgsd_nerfstudio.physics.emitters import Sizes, feed, fill
from pgsd_nerfstudio.physics.wind import WindField
from pgsd_nerfstudio.weather.effect import Effect
from pgsd_nerfstudio.weather.snowfall import fall_speed


@dataclass(frozen=True)
class Air:
    """What does not change during a run."""

    domain: Domain
    sizes: Sizes
    wind: WindField
    effect: Effect
    ground: Ground
    step: float
    seed: int

    def draws(self, frame: int) -> np.random.Generator:
        """The randomness of one frame; the same however the run came there."""
        return np.random.default_rng([self.seed, frame, 0x5704])

    def settled(self, positions: ndarray, speeds: ndarray, time: float) -> Float[ndarray, "n 3"]:
        """Velocity at which drag and gravity balance."""
        velocity = self.wind.velocity(positions.astype(np.float64), time)
        velocity[:, 2] -= speeds
        return velocity

    def newborn(self, born: int, positions: ndarray, diameters: ndarray, time: float, rng: np.random.Generator) -> Bodies:
        """Particles at their settled velocity, with ids from `born` on."""
        count, wind = len(diameters), self.effect.wind
        speeds = fall_speed(diameters, self.effect.material)
        draw = rng.uniform(size=(5, count))
        values = (
            positions,
            self.settled(positions, speeds, time),
            diameters,
            speeds,
            wind.flutter * (0.3 + 1.4 * draw[0]),
            wind.flutter_hertz * (0.6 + 0.8 * draw[1]) * np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0),
            draw[2],
            draw[3],
            draw[4],
        )
        return Bodies(np.arange(born, born + count, dtype=np.int32), *(value.astype(np.float32) for value in values))


def simulate_chunk(air: Air, state: State, start: int, frames: int) -> Chunk:
    """Simulate `frames` frames from `start` on.

    Raises:
        ValueError: a position or velocity became NaN or infinite.
    """
    first = state.born
    rows: list[tuple[ndarray, ndarray, ndarray]] = []
    births: list[tuple[int, Bodies]] = []
    ends: list[tuple[ndarray, int, int]] = []
    contacts: list[Bodies] = []
    bodies, carry = Bodies.join([state.bodies]), state.carry  # a copy: flying changes it in place
    born = first
    for frame in range(start, start + frames):
        if frame == 0:
            entering = _first(air)
        else:
            before = bodies.positions.copy()
            _fly(air, bodies, frame)
            stays, gone, landed, slid = _meet(air, before, bodies)
            entering, carry = _enter(air, bodies.select(gone), born, carry, frame)
            contacts.append(bodies.select(landed))
            ends += [
                (bodies.ids[gone], frame, LEFT),
                (bodies.ids[landed], frame + 1, LANDED),
                (bodies.ids[slid], frame + 1, SLID),
            ]
            seen = np.sort(np.concatenate([stays, landed, slid]))
            rows.append((bodies.ids[seen], np.full(len(seen), frame, np.int32), bodies.positions[seen]))
            bodies = bodies.select(stays)
        births.append((frame, entering))
        rows.append((entering.ids, np.full(len(entering), frame, np.int32), entering.positions.copy()))
        born += len(entering)
        bodies = Bodies.join([bodies, entering])
        _check(bodies, frame)
    new = Bodies.join([entering for _, entering in births])
    lying = Bodies.join([*contacts, Bodies.none()])
    rest = air.ground.rest(lying.positions, lying.spins)
    quats = np.random.default_rng([air.seed, start, 0x0417]).normal(size=(born - first, 4))
    return Chunk(
        start=start,
        frames=frames,
        row_ids=np.concatenate([row[0] for row in rows]),
        row_frames=np.concatenate([row[1] for row in rows]),
        row_positions=np.concatenate([row[2] for row in rows]),
        births=np.concatenate([np.full(len(entering), frame, np.int32) for frame, entering in births]),
        diameters=new.diameters,
        represents=air.sizes.represents(new.diameters).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        ended_ids=np.concatenate([np.zeros(0, np.int32), *(ids for ids, _, _ in ends)]),
        ended_frames=np.concatenate([np.zeros(0, np.int32), *(np.full(len(ids), end, np.int32) for ids, end, _ in ends)]),
        ended_how=np.concatenate([np.zeros(0, np.uint8), *(np.full(len(ids), how, np.uint8) for ids, _, how in ends)]),
        rest_ids=lying.ids,
        rest_positions=rest.positions,
        rest_quats=rest.quats,
        rest_extents=rest.extents,
        state=State(bodies, born, carry),
    )


def _first(air: Air) -> Bodies:
    """The air of frame 0: as if it had snowed for long, so nothing is below a roof or under the ground."""
    rng = air.draws(0)
    positions, diameters = fill(air.sizes, air.domain, rng)
    came_from = -air.settled(positions, fall_speed(diameters, air.effect.material), 0.0)
    free = air.ground.open_above(positions, came_from)
    return air.newborn(0, positions[free], diameters[free], 0.0, rng)


def _fly(air: Air, bodies: Bodies, frame: int) -> None:
    flutter = Flutter(bodies.sways, bodies.hertz, bodies.phases)
    advance(bodies.positions, bodies.velocities, bodies.speeds, flutter, air.wind, (frame - 1) * air.step, air.step)


def _meet(air: Air, before: Float[ndarray, "n 3"], bodies: Bodies) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Which particles fly on, leave, land and slide off; those that touched are put at their contact."""
    meeting = air.ground.meet(before, bodies.positions)
    bodies.positions[meeting.which] = meeting.points
    hold = air.ground.holds(meeting.normals, bodies.holds[meeting.which])
    lower, upper = np.asarray(air.domain.lower, np.float32), np.asarray(air.domain.upper, np.float32)
    out = ((bodies.positions < lower) | (bodies.positions > upper)).any(1)
    out[meeting.which] = False
    flies = ~out
    flies[meeting.which] = False
    return flies.nonzero()[0], out.nonzero()[0], meeting.which[hold], meeting.which[~hold]


def _enter(air: Air, gone: Bodies, born: int, carry: float, frame: int) -> tuple[Bodies, float]:
    """New particles: through the top, and opposite to where others left through a side."""
    rng, time = air.draws(frame), frame * air.step
    lower, size = np.asarray(air.domain.lower), np.asarray(air.domain.size)
    positions, diameters, share, carry = feed(air.sizes, air.domain, carry, air.step, rng)
    fallen = air.settled(positions, fall_speed(diameters, air.effect.material), time)
    positions = positions + fallen * (share * air.step)[:, None]
    positions[:, :2] = lower[:2] + (positions[:, :2] - lower[:2]) % size[:2]
    fed = air.newborn(born, positions, diameters, time, rng)

    inside = (gone.positions[:, 2] >= lower[2]) & (gone.positions[:, 2] <= air.domain.upper[2])
    wrapped = gone.positions.astype(np.float64)
    wrapped[:, :2] = lower[:2] + (wrapped[:, :2] - lower[:2]) % size[:2]
    came_from = -air.settled(wrapped, gone.speeds, time)
    inside &= air.ground.open_above(wrapped, came_from)
    blown = gone.select(inside)
    blown = Bodies(
        np.arange(born + len(fed), born + len(fed) + len(blown), dtype=np.int32),
        wrapped[inside].astype(np.float32),
        *(getattr(blown, name) for name in ("velocities", "diameters", "speeds", "sways", "hertz", "phases", "holds", "spins")),
    )
    return Bodies.join([fed, blown]), carry


def _check(bodies: Bodies, frame: int) -> None:
    for name in ("positions", "velocities"):
        bad = int((~np.isfinite(getattr(bodies, name))).any(1).sum())
        if bad:
            raise ValueError(f"the {name} of {bad} particles are NaN or infinite in frame {frame}")
