"""The air of a run and the particles that enter it: at the start or when the weather arrives, then through the top and the
sides.

Weather behind a front is steady weather cut off at the front: no particle is ahead of it. In each frame the particles enter
that the front has passed since the frame before, drawn from steady air. Particles that the wind carries ahead of the front
end. The air behind the front therefore holds as many particles as steady air, whether the wind is faster than the front or
slower.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.airborne import Flutter, advance, air_velocity
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.air.emitters import Sizes, feed, fill
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import ANY_DISTANCE, Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.laws.populations import fall_speed

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

    def newborn(self, positions: ndarray, diameters: ndarray, velocities: ndarray, rng: np.random.Generator) -> Bodies:
        """New particles without ids.

        Args:
            positions: [n, 3] m.
            diameters: [n] m.
            velocities: [n, 3] m/s.
            rng: draws flutter, hold and spin.
        """
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
            represents=self.sizes.represents(diameters).astype(np.float32),
            reaches=np.full(count, ANY_DISTANCE),
            kinds=np.zeros(count, np.uint8),
        )

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

    def entering(self, gone: Bodies, carry: float, frame: int) -> tuple[Bodies, float]:
        """New particles of a frame: through the top, through the sides, and where the weather arrives.

        Args:
            gone: particles that left the domain; each is replaced by one that enters at the opposite side.
            carry: fraction of a particle that is due to enter through the top.
            frame: the frame in which they enter.

        Returns:
            The particles, without ids, and the fraction of a particle to carry over to the next frame.
        """
        if self.arrival.is_over(frame * self.step):
            return Bodies.none(), carry
        rng, time = self.draws(frame), frame * self.step
        positions, diameters, share, carry = feed(self.sizes, self.domain, carry, self.step, rng)
        velocities = self.settled(positions, fall_speed(diameters, self.effect.material), time)
        positions = positions + velocities * (share * self.step)[:, None]
        self._wrap(positions)
        # Each particle entered at its own time within the step. The position of a front is that of this frame.
        entered = time if self.arrival.is_front else time - share * self.step
        arrived = self.arrival.times(positions, self.draws(frame, SHOWN).uniform(size=len(positions))) <= entered
        fed = self.newborn(positions, diameters, velocities, rng).select(arrived & self.sight.needed(positions))
        # During an onset fewer particles leave, so fewer enter at the opposite side: these need no thinning of their own.
        through_sides = self._wrapped(gone, time)
        through_sides = replace(through_sides, kinds=np.zeros_like(through_sides.kinds))
        return Bodies.join([fed, through_sides, self.arriving(frame)]), carry

    def _reached(self, frame: int) -> Bodies:
        """The particles of a full domain that the weather, which arrives everywhere, reaches in `frame`.

        They are in a steady state, so none is below a roof or under the ground. They follow from the seed alone and are drawn
        anew in each frame, so that an interrupted run needs no stored list of them.
        """
        rng, time = self.draws(0), frame * self.step
        positions, diameters = fill(self.sizes, self.domain, rng)
        new = self.newborn(positions, diameters, np.zeros_like(positions), rng)
        times = self.arrival.times(positions, self.draws(0, ARRIVING).uniform(size=len(positions)))
        now = np.ceil(times / self.step).clip(1.0 if self.effect.timeline.starts_clear else 0.0) == frame
        positions, speeds = positions[now], fall_speed(diameters[now], self.effect.material)
        velocities = self.settled(positions, speeds, time).astype(np.float32)
        new = replace(new.select(now), velocities=velocities)
        return new.select(~self.shadowed(positions, speeds, time) & self.sight.needed(positions))

    def _passed_by_front(self, frame: int) -> Bodies:
        """Particles ahead of the front in the frame before and behind it in `frame`, across the domain's sides too."""
        if frame == 0:
            return Bodies.none()
        rng, before = self.draws(frame, AHEAD), (frame - 1) * self.step
        positions, diameters = fill(self.sizes, self.domain, rng)
        ahead = self.arrival.times(positions) > before
        positions, diameters = positions[ahead], diameters[ahead]
        new = self.newborn(positions, diameters, np.zeros_like(positions), rng)
        # Particles of almost no terminal speed take the air's velocity at once, so the kernel yields settled velocities; it is
        # many times faster than `settled`.
        weightless, none = np.full(len(new), 1e-9, np.float32), Flutter.none(len(new))
        advance(new.positions.copy(), new.velocities, weightless, none, self.wind, before, self.step)
        new.velocities[:, 2] -= new.speeds
        self.fly(new, frame, WALK_AHEAD)
        return self._wrapped(new, frame * self.step)

    def _wrapped(self, bodies: Bodies, time: float) -> Bodies:
        """Particles wrapped into the domain, periodic in x and y. Those that cannot be there or are unneeded drop out."""
        inside = (bodies.positions[:, 2] >= self.domain.lower[2]) & (bodies.positions[:, 2] <= self.domain.upper[2])
        wrapped = bodies.positions.astype(np.float64)
        self._wrap(wrapped)
        inside &= self.sight.needed(wrapped) & self.arrival.passed(wrapped, time)
        inside[inside] = ~self.shadowed(wrapped[inside], bodies.speeds[inside], time)
        return replace(bodies.select(inside), positions=wrapped[inside].astype(np.float32))

    def _wrap(self, positions: Float[ndarray, "n 3"]) -> None:
        """Wrap x and y into the domain, in place."""
        lower, size = np.asarray(self.domain.lower[:2]), np.asarray(self.domain.size[:2])
        positions[:, :2] = lower + (positions[:, :2] - lower) % size
