"""The air of a run, and what comes into it: there from the start or when the weather arrives, then fed through the top and from
where the wind blows.

A weather that comes behind a front is steady weather of which only what lies behind the front is there. So in each frame comes
what was ahead of the front and is behind it now, drawn from steady air; and what the wind carries out ahead of the front ends.
The air behind it thus holds what steady air does, whether the wind is faster than the front or slower.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.airborne import Flutter, advance
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.air.emitters import Sizes, feed, fill
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.laws.populations import fall_speed

ARRIVING, SHOWN, AHEAD, WALK, WALK_AHEAD = 0xA221, 0x5404, 0xF207, 0xD1FF, 0xD1FA  # purposes of randomness


@dataclass(frozen=True)
class Air:
    """What does not change during a run."""

    domain: Domain
    sizes: Sizes
    wind: WindField
    arrival: Arrival
    effect: Effect
    ground: Ground
    sight: Sight
    step: float
    seed: int

    def draws(self, frame: int, purpose: int = 0x5704) -> np.random.Generator:
        """The randomness of one frame and purpose; the same however the run came there."""
        return np.random.default_rng([self.seed, frame, purpose])

    def settled(self, positions: ndarray, speeds: ndarray, time: float) -> Float[ndarray, "n 3"]:
        """Velocity at which drag and gravity balance."""
        velocity = self.wind.velocity(positions.astype(np.float64), time)
        velocity[:, 2] -= speeds
        return velocity

    def shadowed(self, positions: ndarray, speeds: ndarray, time: float) -> ndarray:
        """Which of new particles could not have come here, because something stands in their way from the sky.

        Fog that flows along surfaces comes everywhere.
        """
        if self.effect.surface.landing == "glides":
            return np.zeros(len(positions), bool)
        # Of the undisturbed wind: in the updraft before a wall the deflected one would have it come from the ground.
        came = self.wind.undisturbed.velocity(positions.astype(np.float64), time)
        came[:, 2] -= speeds
        return ~self.ground.open_above(positions, -came)

    def newborn(self, positions: ndarray, diameters: ndarray, velocities: ndarray, rng: np.random.Generator) -> Bodies:
        """Particles still without ids."""
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
            kinds=np.zeros(count, np.uint8),
        )

    def fly(self, bodies: Bodies, frame: int, purpose: int = WALK) -> None:
        """Carry particles from the frame before to `frame`, in place; `purpose` is that of their random walk."""
        flutter = Flutter(bodies.sways, bodies.hertz, bodies.phases)
        advance(bodies.positions, bodies.velocities, bodies.speeds, flutter, self.wind, (frame - 1) * self.step, self.step)
        spread = np.sqrt(2 * self.effect.wind.diffusivity * self.step)
        if spread > 0:
            walk = self.draws(frame, purpose).normal(scale=spread, size=bodies.positions.shape)
            bodies.positions[:] += walk.astype(np.float32)

    def arriving(self, frame: int) -> Bodies:
        """What is in the air in `frame` because the weather has just come to it there; without an onset all, in frame 0."""
        if (frame - 1) * self.step >= self.effect.timeline.onset:
            return Bodies.none()
        return self._overtaken(frame) if self.arrival.is_front else self._risen(frame)

    def entering(self, gone: Bodies, carry: float, frame: int) -> tuple[Bodies, float]:
        """New particles: through the top, opposite to where others (`gone`) left through a side, where the weather arrives."""
        if self.arrival.is_over(frame * self.step):
            return Bodies.none(), carry
        rng, time = self.draws(frame), frame * self.step
        lower, size = np.asarray(self.domain.lower), np.asarray(self.domain.size)
        positions, diameters, share, carry = feed(self.sizes, self.domain, carry, self.step, rng)
        fallen = self.settled(positions, fall_speed(diameters, self.effect.material), time)
        positions = positions + fallen * (share * self.step)[:, None]
        positions[:, :2] = lower[:2] + (positions[:, :2] - lower[:2]) % size[:2]
        # Each came in at its own time within the step; a front is where it is in this frame.
        came = time if self.arrival.is_front else time - share * self.step
        comes = self.arrival.times(positions, self.draws(frame, SHOWN).uniform(size=len(positions))) <= came
        fed = self.newborn(positions, diameters, fallen, rng).select(comes & self.sight.needed(positions))
        # Within an onset fewer leave, and so fewer come in: these need no thinning of their own.
        blown = self._around(gone, time)
        return Bodies.join([fed, replace(blown, kinds=np.zeros_like(blown.kinds)), self.arriving(frame)]), carry

    def _risen(self, frame: int) -> Bodies:
        """Those of the air's first particles that come in `frame`: as if they had been on their way for long, so none is below
        a roof or under the ground.

        They follow from the seed alone and are drawn anew in each frame, so that nothing has to be kept for a run that goes on.
        """
        rng, time = self.draws(0), frame * self.step
        positions, diameters = fill(self.sizes, self.domain, rng)
        new = self.newborn(positions, diameters, np.zeros_like(positions), rng)
        times = self.arrival.times(positions, self.draws(0, ARRIVING).uniform(size=len(positions)))
        comes = np.ceil(times / self.step).clip(1.0 if self.effect.timeline.starts_clear else 0.0) == frame
        positions, speeds = positions[comes], fall_speed(diameters[comes], self.effect.material)
        velocities = self.settled(positions, speeds, time).astype(np.float32)
        new = replace(new.select(comes), velocities=velocities)
        return new.select(~self.shadowed(positions, speeds, time) & self.sight.needed(positions))

    def _overtaken(self, frame: int) -> Bodies:
        """What was ahead of the front in the frame before and is behind it in `frame`, also around the sides of the box."""
        if frame == 0:
            return Bodies.none()
        rng, before = self.draws(frame, AHEAD), (frame - 1) * self.step
        positions, diameters = fill(self.sizes, self.domain, rng)
        ahead = self.arrival.times(positions) > before
        positions, diameters = positions[ahead], diameters[ahead]
        new = self.newborn(positions, diameters, np.zeros_like(positions), rng)
        # Settled, by the kernel, which is many times faster than `settled`: what hardly falls has at once the air's velocity.
        weightless, none = np.full(len(new), 1e-9, np.float32), Flutter.none(len(new))
        advance(new.positions.copy(), new.velocities, weightless, none, self.wind, before, self.step)
        new.velocities[:, 2] -= new.speeds
        self.fly(new, frame, WALK_AHEAD)
        return self._around(new, frame * self.step)

    def _around(self, bodies: Bodies, time: float) -> Bodies:
        """Particles put where they are in a box that goes on at its opposite side; those that can be there, and are needed."""
        lower, size = np.asarray(self.domain.lower), np.asarray(self.domain.size)
        inside = (bodies.positions[:, 2] >= lower[2]) & (bodies.positions[:, 2] <= self.domain.upper[2])
        wrapped = bodies.positions.astype(np.float64)
        wrapped[:, :2] = lower[:2] + (wrapped[:, :2] - lower[:2]) % size[:2]
        inside &= self.sight.needed(wrapped) & self.arrival.passed(wrapped, time)
        inside[inside] = ~self.shadowed(wrapped[inside], bodies.speeds[inside], time)
        return replace(bodies.select(inside), positions=wrapped[inside].astype(np.float32))
