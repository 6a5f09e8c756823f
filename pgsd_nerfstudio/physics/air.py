"""The air of a run, and what comes into it: full at the start, then fed through the top and from where the wind blows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.chunks import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.contact import Ground
from pgsd_nerfstudio.physics.emitters import Sizes, feed, fill
from pgsd_nerfstudio.physics.populations import fall_speed
from pgsd_nerfstudio.physics.sight import Sight
from pgsd_nerfstudio.physics.wind import WindField
from pgsd_nerfstudio.weather.effect import Effect


@dataclass(frozen=True)
class Air:
    """What does not change during a run."""

    domain: Domain
    sizes: Sizes
    wind: WindField
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

    def first(self) -> Bodies:
        """The air of frame 0: as if it had gone on for long, so nothing is below a roof or under the ground."""
        rng = self.draws(0)
        positions, diameters = fill(self.sizes, self.domain, rng)
        speeds = fall_speed(diameters, self.effect.material)
        new = self.newborn(positions, diameters, self.settled(positions, speeds, 0.0), rng)
        free = ~self.shadowed(positions, speeds, 0.0)
        return new.select(free & self.sight.needed(positions))

    def entering(self, gone: Bodies, carry: float, frame: int) -> tuple[Bodies, float]:
        """New particles: through the top, and opposite to where others (`gone`) left through a side."""
        rng, time = self.draws(frame), frame * self.step
        lower, size = np.asarray(self.domain.lower), np.asarray(self.domain.size)
        positions, diameters, share, carry = feed(self.sizes, self.domain, carry, self.step, rng)
        fallen = self.settled(positions, fall_speed(diameters, self.effect.material), time)
        positions = positions + fallen * (share * self.step)[:, None]
        positions[:, :2] = lower[:2] + (positions[:, :2] - lower[:2]) % size[:2]
        fed = self.newborn(positions, diameters, fallen, rng).select(self.sight.needed(positions))

        inside = (gone.positions[:, 2] >= lower[2]) & (gone.positions[:, 2] <= self.domain.upper[2])
        wrapped = gone.positions.astype(np.float64)
        wrapped[:, :2] = lower[:2] + (wrapped[:, :2] - lower[:2]) % size[:2]
        inside &= self.sight.needed(wrapped)
        inside[inside] = ~self.shadowed(wrapped[inside], gone.speeds[inside], time)
        again = gone.select(inside)
        blown = replace(again, positions=wrapped[inside].astype(np.float32), kinds=np.zeros_like(again.kinds))
        return Bodies.join([fed, blown]), carry
