"""What matter is made of: water, elastic bodies, snow and sand, as plain numbers.

`row` turns a material into the numbers that the kernels of `constitutive` read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

WATER, ELASTIC, SNOW, SAND = 0, 1, 2, 3

# Columns of the table of materials.
KIND, DENSITY, MU, LAMBDA = 0, 1, 2, 3
HARDENING, COMPRESSION, STRETCH, LOW, HIGH = 4, 5, 6, 7, 8
FRICTION = 9
COLUMNS = 10


def _positive(owner: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{owner}: {name.replace('_', ' ')} must be positive and finite, got {value:g}")


def _bounds(owner: str, name: str, bounds: tuple[float, float], inner: float) -> None:
    low, high = bounds
    if not 0 < low <= inner <= high < math.inf:
        raise ValueError(f"{owner}: {name} must satisfy 0 < low <= {inner:g} <= high, got {low:g} and {high:g}")


def lame(owner: str, young: float, poisson: float) -> tuple[float, float]:
    """Shear modulus and first Lamé constant in Pa from Young's modulus in Pa and Poisson's ratio.

    Raises:
        ValueError: the modulus is not positive, or the ratio lies outside 0-0.49.
    """
    _positive(owner, youngs_modulus=young)
    if not 0.0 <= poisson <= 0.49:
        raise ValueError(
            f"{owner}: Poisson's ratio must lie in 0-0.49, got {poisson:g}; at 0.5 matter is incompressible and its speed of "
            "sound infinite"
        )
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


@dataclass(frozen=True, kw_only=True)
class Water:
    """Weakly compressible water without viscosity: p = K / 7 (J^-7 - 1), never a tension (Monaghan 1994, Tait's equation)."""

    name: ClassVar[str] = "water"
    density: float = 1000.0
    """Density in kg/m^3."""
    bulk_modulus: float = 4e5
    """Stiffness in Pa. Real water has 2.2e9; 4e5 means a speed of sound of 20 m/s, which keeps the density within 1 % for flows
    up to 2 m/s (Mach number 0.1)."""
    volume_range: tuple[float, float] = (0.8, 1.02)
    """Bounds of the volume relative to that at rest: below, pressure no longer grows; above 1 there is none."""

    def __post_init__(self) -> None:
        _positive(self.name, density=self.density, bulk_modulus=self.bulk_modulus)
        _bounds(self.name, "volume range", self.volume_range, 1.0)

    def row(self) -> list[float]:
        return _row(WATER, self.density, 0.0, self.bulk_modulus, low=self.volume_range[0], high=self.volume_range[1])


@dataclass(frozen=True, kw_only=True)
class Elastic:
    """Fixed-corotated elasticity (Stomakhin et al. 2012, "Energetically consistent invertible elasticity")."""

    name: ClassVar[str] = "elastic"
    density: float = 1000.0
    """Density in kg/m^3."""
    youngs_modulus: float = 1e5
    """Young's modulus in Pa (soft rubber: 1e6)."""
    poisson: float = 0.3
    """Poisson's ratio, 0-0.49."""

    def __post_init__(self) -> None:
        _positive(self.name, density=self.density)
        lame(self.name, self.youngs_modulus, self.poisson)

    def row(self) -> list[float]:
        return _row(ELASTIC, self.density, *lame(self.name, self.youngs_modulus, self.poisson))


@dataclass(frozen=True, kw_only=True)
class Snow:
    """Snow that breaks and hardens (Stomakhin et al. 2013, "A material point method for snow simulation", table 2)."""

    name: ClassVar[str] = "snow"
    density: float = 400.0
    """Density in kg/m^3 (fresh 100, wind-packed 400)."""
    youngs_modulus: float = 1.4e5
    """Young's modulus before hardening, in Pa."""
    poisson: float = 0.2
    """Poisson's ratio, 0-0.49."""
    critical_compression: float = 2.5e-2
    """Elastic compression of a principal direction beyond which snow yields."""
    critical_stretch: float = 7.5e-3
    """Elastic stretch of a principal direction beyond which snow breaks."""
    hardening: float = 10.0
    """xi in exp(xi (1 - Jp)), the factor on the modulus where the plastic volume ratio is Jp."""
    plastic_range: tuple[float, float] = (0.6, 1.5)
    """Bounds of Jp, and with them of the factor: 55 and 0.0067. Without them it reaches 1e4 and a time step of nothing."""

    def __post_init__(self) -> None:
        _positive(self.name, density=self.density)
        lame(self.name, self.youngs_modulus, self.poisson)
        if not (0 < self.critical_compression < 1 and 0 < self.critical_stretch < 1):
            raise ValueError(
                f"snow: critical compression and stretch must lie in 0-1, got {self.critical_compression:g} and "
                f"{self.critical_stretch:g}"
            )
        if not 0 <= self.hardening <= 100:
            raise ValueError(f"snow: hardening must lie in 0-100, got {self.hardening:g}")
        _bounds(self.name, "plastic range", self.plastic_range, 1.0)

    def row(self) -> list[float]:
        return _row(
            SNOW,
            self.density,
            *lame(self.name, self.youngs_modulus, self.poisson),
            hardening=self.hardening,
            compression=1 - self.critical_compression,
            stretch=1 + self.critical_stretch,
            low=self.plastic_range[0],
            high=self.plastic_range[1],
        )


@dataclass(frozen=True, kw_only=True)
class Sand:
    """Dry sand: Drucker-Prager on Hencky strain (Klar et al. 2016), with the volume correction of Tampubolon et al. (2017)."""

    name: ClassVar[str] = "sand"
    density: float = 1600.0
    """Bulk density in kg/m^3."""
    youngs_modulus: float = 3.537e5
    """Young's modulus in Pa (Klar et al. 2016, table 2)."""
    poisson: float = 0.3
    """Poisson's ratio, 0-0.49."""
    friction_degrees: float = 30.0
    """Angle of repose: shear along a plane slips where its stress exceeds the pressure times the tangent of this angle. (Klar
    et al. lay the cone through triaxial compression instead, which gives a heap a slope of 35 degrees for an angle of 30.)"""
    largest_gain: float = 0.1
    """Bound of the volume (its logarithm) that sand gained when it was pulled apart and gives back before it resists again."""

    def __post_init__(self) -> None:
        _positive(self.name, density=self.density)
        lame(self.name, self.youngs_modulus, self.poisson)
        if not 0 <= self.largest_gain < math.inf:
            raise ValueError(f"sand: the largest gain of volume must not be negative, got {self.largest_gain:g}")
        if not 0 <= self.friction_degrees < 90:
            raise ValueError(f"sand: the friction angle must lie in 0-90 degrees, got {self.friction_degrees:g}")

    def row(self) -> list[float]:
        # In plane shear without change of volume |dev tau| = sqrt(2) shear and tr tau = -3 pressure.
        friction = math.sqrt(2) / 3 * math.tan(math.radians(self.friction_degrees))
        return _row(
            SAND, self.density, *lame(self.name, self.youngs_modulus, self.poisson), high=self.largest_gain, friction=friction
        )


Matter = Water | Elastic | Snow | Sand


def kind_of(material: Matter) -> int:
    """WATER, ELASTIC, SNOW or SAND."""
    return int(material.row()[KIND])


def _row(
    kind: int,
    density: float,
    mu: float,
    lam: float,
    *,
    hardening: float = 0.0,
    compression: float = 0.0,
    stretch: float = 0.0,
    low: float = 1.0,
    high: float = 1.0,
    friction: float = 0.0,
) -> list[float]:
    return [float(kind), density, mu, lam, hardening, compression, stretch, low, high, friction]
