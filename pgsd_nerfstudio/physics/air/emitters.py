"""Particles that enter the domain: their sizes, numbers and positions.

Steady weather is the same everywhere in the air: number density N(D) in the volume, flux N(D) v(D) through the top. The domain
therefore starts full (or fills when the weather arrives, see `air`), and particles enter through the top. A particle that the
wind carries out at one side enters at the opposite side as a new particle: no wedge stays empty, and nothing is simulated
outside of the domain.

There are far more real particles than can be simulated or seen. A real particle is simulated with a chance that grows with its
diameter, and then represents 1 / chance real particles: counts are thinned, the mass of water is not.
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
    """Tabulated spectrum of the simulated particles over their diameter."""

    diameters: Float[ndarray, " d"]
    """Metres, ascending."""
    chances: Float[ndarray, " d"]
    """Chance of a real particle of each diameter to be simulated."""
    in_air: Float[ndarray, " d"]
    """Simulated particles per m^3 with at most each diameter."""
    through_top: Float[ndarray, " d"]
    """Simulated particles per m^2 and second with at most each diameter."""
    real_in_air: float
    """Real particles per m^3 in the simulated range of sizes."""

    @staticmethod
    def of(effect: Effect, volume: float, max_particles: int) -> Sizes:
        """The spectrum of an effect, thinned to a number of particles.

        The simulated range of sizes carries all of the emission's water or extinction.

        Args:
            effect: its emission and material.
            volume: of the domain, m^3.
            max_particles: about the most particles in that volume at once.
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
        """Random diameters in metres, one from each of `count` equal parts of a spectrum, in random order.

        Args:
            cumulative: `in_air` or `through_top`.
            count: number of diameters.
            rng: source of the draws.
        """
        share = (rng.permutation(count) + rng.uniform(size=count)) / max(count, 1)
        return np.interp(share * cumulative[-1], cumulative, self.diameters)

    def represents(self, diameters: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        """Real particles that one simulated particle of each diameter represents.

        Args:
            diameters: m.
        """
        return 1.0 / np.interp(diameters, self.diameters, self.chances)


def fill(sizes: Sizes, domain: Domain, rng: np.random.Generator) -> tuple[Float[ndarray, "n 3"], Float[ndarray, " n"]]:
    """Positions and diameters in metres of the particles that fill the domain evenly."""
    count = round(sizes.in_air[-1] * domain.volume)
    positions = np.asarray(domain.lower) + rng.uniform(size=(count, 3)) * np.asarray(domain.size)
    return positions, sizes.draw(sizes.in_air, count, rng)


def feed(
    sizes: Sizes, domain: Domain, carry: float, step: float, rng: np.random.Generator
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, " n"], Float[ndarray, " n"], float]:
    """Particles that enter through the top within one step.

    Args:
        sizes: spectrum of the particles.
        domain: the air that they enter.
        carry: fraction of a particle that is due from the step before.
        step: s.
        rng: source of the draws.

    Returns:
        Positions at the top in metres, diameters in metres, the fraction of the step for which each particle has been inside,
        and the fraction of a particle to carry over to the next step.
    """
    due = sizes.through_top[-1] * domain.area * step + carry
    count = int(due)
    across = rng.uniform(size=(count, 2)) * np.asarray(domain.size[:2])
    positions = np.column_stack([np.asarray(domain.lower[:2]) + across, np.full(count, domain.upper[2])])
    return positions, sizes.draw(sizes.through_top, count, rng), rng.uniform(size=count), due - count
