"""The response of surfaces to contact: a particle stays, vanishes, wets the surface, splashes or glides along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Splash:
    """The crown of an impact: a few droplets that live until they fall back.

    The droplets carry off a part of the kinetic energy of the impact. Their number follows from the energy too, so that large
    drops splash and drizzle does not. Ejected droplets have a tenth to a third of the drop's diameter (Yarin, "Drop impact
    dynamics", 2006).
    """

    joule_per_droplet: float = 1.2e-5
    """Kinetic energy in J of an impact for which one droplet is made; a drop of 2 mm has 9e-5 J."""
    most: int = 4
    """Largest number of droplets of one impact."""
    diameter: float = 0.22
    """Diameter of a droplet relative to that of the drop."""
    energy: float = 0.04
    """Share of the kinetic energy that the droplets carry off together."""

    def __post_init__(self) -> None:
        if not (self.joule_per_droplet > 0 and self.most >= 0 and 0 < self.diameter < 1 and 0 <= self.energy <= 1):
            raise ValueError(
                f"a splash needs joule_per_droplet > 0, most >= 0, 0 < diameter < 1 and 0 <= energy <= 1, got "
                f"{self.joule_per_droplet:g}, {self.most}, {self.diameter:g} and {self.energy:g}"
            )
        if self.most * self.diameter**3 > 0.5:
            raise ValueError(
                f"{self.most} droplets of {self.diameter:g} diameters would carry off {self.most * self.diameter**3:.0%} of a "
                "drop; at most half of it can splash"
            )


@dataclass(frozen=True, kw_only=True)
class SurfaceResponse:
    """What happens when a particle meets a surface."""

    landing: Literal["stays", "vanishes", "wets", "glides"] = "stays"
    """stays: particles make a cover (snow, sand). vanishes: they are gone. wets: they leave their water (rain). glides: they
    flow along the surface (fog)."""
    holds_degrees: float = 50.0
    """Up to this slope every particle stays."""
    slips_degrees: float = 80.0
    """From this slope every particle slides down; between the two slopes the chance to stay falls linearly."""
    friction: float = 0.30
    """Coulomb's coefficient of a particle that slides by itself."""
    settle: float = 0.006
    """Height in metres of a collided particle above the surface, so that it is not drawn inside it."""
    probe: float = 0.12
    """Largest radius in metres over which a collided particle may spread; it is less if the surface ends or bends before."""
    accumulates: bool = True
    """Whether the cover raises the surface for particles that land later."""
    repose_degrees: float = 45.0
    """Angle of repose: the steepest slope of a cover thicker than `film`."""
    film: float = 0.005
    """Thickness in metres that stays on any slope, however steep."""
    accumulation_speedup: float = 800.0
    """Time lapse of the cover: a collided particle stands for this many times its own water and that of the real particles it
    represents. 10 s of moderate snow would leave 0.04 mm; with 800 they leave 3 cm, the cover of two hours. Where particles
    wet, it is the time lapse of the water that runs off and stands in puddles."""
    layer_density: float = 100.0
    """Density of fresh cover in kg/m^3; 100 makes 1 cm of snow from 1 mm of water."""
    layer_thickness: float = 0.010
    """Thickness in metres of the cover of one particle. Its area follows from its volume, so that the cover does not depend on
    the number of simulated particles."""
    hides: float = 0.004
    """Thickness in metres of a cover that hides 63 % of the surface below it."""
    darkens: float = 0.03
    """Water in mm (kg/m^2) that makes 63 % of a dry surface look wet. Pores take up about 0.1 mm, and more changes nothing."""
    puddles: bool = True
    """Whether water that wets runs off and stands where the ground is level or hollow."""
    unevenness: float = 0.005
    """Standard deviation in metres of the height of level ground below what its mesh resolves. Paving is laid to about a
    centimetre in four metres, and puddles form in what is left."""
    ripples: bool = True
    """Whether drops make rings on standing water."""
    mirror: bool = True
    """Whether wet and standing surfaces mirror the scene; False: the even sky alone."""
    drips: bool = True
    """Whether water gathers and drips from the edges of what stands above the ground, such as tables and benches."""
    splash: Splash | None = None
    """Droplets of an impact; None: there are none."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.holds_degrees <= self.slips_degrees <= 180.0:
            raise ValueError(
                f"slopes must satisfy 0 <= holds <= slips <= 180, got {self.holds_degrees:g} and {self.slips_degrees:g} degrees"
            )
        for name in ("accumulation_speedup", "layer_density", "layer_thickness", "hides", "darkens"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name):g}")
        if not self.unevenness >= 0:
            raise ValueError(f"unevenness must not be negative, got {self.unevenness:g} m")
