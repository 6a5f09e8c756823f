"""Particles that enter the domain: their sizes, numbers, positions and reaches.

Steady weather is the same everywhere in the air, also outside of the domain. The domain therefore starts full (or fills when
the weather arrives, see `air`). In each frame the particles enter that were outside in the frame before and whose velocity
carries them in: through the top, and through the sides where the wind comes from, flux times area. What leaves is gone.

There are far more real particles than can be simulated or seen. Where cameras are given, the particles that they tell apart are
all there, and ever fewer farther away (`reach`): each cell of the region of sight is filled with those whose reach is as great
as its distance. Without cameras, and for parcels of fog, a real particle is simulated with a chance that is the same
everywhere and grows with its diameter. Either way a particle represents 1 / chance real ones: counts are thinned, the mass of
water is not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.reach import kept, reaches
from pgsd_nerfstudio.physics.air.sight import CLOSEST, Sight
from pgsd_nerfstudio.physics.bodies import ANY_DISTANCE
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.populations import cumulative, integral, number_density

CANDIDATES = 2_000_000  # particles that may come into view; at most so many, or ten to one that is in view, are led along


class Newcomers(NamedTuple):
    """Particles that may enter."""

    positions: Float[ndarray, "n 3"]
    """Metres."""
    diameters: Float[ndarray, " n"]
    """Metres."""
    reaches: Float[ndarray, " n"]
    """Metres."""

    @staticmethod
    def join(parts: list[Newcomers]) -> Newcomers:
        none = Newcomers(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        return Newcomers(*(np.concatenate(arrays) for arrays in zip(none, *parts, strict=True)))

    def select(self, which: ndarray) -> Newcomers:
        return Newcomers(*(array[which] for array in self))


@dataclass(frozen=True)
class Sizes:
    """Tabulated spectrum of the simulated particles over their diameter."""

    diameters: Float[ndarray, " d"]
    """Metres, ascending."""
    density: Float[ndarray, " d"]
    """Real particles per m^3 and metre of diameter."""
    chances: Float[ndarray, " d"]
    """Chance of a real particle of each diameter to be simulated, apart from its reach."""
    sharpness: float | None
    """Distance up to which all particles are kept, relative to their diameter; None: thinning does not depend on distance."""
    _spectra: dict[float, Float[ndarray, " d"]] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What `in_air` found, by distance: it is asked for the same few in every frame."""

    @staticmethod
    def of(effect: Effect, domain: Domain, max_particles: int, sight: Sight, sharpness: float | None = None) -> Sizes:
        """The spectrum of an effect, thinned to a number of particles.

        The simulated range of sizes carries all of the emission's water or extinction.

        Args:
            effect: its emission and material.
            domain: the simulated air.
            max_particles: about the most particles in it at once; where cameras are given, the most that they see.
            sight: distances of its cells from cameras.
            sharpness: distance up to which cameras tell all particles apart, relative to their diameter; it is lowered where
                there would be too many particles. None: particles are thinned alike everywhere.
        """
        emission = effect.emission
        diameter = np.geomspace(emission.smallest, emission.largest, 1024)
        density = number_density(diameter, emission, effect.material)
        if sharpness is None or not sight.needed_distances.size:
            weight = (diameter / emission.largest) ** emission.importance

            def evenly(factor: float) -> float:
                return integral(density * np.minimum(1.0, factor * weight), diameter) * domain.volume

            factor = _largest(evenly, float(1.0 / weight.min()), max_particles)
            return Sizes(diameter, density, np.minimum(1.0, factor * weight), None)
        for distances, most in (
            (sight.seen_distances, max_particles),
            (sight.needed_distances, max(CANDIDATES, 10 * max_particles)),
        ):
            levels = distances[np.isfinite(distances)].clip(CLOSEST)
            if levels.size:
                cells, edges = np.histogram(levels, np.geomspace(0.9 * CLOSEST, max(float(levels.max()), 1.0) * 1.01, 64))
                volumes, middles = (cells * sight.cell.prod())[:, None], np.sqrt(edges[1:] * edges[:-1])[:, None]

                def by_distance(sharpness: float, volumes: ndarray = volumes, middles: ndarray = middles) -> float:
                    # Particles of 256 sizes are enough to count them.
                    some = diameter[::4]
                    return integral(density[::4] * (volumes * kept(sharpness * some, middles)).sum(0), some)

                sharpness = _largest(by_distance, sharpness, most)
        return Sizes(diameter, density, np.ones_like(density), sharpness)

    @property
    def real_in_air(self) -> float:
        """Real particles per m^3 in the simulated range of sizes."""
        return integral(self.density, self.diameters)

    def in_air(self, distance: float = 0.0) -> Float[ndarray, " d"]:
        """Simulated particles per m^3 with at most each diameter, at a distance in metres from cameras."""
        if distance not in self._spectra:
            self._spectra[distance] = cumulative(self.density * self._chance(self.diameters, distance), self.diameters)
        return self._spectra[distance]

    def draw(self, count: int, distance: float, rng: np.random.Generator) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
        """Random diameters and reaches in metres of `count` particles, one from each of as many equal parts of the spectrum.

        Args:
            count: number of particles.
            distance: that at least they reach, in metres.
            rng: source of the draws.
        """
        spectrum = self.in_air(distance)
        share = (np.arange(count) + rng.uniform(size=count)) / max(count, 1)
        # Ascending values are looked up several times as fast; the order is drawn after.
        diameters = np.interp(share * spectrum[-1], spectrum, self.diameters)[rng.permutation(count)]
        if self.sharpness is None:
            return diameters, np.full(count, float(ANY_DISTANCE))
        return diameters, reaches(self.sharpness * diameters, distance, rng.uniform(size=count))

    def represents(self, diameters: Float[ndarray, " n"], distances: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        """Real particles that one simulated particle of each diameter represents.

        Args:
            diameters: m.
            distances: from cameras in metres, as `Sight.distances` gives them; infinite ones count as 1e9 m.
        """
        return 1.0 / self._chance(diameters, np.minimum(distances, float(ANY_DISTANCE)))

    def _chance(self, diameters: Float[ndarray, " n"], distances: Float[ndarray, " n"] | float) -> Float[ndarray, " n"]:
        if self.sharpness is None:
            return np.interp(diameters, self.diameters, self.chances)
        return kept(self.sharpness * diameters, distances)


def fill(
    sizes: Sizes, domain: Domain, sight: Sight, rng: np.random.Generator, where: Bool[ndarray, "x y z"] | None = None
) -> Newcomers:
    """Particles that fill the domain evenly, but for those that no camera would show.

    Args:
        sizes: spectrum of the particles.
        domain: the simulated air.
        sight: the distances of its cells.
        rng: source of the draws.
        where: cells to fill; None: all.
    """
    if not sight.needed_distances.size:
        return _within(sizes, domain.lower, domain.upper, 0.0, rng)
    distances = sight.needed_distances if where is None else np.where(where, sight.needed_distances, np.inf)
    parts = []
    for distance in np.unique(distances[np.isfinite(distances)]):
        cells = np.argwhere(distances == distance)
        count = _whole(sizes.in_air(float(distance))[-1] * len(cells) * sight.cell.prod(), rng)
        chosen = cells[rng.integers(len(cells), size=count)]
        positions = sight.lower + (chosen + rng.uniform(size=(count, 3))) * sight.cell
        parts.append(Newcomers(positions, *sizes.draw(count, float(distance), rng)))
    return Newcomers.join(parts)


def outside(sizes: Sizes, domain: Domain, sight: Sight, margins: Float[ndarray, "2 3"], rng: np.random.Generator) -> Newcomers:
    """Particles in the air around the domain, of which those enter that move in.

    Args:
        sizes: spectrum of the particles.
        domain: the simulated air.
        sight: the distances of its cells.
        margins: metres of air before the lower and behind the upper sides. Nothing comes from below.
        rng: source of the draws.
    """
    lower, upper = np.asarray(domain.lower), np.asarray(domain.upper)
    low, high = lower - margins[0] * [1, 1, 0], upper + margins[1]
    boxes = [  # they do not overlap; x with its corners in y, all below the air above
        ([low[0], low[1], lower[2]], [lower[0], high[1], upper[2]], np.s_[:1]),
        ([upper[0], low[1], lower[2]], [high[0], high[1], upper[2]], np.s_[-1:]),
        ([lower[0], low[1], lower[2]], [upper[0], lower[1], upper[2]], np.s_[:, :1]),
        ([lower[0], upper[1], lower[2]], [upper[0], high[1], upper[2]], np.s_[:, -1:]),
        ([low[0], low[1], upper[2]], [high[0], high[1], high[2]], np.s_[:, :, -1:]),
    ]
    parts = []
    for begin, end, layer in boxes:
        # No cell beyond the outermost layer is reached within a step, but from the air above cells a little lower may be.
        face = sight.needed_distances[layer]
        distance = float(face.min()) if face.size else 0.0
        if np.isfinite(distance):
            parts.append(_within(sizes, begin, end, distance, rng))
    return Newcomers.join(parts)


def _within(
    sizes: Sizes, lower: Sequence[float], upper: Sequence[float], distance: float, rng: np.random.Generator
) -> Newcomers:
    size = np.asarray(upper) - np.asarray(lower)
    count = _whole(sizes.in_air(distance)[-1] * max(float(size.prod()), 0.0), rng)
    positions = np.asarray(lower) + rng.uniform(size=(count, 3)) * size
    return Newcomers(positions, *sizes.draw(count, distance, rng))


def _whole(expected: float, rng: np.random.Generator) -> int:
    """A whole number whose mean is the expected one."""
    return int(expected + rng.uniform())


def _largest(number: Callable[[float], float], limit: float, most: float) -> float:
    """The greatest value up to `limit` for which a growing function is at most `most`."""
    low, high = 0.0, limit
    if number(high) > most:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if number(middle) < most else (low, middle)
    return high
