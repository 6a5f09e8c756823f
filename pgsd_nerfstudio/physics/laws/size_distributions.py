"""Size distributions of rain, fog, sand and dust: how many particles of each size are in a cubic metre of air.

Rain follows Marshall & Palmer, "The distribution of raindrops with size" (1948). Fog is log-normal with the extinction,
effective radius and variance of the models of Shettle & Fenn (1979, AFGL-TR-79-0214), which are gamma distributions of the
radius in µm: r^3 exp(-0.3 r) of 20 per cm^3 and r^6 exp(-3 r) of 200 per cm^3. Sand has the sand populations of desert soils of
Tegen et al. (2002), as given in ECHAM-HAM. Dust has the background modes of d'Almeida (1987), as given in the Community Land
Model. Lengths are in metres. A distribution is N(D) in 1/m^4: particles per m^3 of air and metre of diameter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.special import gammainc, ndtr, ndtri

from pgsd_nerfstudio.physics.laws.fall_speeds import QUARTZ_DENSITY, WATER_DENSITY, rain_fall_speed

Speed = Callable[[Float[ndarray, " n"]], Float[ndarray, " n"]]
"""Terminal speed in m/s of particles with diameters in metres."""


@runtime_checkable
class Distribution(Protocol):
    """Particles per m^3 of air over their diameter, between two diameters."""

    @property
    def smallest(self) -> float:
        """Metres."""
        ...

    @property
    def largest(self) -> float:
        """Metres."""
        ...

    def density(self, diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        """N(D) in 1/m^4; 0 outside of the two bounds.

        Args:
            diameter: m.
        """
        ...

    def moment(self, order: float) -> float:
        """Integral of D^order N(D), in m^(order - 3)."""
        ...

    def sample(self, count: int, rng: np.random.Generator) -> Float[ndarray, " n"]:
        """Random diameters of `count` particles in metres."""
        ...

    def scaled(self, factor: float) -> Distribution:
        """The same sizes with `factor` times as many particles."""
        ...


D = TypeVar("D", bound=Distribution)


@dataclass(frozen=True, kw_only=True)
class Exponential:
    """N(D) = intercept exp(-slope D) between two diameters."""

    intercept: float
    """1/m^4."""
    slope: float
    """1/m."""
    smallest: float = 0.0
    largest: float = math.inf

    def __post_init__(self) -> None:
        _check(self.smallest, self.largest)
        if not (self.intercept > 0 and self.slope > 0):
            raise ValueError(f"intercept and slope must be positive, got {self.intercept:g} /m^4 and {self.slope:g} /m")

    def density(self, diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        inside = (diameter >= self.smallest) & (diameter <= self.largest)
        return np.where(inside, self.intercept * np.exp(-self.slope * diameter), 0.0)

    def moment(self, order: float) -> float:
        low, high = (float(gammainc(order + 1, self.slope * end)) for end in (self.smallest, self.largest))
        return self.intercept * math.gamma(order + 1) / self.slope ** (order + 1) * (high - low)

    def sample(self, count: int, rng: np.random.Generator) -> Float[ndarray, " n"]:
        # Inverse of the distribution function, measured from the smallest diameter so that large slopes lose no digits.
        share = rng.uniform(size=count) * -math.expm1(-self.slope * (self.largest - self.smallest))
        return self.smallest - np.log1p(-share) / self.slope

    def scaled(self, factor: float) -> Exponential:
        return replace(self, intercept=self.intercept * factor)


@dataclass(frozen=True, kw_only=True)
class LogNormal:
    """Diameters whose logarithm is normally distributed, between two diameters."""

    number: float
    """Particles per m^3 if there were no bounds on the diameter."""
    median: float
    """Median of the unbounded distribution, in metres."""
    spread: float
    """Geometric standard deviation, above 1."""
    smallest: float = 0.0
    largest: float = math.inf

    def __post_init__(self) -> None:
        _check(self.smallest, self.largest)
        if not (self.number > 0 and self.median > 0 and self.spread > 1):
            given = f"{self.number:g} /m^3, {self.median:g} m and {self.spread:g}"
            raise ValueError(f"number and median must be positive and the geometric spread above 1, got {given}")

    @staticmethod
    def of_mass(mass: float, median: float, spread: float, material: float, **ends: float) -> LogNormal:
        """The distribution with a given median of the mass, which sieves and dust models state (Hatch & Choate 1929).

        Args:
            mass: kg per m^3 of air if there were no bounds on the diameter.
            median: diameter in metres below which half of the mass is.
            spread: geometric standard deviation, above 1.
            material: density of a particle, kg/m^3.
            ends: `smallest` and `largest` diameter in metres.
        """
        by_number = median * math.exp(-3 * math.log(spread) ** 2)
        each = LogNormal(number=1.0, median=by_number, spread=spread).moment(3) * math.pi / 6 * material
        return LogNormal(number=mass / each, median=by_number, spread=spread, **ends)

    @staticmethod
    def of_effective(extinction: float, diameter: float, variance: float, **ends: float) -> LogNormal:
        """The distribution with a given effective diameter and variance, on which scattering depends (Hansen & Travis 1974).

        Args:
            extinction: of visible light, per metre, if there were no bounds on the diameter.
            diameter: effective diameter (third over second moment) in metres.
            variance: effective variance, relative to the square of the diameter.
            ends: `smallest` and `largest` diameter in metres.
        """
        median, spread = diameter * (1 + variance) ** -2.5, math.exp(math.sqrt(math.log1p(variance)))
        each = LogNormal(number=1.0, median=median, spread=spread).moment(2) * math.pi / 2
        return LogNormal(number=extinction / each, median=median, spread=spread, **ends)

    def density(self, diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
        inside = (diameter >= self.smallest) & (diameter <= self.largest) & (diameter > 0)
        safe = np.where(inside, diameter, self.median)
        peak = self.number / (math.sqrt(2 * math.pi) * math.log(self.spread) * safe)
        return np.where(inside, peak * np.exp(-0.5 * (np.log(safe / self.median) / math.log(self.spread)) ** 2), 0.0)

    def moment(self, order: float) -> float:
        width = math.log(self.spread)
        low, high = (float(ndtr(self._standard(end) - order * width)) for end in (self.smallest, self.largest))
        return self.number * self.median**order * math.exp(0.5 * (order * width) ** 2) * (high - low)

    def sample(self, count: int, rng: np.random.Generator) -> Float[ndarray, " n"]:
        low, high = (float(ndtr(self._standard(end))) for end in (self.smallest, self.largest))
        drawn = self.median * self.spread ** ndtri(low + (high - low) * rng.uniform(size=count))
        return drawn.clip(self.smallest, self.largest)  # against round-off

    def scaled(self, factor: float) -> LogNormal:
        return replace(self, number=self.number * factor)

    def _standard(self, diameter: float) -> float:
        """Deviation from the median in standard deviations of the logarithm."""
        if diameter <= 0 or math.isinf(diameter):
            return -math.inf if diameter <= 0 else math.inf
        return math.log(diameter / self.median) / math.log(self.spread)


def marshall_palmer(rain_rate: float, *, smallest: float = 1e-4, largest: float = 6e-3) -> Exponential:
    """Raindrops of Marshall & Palmer (1948): N0 = 8000 per m^3 and mm, Lambda = 4.1 R^-0.21 per mm.

    With the terminal speeds of Beard (1976) these drops bring a sixth more water than `rain_rate` at 1-10 mm/h, and a twentieth
    less at 200 mm/h. `with_rain_rate` makes the rate exact.

    Args:
        rain_rate: mm/h.
        smallest: smallest diameter in metres.
        largest: largest diameter in metres.

    Raises:
        ValueError: the rate is outside 0.1-200 mm/h.
    """
    if not 0.1 <= rain_rate <= 200.0:
        raise ValueError(f"the rain rate must lie in 0.1-200 mm/h, got {rain_rate:g}; heavy rain brings 10-50")
    return Exponential(intercept=8e6, slope=4100.0 * rain_rate**-0.21, smallest=smallest, largest=largest)


def rain_rate(drops: Distribution, speed: Speed = rain_fall_speed) -> float:
    """Water that falls through a horizontal plane, in mm/h.

    Args:
        drops: sizes of the drops.
        speed: law of their terminal speeds.
    """
    diameter = np.geomspace(max(drops.smallest, 1e-6), min(drops.largest, 7e-3), 4096)
    flux = np.pi / 6 * diameter**3 * drops.density(diameter) * speed(diameter)  # m^3 of water per m^2, s and m of diameter
    return 3.6e6 * float(0.5 * (flux[1:] + flux[:-1]) @ np.diff(diameter))


def with_rain_rate(drops: D, wanted: float, speed: Speed = rain_fall_speed) -> D:
    """The same sizes, with as many drops as bring the wanted rain rate.

    Args:
        drops: sizes of the drops.
        wanted: mm/h.
        speed: law of their terminal speeds.
    """
    return drops.scaled(wanted / rain_rate(drops, speed))  # type: ignore[return-value]


def mass(particles: Distribution, material: float = WATER_DENSITY) -> float:
    """Mass of spherical particles, kg per m^3 of air.

    Args:
        particles: sizes of the particles.
        material: density of a particle, kg/m^3.
    """
    return math.pi / 6 * material * particles.moment(3)


def extinction(particles: Distribution) -> float:
    """Extinction of visible light per metre by particles much larger than the wavelength: twice the geometric cross-section."""
    return 2 * math.pi / 4 * particles.moment(2)


def visibility(particles: Distribution, contrast: float = 0.05) -> float:
    """Distance in metres at which the contrast of a black object falls to `contrast`: 0.05 for the meteorological optical range
    of weather services (WMO No. 8), 0.02 as in Koschmieder (1924)."""
    return -math.log(contrast) / extinction(particles)


def advection_fog() -> LogNormal:
    """Dense fog from the sea: effective diameter 40 µm, visibility 140 m at 2 % contrast (model 1 of Shettle & Fenn 1979)."""
    return LogNormal.of_effective(27.9e-3, 40e-6, 1 / 6, smallest=1e-6, largest=200e-6)


def radiation_fog() -> LogNormal:
    """Fog of a clear night over land: effective diameter 6 µm, visibility 500 m at 2 % contrast (model 4 of Shettle & Fenn
    1979)."""
    return LogNormal.of_effective(7.82e-3, 6e-6, 1 / 9, smallest=1e-6, largest=200e-6)


def blown_sand(mass: float) -> LogNormal:
    """Medium and fine sand: median of the mass 158 µm, spread 2.0 (Tegen et al. 2002).

    Args:
        mass: kg per m^3 of air.
    """
    return LogNormal.of_mass(mass, 158e-6, 2.0, QUARTZ_DENSITY, smallest=20e-6, largest=2e-3)


def coarse_sand(mass: float) -> LogNormal:
    """Coarse sand: median of the mass 707 µm, spread 2.0 (Tegen et al. 2002).

    Args:
        mass: kg per m^3 of air.
    """
    return LogNormal.of_mass(mass, 707e-6, 2.0, QUARTZ_DENSITY, smallest=20e-6, largest=5e-3)


def desert_dust(mass: float) -> tuple[LogNormal, LogNormal, LogNormal]:
    """Three modes of dust, which stays in the air when the sand has settled (d'Almeida 1987, background).

    Args:
        mass: kg per m^3 of air, of all modes together.
    """
    first, second, third = (
        LogNormal.of_mass(share * mass, median, spread, QUARTZ_DENSITY)
        for share, median, spread in ((0.036, 0.832e-6, 2.1), (0.957, 4.82e-6, 1.9), (0.007, 19.38e-6, 1.6))
    )
    return first, second, third


def _check(smallest: float, largest: float) -> None:
    if not 0 <= smallest < largest:
        raise ValueError(f"diameters must satisfy 0 <= smallest < largest, got {smallest:g} and {largest:g} m")
