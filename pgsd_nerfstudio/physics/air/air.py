"""The air of a run and the particles that enter it: at the start or when the weather arrives, then through top and sides.

Weather behind a front is steady weather cut off at the front: no particle is ahead of it. In each frame the particles enter
that the front has passed since the frame before, drawn from steady air. Particles that the wind carries ahead of the front
end. The air behind the front therefore holds as many particles as steady air, whether the wind is faster than the front or
slower.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.airborne import Flutter, Instant, advance, air_velocity
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.air.emitters import Newcomers, Sizes, fill, outside
from pgsd_nerfstudio.physics.air.foresight import foresee
from pgsd_nerfstudio.physics.air.sight import WIDEST_SWAY, Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import NO_END, Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.laws.boundary_layer import law_of_the_wall
from pgsd_nerfstudio.physics.laws.populations import fall_speed

ROOM = 4.0  # standard deviations of the turbulence for which air around the domain is searched for what enters
ARRIVING, SHOWN, AHEAD, WALK, WALK_AHEAD = 0xA221, 0x5404, 0xF207, 0xD1FF, 0xD1FA  # purposes of randomness


@dataclass(frozen=True)
class Air:
    """Everything that does not change during a run."""

    domain: Domain
    sizes: Sizes
    wind: WindField
    arrival: Arrival
    effect: Effect
    ground: Ground
    sight: Sight
    step: float
    """Seconds from frame to frame."""
    seed: int
    _kept: dict[tuple[float, float], Instant] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The wind at the times to which newcomers are led."""

    def draws(self, frame: int, purpose: int = 0x5704) -> np.random.Generator:
        """Random numbers that depend on the seed, the frame and the purpose alone, not on how the run reached the frame.

        Args:
            frame: frame in which they are drawn.
            purpose: any number that tells uses of random numbers in a frame apart.
        """
        return np.random.default_rng([self.seed, frame, purpose])

    def settled(self, positions: ndarray, speeds: ndarray, time: float) -> Float[ndarray, "n 3"]:
        """Velocity in m/s at which drag and gravity balance: the wind plus the terminal velocity.

        Args:
            positions: [n, 3] m.
            speeds: [n] terminal speeds, m/s.
            time: s.
        """
        velocity = air_velocity(positions.astype(np.float32), self.wind, time)
        velocity[:, 2] -= speeds
        return velocity

    def shadowed(self, positions: ndarray, speeds: ndarray, time: float) -> ndarray:
        """Which new particles cannot be where they are because the surface blocks their path from the sky, [n].

        Fog, which glides along surfaces, reaches every place.

        Args:
            positions: [n, 3] m.
            speeds: [n] terminal speeds, m/s.
            time: s.
        """
        if self.effect.surface.landing == "glides":
            return np.zeros(len(positions), bool)
        # The undisturbed wind is taken: with the updraft before a wall, particles would seem to come from the ground.
        came = air_velocity(positions.astype(np.float32), self.wind.undisturbed, time)
        came[:, 2] -= speeds
        return ~self.ground.open_above(positions, -came)

    def newborn(self, found: Newcomers, velocities: ndarray, rng: np.random.Generator) -> Bodies:
        """New particles without ids.

        Args:
            found: their places, sizes and reaches.
            velocities: [n, 3] m/s.
            rng: draws flutter, hold and spin.
        """
        positions, diameters, reaches = found
        count, wind = len(diameters), self.effect.wind
        speeds = fall_speed(diameters, self.effect.material)
        draw = rng.uniform(size=(5, count))
        return Bodies(
            ids=np.full(count, -1, np.int32),
            positions=positions.astype(np.float32),
            velocities=velocities.astype(np.float32),
            diameters=diameters.astype(np.float32),
            speeds=speeds.astype(np.float32),
            sways=(wind.flutter * (0.3 + 1.4 * draw[0])).astype(np.float32),
            hertz=(wind.flutter_hertz * (0.6 + 0.8 * draw[1]) * np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0)).astype(
                np.float32
            ),
            phases=draw[2].astype(np.float32),
            holds=draw[3].astype(np.float32),
            spins=draw[4].astype(np.float32),
            represents=self.represents(positions, diameters),
            reaches=reaches.astype(np.float32),
            since=np.zeros(count, np.int32),
            until=np.full(count, NO_END, np.int32),
            kinds=np.zeros(count, np.uint8),
        )

    def represents(self, positions: ndarray, diameters: ndarray) -> Float[ndarray, " n"]:
        """Real particles that particles represent where they are, float32.

        Args:
            positions: [n, 3] m.
            diameters: [n] m.
        """
        return self.sizes.represents(diameters, self.sight.distances(positions)).astype(np.float32)

    def fly(self, bodies: Bodies, frame: int, purpose: int = WALK) -> None:
        """Move flying particles from the frame before to `frame`.

        Args:
            bodies: the particles; positions and velocities are changed in place.
            frame: the frame they arrive at.
            purpose: of the draws for their random walk.
        """
        flutter = Flutter(bodies.sways, bodies.hertz, bodies.phases)
        advance(bodies.positions, bodies.velocities, bodies.speeds, flutter, self.wind, (frame - 1) * self.step, self.step)
        spread = np.sqrt(2 * self.effect.wind.diffusivity * self.step)
        if spread > 0:
            walk = self.draws(frame, purpose).normal(scale=spread, size=bodies.positions.shape)
            bodies.positions[:] += walk.astype(np.float32)

    def arriving(self, frame: int) -> Bodies:
        """New particles in places that the weather has reached since the frame before; without an onset all, in frame 0."""
        if (frame - 1) * self.step >= self.effect.timeline.onset:
            return Bodies.none()
        return self._passed_by_front(frame) if self.arrival.is_front else self._reached(frame)

    def entering(self, frame: int) -> Bodies:
        """New particles of a frame, without ids: through the top and the sides, and where the weather arrives.

        Those that do not matter yet have a frame `since` that is later.

        Args:
            frame: the frame in which they enter.
        """
        if self.arrival.is_over(frame * self.step):
            return Bodies.none()
        rng, time = self.draws(frame), frame * self.step
        found = outside(self.sizes, self.domain, self.sight, self._margins(time), rng)
        speeds = fall_speed(found.diameters, self.effect.material)
        velocities = self.settled(found.positions, speeds, time - 0.5 * self.step)
        moved = found._replace(positions=found.positions + velocities * self.step)
        inside = self.domain.contains(moved.positions)
        # The position of a front is that of this frame.
        arrived = self.arrival.times(moved.positions, self.draws(frame, SHOWN).uniform(size=len(inside))) <= time
        enters = inside & arrived & self.sight.needed(moved.positions, moved.reaches)
        new = self.newborn(moved.select(enters), velocities[enters], rng)
        # What comes through the top comes from the sky; through a side it may come from the lee of a wall or from below a roof.
        beside = found.positions[enters, 2] <= self.domain.upper[2]
        beside[beside] = self.shadowed(new.positions[beside], new.speeds[beside], time)
        return Bodies.join([self._that_matter(new.select(~beside), frame), self.arriving(frame)])

    def _that_matter(self, new: Bodies, frame: int) -> Bodies:
        """Of new particles those that will be seen, from when on they will; all of them where distance does not matter."""
        if self.sizes.sharpness is None:
            return new
        where = {"domain": self.domain, "sight": self.sight}
        return foresee(new, frame, step=self.step, wind=self.wind, kept=self._kept, **where)

    def unhidden(self, late: Bodies, frame: int) -> Bodies:
        """Of particles that waited those that nothing held up on their way.

        Args:
            late: particles that begin to matter in `frame`.
            frame: the frame.
        """
        return late.select(~self.shadowed(late.positions, late.speeds, frame * self.step))

    def _margins(self, time: float) -> Float[ndarray, "2 3"]:
        """Metres around the domain from which particles may enter within a step: its lower and its upper sides."""
        wind = self.effect.wind
        growth = float(law_of_the_wall(np.array(self.domain.upper[2:], float), wind.roughness, wind.reference_height)[0])
        mean = np.array([*(growth * self.wind.at_reference(time)), 0.0])
        swirl = ROOM * wind.turbulence + WIDEST_SWAY * wind.flutter
        inward = np.array([mean + swirl, swirl - mean])
        inward[1, 2] += float(fall_speed(self.sizes.diameters[[0, -1]], self.effect.material).max())
        return inward.clip(0.0) * self.step

    def _reached(self, frame: int) -> Bodies:
        """The particles of a full domain that the weather, which arrives everywhere, reaches in `frame`.

        They are in a steady state, so none is below a roof or under the ground. They follow from the seed alone and are drawn
        anew in each frame, so that an interrupted run needs no stored list of them.
        """
        rng, time = self.draws(0), frame * self.step
        found = fill(self.sizes, self.domain, self.sight, rng)
        times = self.arrival.times(found.positions, self.draws(0, ARRIVING).uniform(size=len(found.positions)))
        now = np.ceil(times / self.step).clip(1.0 if self.effect.timeline.starts_clear else 0.0) == frame
        now[now] = self.sight.needed(found.positions[now], found.reaches[now])
        found = found.select(now)
        speeds = fall_speed(found.diameters, self.effect.material)
        new = self.newborn(found, self.settled(found.positions, speeds, time), self.draws(frame, ARRIVING))
        new = self._that_matter(new, frame)
        # Those that wait are looked at when they begin to matter (`unhidden`).
        due = new.since <= frame
        due[due] = self.shadowed(new.positions[due], new.speeds[due], time)
        return new.select(~due)

    def _passed_by_front(self, frame: int) -> Bodies:
        """Particles ahead of the front in the frame before and behind it in `frame`."""
        if frame == 0:
            return Bodies.none()
        rng, before, time = self.draws(frame, AHEAD), (frame - 1) * self.step, frame * self.step
        found = fill(self.sizes, self.domain, self.sight, rng, self._before_front(before))
        found = found.select(self.arrival.times(found.positions) > before)
        speeds = fall_speed(found.diameters, self.effect.material)
        new = self.newborn(found, self.settled(found.positions, speeds, before + 0.5 * self.step), rng)
        self.fly(new, frame, WALK_AHEAD)
        inside = self.domain.contains(new.positions)
        inside &= self.sight.needed(new.positions, new.reaches) & self.arrival.passed(new.positions, time)
        inside[inside] = ~self.shadowed(new.positions[inside], new.speeds[inside], time)
        return self._that_matter(new.select(inside), frame)

    def _before_front(self, before: float) -> Bool[ndarray, "x y z"] | None:
        """Cells of the region of sight from which a front may be met within a step; None where there are no cells."""
        if not self.sight.needed_distances.size:
            return None
        columns = np.moveaxis(np.indices(self.sight.needed_distances.shape[:2]), 0, -1) + 0.5
        flat = (self.sight.lower[:2] + columns * self.sight.cell[:2]).reshape(-1, 2)
        times = self.arrival.times(np.column_stack([flat, np.zeros(len(flat))])).reshape(columns.shape[:2])
        # Half a cell, the way of the front, and the way of a particle against it.
        room = np.hypot(*self.sight.cell[:2]) / 2 + np.abs(self._margins(before)[:, :2]).max() * 2
        slack = self.effect.timeline.onset * room / self.arrival.spans.sum() + self.step
        near = (times > before - slack) & (times <= before + self.step + slack)
        return np.broadcast_to(near[:, :, None], self.sight.needed_distances.shape)
