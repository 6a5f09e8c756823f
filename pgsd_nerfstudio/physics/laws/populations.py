"""Laws of the particles of an effect: the terminal speed of each size and the number of each size in a cubic metre of air."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects import snowfall
from pgsd_nerfstudio.effects.matter import CONTRASTS, Emission, Material
from pgsd_nerfstudio.physics.laws import fall_speeds, size_distributions

MM_PER_HOUR = 1.0 / 3600.0  # of water, in kg/(m^2 s)

_LAWS = {
    "rain": fall_speeds.rain_fall_speed,
    "fog": fall_speeds.fog_fall_speed,
    "sand": fall_speeds.sand_fall_speed,
}


def fall_speed(diameter: Float[ndarray, " n"], material: Material) -> Float[ndarray, " n"]:
    """Terminal speed in m/s of particles.

    Args:
        diameter: metres.
        material: chooses the law and the factor on it.

    Raises:
        ValueError: a diameter is outside the range for which the law was made.
    """
    if material.speed_law == "power":
        return material.speed_factor * snowfall.fall_speed(diameter, material)
    return material.speed_factor * _LAWS[material.speed_law](diameter)


def number_density(diameter: Float[ndarray, " d"], emission: Emission, material: Material) -> Float[ndarray, " d"]:
    """Particles per m^3 of air and metre of diameter.

    The density is scaled so that the sizes from the first to the last diameter carry all of the emission's water, or `share` of
    its extinction.

    Args:
        diameter: metres, ascending.
        emission: kind of particles and their intensity.
        material: chooses terminal speed and mass.
    """
    if emission.kind == "snowflakes":
        melted = snowfall.melted_diameter(material.mass(diameter))
        # From per metre of melted diameter to per metre of diameter.
        shape = snowfall.number_density(melted, emission.intensity) * np.gradient(melted, diameter)
    elif emission.kind == "raindrops":
        shape = size_distributions.marshall_palmer(emission.intensity).density(diameter)
    elif emission.kind == "fog droplets":
        shape = size_distributions.advection_fog().density(diameter)
    else:
        shape = size_distributions.blown_sand(1e-3).density(diameter)
    if emission.precipitates:
        carried = integral(shape * fall_speed(diameter, material) * material.mass(diameter), diameter)
        return shape * emission.intensity * MM_PER_HOUR / carried
    return shape * emission.share * extinction(emission) / integral(shape * cross_section(diameter), diameter)


def extinction(emission: Emission) -> float:
    """Extinction per metre of fog and sand; 0 for rain and snow.

    Contrast falls as exp(-extinction * distance) (Koschmieder 1924), to `CONTRASTS` at the visibility V: ln 20 / V for the
    meteorological optical range, ln 50 / V for Koschmieder's own.
    """
    return 0.0 if emission.precipitates else -math.log(CONTRASTS[emission.visibility]) / emission.intensity


def cross_section(diameter: Float[ndarray, " d"]) -> Float[ndarray, " d"]:
    """Extinction cross-section in m^2 of particles much larger than the wavelength: twice their geometric cross-section.

    Args:
        diameter: metres.
    """
    return 0.5 * np.pi * diameter**2


def integral(density: Float[ndarray, " d"], at: Float[ndarray, " d"]) -> float:
    """Trapezoidal integral.

    Args:
        density: values.
        at: ascending abscissas of the values.
    """
    return float(cumulative(density, at)[-1])


def cumulative(density: Float[ndarray, " d"], at: Float[ndarray, " d"]) -> Float[ndarray, " d"]:
    """Trapezoidal integral up to each abscissa.

    Args:
        density: values.
        at: ascending abscissas of the values.
    """
    return np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(at))])
