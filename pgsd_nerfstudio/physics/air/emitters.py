"""What comes into the box of air: which sizes, how many, where.

Steady weather is the same everywhere in the air: number density N(D) in the volume, flux N(D) v(D) through the top. So the
box starts full (or fills when the weather comes, see `air`), is fed at the top, and what the wind blows out at one side comes
in at the opposite side as a new particle: no wedge stays empty, and nothing is simulated outside of the box.

There are far more real particles than can be simulated or seen. A real particle is simulated with a chance that grows with its
diameter, and then represents 1 / chance of its kind: counts are thinned, water is not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.populations import cumulative, fall_speed, integral, number_density


@dataclass(frozen=True)
class Sizes:
    """Tabulated spectrum of what is simulated, over the diameter."""

    diameters: Float[ndarray, " d"]
    """Metres, ascending."""
    chances: Float[ndarray, " d"]
    """Chance of a real particle of that size to be simulated."""
    in_air: Float[ndarray, " d"]
    """Simulated particles in 1 m^3 with at most that diameter."""
    through_top: Float[ndarray, " d"]
    """Simulated particles through 1 m^2 in 1 s with at most that diameter."""
    real_in_air: float
    """Real particles of the simulated range of sizes in 1 m^3."""

    @staticmethod
    def of(effect: Effect, volume: float, max_particles: int) -> Sizes:
        """The spectrum of an effect, thinned so that about `max_particles` are in `volume` m^3 of air at once.

        All of what is asked for is carried by the simulated range of sizes.
        """
        emission, material = effect.emission, effect.material
        diameter = np.geomspace(emission.smallest, emission.largest, 1024)
        density, speeds = number_density(diameter, emission, material), fall_speed(diameter, material)
        weight = (diameter / emission.largest) ** emission.importance

        def simulated(factor: float) -> float:
            return integral(density * np.minimum(1.0, factor * weight), diameter) * volume

        low, high = 0.0, float(1.0 / weight.min())
        if simulated(high) > max_particles:
            for _ in range(60):
                factor = (low + high) / 2
                low, high = (factor, high) if simulated(factor) < max_particles else (low, factor)
        chance = np.minimum(1.0, high * weight)
        return Sizes(
            diameter,
            chance,
            cumulative(density * chance, diameter),
            cumulative(density * chance * speeds, diameter),
            integral(density, diameter),
        )

    def draw(self, cumulative: Float[ndarray, " d"], count: int, rng: np.random.Generator) -> Float[ndarray, " n"]:
        """`count` diameters of that spectrum, one from each of `count` equal parts of it, in random order."""
        share = (rng.permutation(count) + rng.uniform(size=count)) / max(count, 1)
        return np.interp(share * cumulative[-1], cumulative, self.diameters)

    def represents(self, diameters: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        """How many real particles one simulated particle of that size stands for."""
        return 1.0 / np.interp(diameters, self.diameters, self.chances)


def fill(sizes: Sizes, domain: Domain, rng: np.random.Generator) -> tuple[Float[ndarray, "n 3"], Float[ndarray, " n"]]:
    """Positions and diameters of what is in the air at the start: evenly spread over the box."""
    count = round(sizes.in_air[-1] * domain.volume)
    positions = np.asarray(domain.lower) + rng.uniform(size=(count, 3)) * np.asarray(domain.size)
    return positions, sizes.draw(sizes.in_air, count, rng)


def feed(
    sizes: Sizes, domain: Domain, carry: float, step: float, rng: np.random.Generator
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, " n"], Float[ndarray, " n"], float]:
    """What comes in through the top within one step of `step` seconds.

    Returns positions at the top, diameters, the share of the step that each has been inside for, and the fraction of a particle
    to carry over to the next step.
    """
    due = sizes.through_top[-1] * domain.area * step + carry
    count = int(due)
    across = rng.uniform(size=(count, 2)) * np.asarray(domain.size[:2])
    positions = np.column_stack([np.asarray(domain.lower[:2]) + across, np.full(count, domain.upper[2])])
    return positions, sizes.draw(sizes.through_top, count, rng), rng.uniform(size=count), due - count
