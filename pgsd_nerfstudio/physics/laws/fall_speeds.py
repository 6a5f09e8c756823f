"""Terminal speeds of rain, fog droplets, sand grains and snowflakes in still air of 20 °C and 1013 hPa.

Rain follows Beard, "Terminal velocity and shape of cloud and precipitation drops aloft" (1976): Stokes with slip below 19 µm,
then a fit of the Reynolds number over the Davies number, and above 1.07 mm a fit over the Bond number, which accounts for the
flattening of drops. The law joins Stokes and stays within 2.2 % of the measurements of Gunn & Kinzer (1949) from 0.3 mm on. In
the shorter formula of Atlas, Srivastava & Sekhon (1973), 9.65 - 10.3 exp(-0.6 D), drops below 0.11 mm would rise. Fog follows
the same law, which is Stokes with Cunningham's correction for slip at its sizes. Sand follows Ferguson & Church, "A simple
universal equation for grain settling velocity" (2004), with the constants of natural grains. Snow follows the power law of
`effects.snowfall`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects import snowfall

STANDARD_GRAVITY = 9.80665  # m/s^2
AIR_DENSITY = 1.204  # kg/m^3
AIR_VISCOSITY = 1.818e-5  # Pa s
MEAN_FREE_PATH = 6.62e-8  # m, of air molecules
WATER_DENSITY = 998.2  # kg/m^3
SURFACE_TENSION = 0.07275  # N/m, of water against air
QUARTZ_DENSITY = 2650.0  # kg/m^3

STOKES_UP_TO, SPHERE_UP_TO = 19e-6, 1.07e-3  # m, where Beard's regimes meet
# Beard 1976, table 1: ln Re over ln of the Davies number, and ln(Re / P^(1/6)) over ln(Bo P^(1/6)), constant term first.
_SPHERE = (-3.18657, 0.992696, -1.53193e-3, -9.87059e-4, -5.78878e-4, 8.55176e-5, -3.27815e-6)
_FLATTENED = (-5.00015, 5.23778, -2.04914, 0.475294, -5.42819e-2, 2.38449e-3)


def rain_fall_speed(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Terminal speed in m/s of raindrops (Beard 1976).

    Args:
        diameter: of the sphere of equal volume, in metres.

    Raises:
        ValueError: a diameter is outside 1 µm-7 mm; larger drops break up.
    """
    diameter = _within(diameter, "raindrop", 1e-6, 7e-3)
    excess = WATER_DENSITY - AIR_DENSITY
    # Each regime is evaluated only where it holds, since its polynomial overflows far outside.
    sphere = diameter.clip(STOKES_UP_TO, SPHERE_UP_TO)
    davies = 4 * AIR_DENSITY * excess * STANDARD_GRAVITY * sphere**3 / (3 * AIR_VISCOSITY**2)
    reynolds = slip(sphere) * np.exp(np.polyval(_SPHERE[::-1], np.log(davies)))
    round_speed = AIR_VISCOSITY * reynolds / (AIR_DENSITY * sphere)
    flat = diameter.clip(SPHERE_UP_TO)
    root = (SURFACE_TENSION**3 * AIR_DENSITY**2 / (AIR_VISCOSITY**4 * excess * STANDARD_GRAVITY)) ** (1 / 6)
    bond = 4 * excess * STANDARD_GRAVITY * flat**2 / (3 * SURFACE_TENSION)
    reynolds = root * np.exp(np.polyval(_FLATTENED[::-1], np.log(bond * root)))
    flat_speed = AIR_VISCOSITY * reynolds / (AIR_DENSITY * flat)
    return np.where(diameter < STOKES_UP_TO, _stokes(diameter), np.where(diameter < SPHERE_UP_TO, round_speed, flat_speed))


def fog_fall_speed(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Terminal speed in m/s of fog droplets (Beard 1976): 1.2 cm/s at 20 µm.

    It is Stokes' speed for small droplets, 3 % less at 50 µm and 17 % less at 100 µm, where drag exceeds that of Stokes.

    Args:
        diameter: metres.

    Raises:
        ValueError: a diameter is outside 1-200 µm; larger droplets are drizzle, see `rain_fall_speed`.
    """
    return rain_fall_speed(_within(diameter, "fog droplet", 1e-6, 200e-6))


def sand_fall_speed(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Terminal speed in m/s of natural grains of quartz (Ferguson & Church 2004): 1.4 m/s at 0.2 mm.

    Args:
        diameter: of the sieve, in metres.

    Raises:
        ValueError: a diameter is outside 10 µm-5 mm.
    """
    diameter = _within(diameter, "sand grain", 10e-6, 5e-3)
    excess = (QUARTZ_DENSITY / AIR_DENSITY - 1) * STANDARD_GRAVITY
    stokes, drag = 18.0, 1.0  # C1 and C2 of natural grains by sieve diameter; smooth spheres have 18 and 0.4
    viscous = stokes * AIR_VISCOSITY / AIR_DENSITY
    return excess * diameter**2 / (viscous + np.sqrt(0.75 * drag * excess * diameter**3))


def snow_fall_speed(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Terminal speed in m/s of aggregates of dendrites.

    Args:
        diameter: of the flake, not melted, in metres.

    Raises:
        ValueError: a diameter is outside 1-12 mm.
    """
    return snowfall.fall_speed(_within(diameter, "snowflake", 1e-3, 12e-3))


def slip(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Cunningham's factor by which small spheres fall faster, since air is not a continuum at their size.

    Args:
        diameter: metres.
    """
    return 1 + 2.51 * MEAN_FREE_PATH / diameter


def _stokes(diameter: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    return (WATER_DENSITY - AIR_DENSITY) * STANDARD_GRAVITY * diameter**2 / (18 * AIR_VISCOSITY) * slip(diameter)


def _within(diameter: Float[ndarray, " n"], what: str, low: float, high: float) -> Float[ndarray, " n"]:
    """The diameters as float64; diameters outside the range of the law, NaN included, are refused."""
    diameter = np.asarray(diameter, np.float64)
    wrong = ~((diameter >= low * (1 - 1e-6)) & (diameter <= high * (1 + 1e-6)))  # float32 may have rounded the bounds
    if wrong.any():
        found = 1e3 * float(diameter[wrong].flat[0])
        raise ValueError(f"{what} diameters must lie in {1e3 * low:g}-{1e3 * high:g} mm, found {found:g} mm")
    return diameter
