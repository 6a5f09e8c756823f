"""Particles of a weather: their number and sizes, their mass and fall speed, and the material of a thick cover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from numpy import ndarray

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", ndarray, "Tensor")

Kind = Literal["snowflakes", "raindrops", "fog droplets", "sand grains"]

Visibility = Literal["optical-range", "koschmieder"]

CONTRASTS: dict[Visibility, float] = {"optical-range": 0.05, "koschmieder": 0.02}
"""Share of a black object's contrast that is left at the visibility: 5 % for the meteorological optical range of weather
services (WMO, "Guide to Instruments and Methods of Observation", No. 8, volume I, chapter 9), 2 % in Koschmieder (1924)."""

_RANGES: dict[Kind, tuple[float, float, str, str]] = {
    "snowflakes": (0.01, 100.0, "mm/h of water", "heavy snow is about 3"),
    "raindrops": (0.1, 200.0, "mm/h of water", "heavy rain brings 10 to 50"),
    "fog droplets": (5.0, 10_000.0, "m of visibility", "dense fog has less than 200"),
    "sand grains": (5.0, 10_000.0, "m of visibility", "a sandstorm has less than 1000"),
}

INTENSITIES = {kind: (low, high) for kind, (low, high, _, _) in _RANGES.items()}
"""Least and greatest intensity of an Emission of each kind, in its unit."""


@dataclass(frozen=True, kw_only=True)
class Emission:
    """The number of particles in the air, and their sizes."""

    kind: Kind = "snowflakes"
    """Law of the sizes: Gunn & Marshall (1958) for snowflakes, Marshall & Palmer (1948) for raindrops, Shettle & Fenn's
    advection fog (1979), or the blown sand of Tegen et al. (2002)."""
    intensity: float
    """Snow and rain: precipitation in mm/h of liquid water. Fog and sand: visibility in metres."""
    visibility: Visibility = "optical-range"
    """What visibility means: the distance at which a black object has `CONTRASTS` of its contrast left."""
    smallest: float = 0.001
    """Smallest simulated diameter in metres; smaller particles carry little water and are not seen."""
    largest: float = 0.012
    """Largest diameter in metres, at which the fits of fall speed and mass end."""
    importance: float = 1.5
    """If not every real particle can be simulated, larger ones are preferred: chance ~ diameter ** importance."""
    most: int | None = None
    """Largest number of particles in the air at once; None: no such bound. If there were too many parcels of fog, each would be
    too faint to be drawn."""
    share: float = 1.0
    """Fog and sand: part of the extinction that the simulated sizes cause. The rest is dust that is too fine to be seen as
    grains."""

    def __post_init__(self) -> None:
        low, high, unit, hint = _RANGES[self.kind]
        if not low <= self.intensity <= high:
            raise ValueError(f"intensity must lie in {low:g}-{high:g} {unit}, got {self.intensity:g}; {hint}")
        if not 0.0 < self.smallest < self.largest:
            raise ValueError(f"diameters must satisfy 0 < smallest < largest, got {self.smallest:g} and {self.largest:g} m")
        if self.visibility not in CONTRASTS:
            raise ValueError(f"visibility must be {' or '.join(CONTRASTS)}, got {self.visibility!r}")
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"share must lie in 0-1, got {self.share:g}")

    @property
    def unit(self) -> str:
        """Unit of the intensity."""
        return _RANGES[self.kind][2]

    @property
    def precipitates(self) -> bool:
        """Whether the intensity is a rate of precipitation; otherwise it is a visibility."""
        return self.kind in ("snowflakes", "raindrops")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Mass of one particle, a power law of its diameter, and the law of its fall speed."""

    mass_milligram: float
    """Mass of a particle of 1 mm diameter, in milligrams."""
    mass_exponent: float
    """Exponent of the diameter in the mass."""
    speed_law: Literal["power", "rain", "fog", "sand"] = "power"
    """A power law of the diameter, or one of physics.laws.fall_speeds."""
    speed_at_1mm: float = 1.0
    """Power law: terminal speed of a particle of 1 mm diameter, in m/s."""
    speed_exponent: float = 0.0
    """Power law: exponent of the diameter in the speed."""
    speed_factor: float = 1.0
    """Factor on the law; below 1 particles fall more slowly than in nature."""

    def mass(self, diameter: Array) -> Array:  # [n]
        """Mass in kg of particles with `diameter` in metres, an array or a tensor."""
        kilograms: Any = 1e-6 * self.mass_milligram * (1e3 * diameter) ** self.mass_exponent
        return kilograms


@dataclass(frozen=True, kw_only=True)
class Dense:
    """Material of a cover so thick that it moves as a whole. Only such places are simulated by the material point method."""

    matter: Literal["snow", "sand"]
    cell: float = 0.10
    """Spacing of the grid in metres."""
    solid_fraction: float = 0.30
    """Share of a cell from which sliding particles are simulated together; below it each slides alone."""
    young: float = 2e4
    """Young's modulus in Pa: 1e4-1e5 for fresh snow (Mellor 1975), 1e5 and more for sand. Time steps shrink with its square
    root."""
    friction: float = 0.35
    """Coulomb's coefficient on the surfaces of the scene."""
    rests_below: float = 0.05
    """Speed in m/s below which supported matter comes to rest."""

    def __post_init__(self) -> None:
        for name in ("cell", "solid_fraction", "young", "rests_below"):
            if not getattr(self, name) > 0:
                raise ValueError(f"dense matter: {name} must be positive, got {getattr(self, name):g}")
        if not self.friction >= 0:
            raise ValueError(f"dense matter: friction must not be negative, got {self.friction:g}")
