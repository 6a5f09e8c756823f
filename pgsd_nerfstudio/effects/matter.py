"""What is emitted and what it is made of: how much, which sizes, mass and fall speed, and what it is where it lies thick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from numpy import ndarray

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", ndarray, "Tensor")

Kind = Literal["snowflakes", "raindrops", "fog droplets", "sand grains"]

_RANGES: dict[Kind, tuple[float, float, str, str]] = {
    "snowflakes": (0.0, 100.0, "mm/h of water", "heavy snow is about 3"),
    "raindrops": (0.1, 200.0, "mm/h of water", "heavy rain brings 10 to 50"),
    "fog droplets": (5.0, 10_000.0, "m of visibility", "dense fog has less than 200"),
    "sand grains": (5.0, 10_000.0, "m of visibility", "a sandstorm has less than 1000"),
}

INTENSITIES = {kind: (low, high) for kind, (low, high, _, _) in _RANGES.items()}
"""Within these an Emission takes its intensity, in its unit."""


@dataclass(frozen=True, kw_only=True)
class Emission:
    """How much is in the air, and in which sizes."""

    kind: Kind = "snowflakes"
    """Which law the sizes follow: Gunn & Marshall (1958), Marshall & Palmer (1948), Shettle & Fenn's advection fog (1979), or
    the blown sand of Tegen et al. (2002)."""
    intensity: float
    """Snow and rain: precipitation in mm/h of liquid water. Fog and sand: visibility in metres, at which a black object fades
    to 2 % of its contrast."""
    smallest: float = 0.001
    """Smallest diameter that is simulated, in metres; what is smaller carries little water and is not seen."""
    largest: float = 0.012
    """Largest diameter, in metres; the fits of fall speed and mass end there."""
    importance: float = 1.5
    """Where not every real particle can be simulated, larger ones are preferred: chance ~ diameter ** importance."""
    most: int | None = None
    """Particles in the air at once, at most; None: no such bound. Too many parcels of fog would each be too faint to be
    drawn."""
    share: float = 1.0
    """Fog and sand: part of the extinction that the simulated sizes cause. The rest is dust too fine to be seen as grains."""

    def __post_init__(self) -> None:
        low, high, unit, hint = _RANGES[self.kind]
        above = self.intensity > low if low == 0 else self.intensity >= low
        if not (above and self.intensity <= high):
            raise ValueError(f"intensity must lie in {low:g}-{high:g} {unit}, got {self.intensity:g}; {hint}")
        if not 0.0 < self.smallest < self.largest:
            raise ValueError(f"diameters must satisfy 0 < smallest < largest, got {self.smallest:g} and {self.largest:g} m")
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"share must lie in 0-1, got {self.share:g}")

    @property
    def unit(self) -> str:
        """Unit of the intensity."""
        return _RANGES[self.kind][2]

    @property
    def precipitates(self) -> bool:
        """Whether the intensity is a rate of water; else it is a visibility."""
        return self.kind in ("snowflakes", "raindrops")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Mass of one particle, a power law of its diameter, and the law of its fall speed."""

    mass_milligram: float
    """Mass of a particle of 1 mm diameter, in milligrams."""
    mass_exponent: float
    speed_law: Literal["power", "rain", "fog", "sand"] = "power"
    """A power law of the diameter, or one of physics.fall_speeds."""
    speed_at_1mm: float = 1.0
    """Power law: terminal speed of a particle of 1 mm diameter, in m/s."""
    speed_exponent: float = 0.0
    speed_factor: float = 1.0
    """Times the law: below 1 for what should fall more slowly than nature has it."""

    def mass(self, diameter: Array) -> Array:  # [n]
        """kg of particles with `diameter` in metres; an array or a tensor."""
        kilograms: Any = 1e-6 * self.mass_milligram * (1e3 * diameter) ** self.mass_exponent
        return kilograms


@dataclass(frozen=True, kw_only=True)
class Dense:
    """Matter that lies so thick that it moves as a whole: simulated by the material point method there, and only there."""

    matter: Literal["snow", "sand"]
    cell: float = 0.10
    """Spacing of the grid in metres."""
    solid_fraction: float = 0.30
    """Share of a cell that sliding particles must fill together before they are handed over; below it each slides alone."""
    young: float = 2e4
    """Young's modulus in Pa: 1e4-1e5 for fresh snow (Mellor 1975), 1e5 and more for sand. Time steps shrink with its root."""
    friction: float = 0.35
    """Coulomb's coefficient on the scene's surfaces."""
    rests_below: float = 0.05
    """Speed in m/s below which what lies on something comes to rest."""

    def __post_init__(self) -> None:
        for name in ("cell", "solid_fraction", "young", "rests_below"):
            if not getattr(self, name) > 0:
                raise ValueError(f"dense matter: {name} must be positive, got {getattr(self, name):g}")
        if not self.friction >= 0:
            raise ValueError(f"dense matter: friction must not be negative, got {self.friction:g}")
