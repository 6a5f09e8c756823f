"""What happens where a particle meets a surface: it stays, vanishes, wets, splashes or glides along."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Splash:
    """The crown of a drop that hits: a few droplets that live until they fall back.

    A part of the impact's kinetic energy leaves with them; how many there are follows from the energy too, so that drizzle does
    not splash and large drops do. (Ejected droplets of a tenth to a third of the drop: Yarin, "Drop impact dynamics", 2006.)
    """

    joule_per_droplet: float = 1.2e-5
    """Kinetic energy of an impact for which one droplet is made; a drop of 2 mm brings 9e-5 J."""
    most: int = 4
    """Droplets of one impact, at most."""
    diameter: float = 0.22
    """Diameter of a droplet, relative to that of the drop."""
    energy: float = 0.04
    """Share of the kinetic energy that they carry off together."""

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
    """What happens on contact."""

    landing: Literal["stays", "vanishes", "wets", "glides"] = "stays"
    """Particles stay and make a cover (snow, sand), are gone, leave their water (rain), or flow along the surface (fog)."""
    holds_degrees: float = 50.0
    """Up to this slope every particle stays."""
    slips_degrees: float = 80.0
    """From this slope none stays, it slides down; in between the chance falls linearly."""
    friction: float = 0.30
    """Coulomb's coefficient of what slides by itself."""
    settle: float = 0.006
    """Height at which a landed particle rests above the surface, so that it is not drawn into it."""
    probe: float = 0.12
    """Largest radius over which a landed particle may spread; less where the surface ends or bends before."""
    accumulates: bool = True
    """Whether the cover raises the surface for what lands later."""
    repose_degrees: float = 45.0
    """Angle of repose: the steepest slope of a cover thicker than `film`."""
    film: float = 0.005
    """Thickness in metres that clings to any slope on which it was put."""
    accumulation_speedup: float = 800.0
    """Time lapse of the cover: a landed particle stands for this many times the water that it and the real particles it
    represents bring. 10 s of moderate snow would leave 0.04 mm; with 800 they leave 3 cm, the cover of two hours."""
    layer_density: float = 100.0
    """Density of the fresh layer in kg/m^3; 100 makes 1 cm of snow from 1 mm of water."""
    layer_thickness: float = 0.010
    """Thickness in metres of what one particle leaves; its area follows from its volume, so that the cover does not depend on
    how many particles were affordable."""
    hides: float = 0.004
    """Thickness in metres of a layer that hides 63 % of what it lies on."""
    darkens: float = 0.03
    """Water in mm (kg/m^2) that makes 63 % of a dry surface look wet; pores take up about 0.1 mm until nothing changes any
    more."""
    splash: Splash | None = None
    """Droplets of an impact; None: none."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.holds_degrees <= self.slips_degrees <= 180.0:
            raise ValueError(
                f"slopes must satisfy 0 <= holds <= slips <= 180, got {self.holds_degrees:g} and {self.slips_degrees:g} degrees"
            )
        for name in ("accumulation_speedup", "layer_density", "layer_thickness", "hides", "darkens"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name):g}")
