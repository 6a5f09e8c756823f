"""Snowfall: aggregates of dendrites, which fall near 0 °C.

Sizes: Gunn & Marshall, "The distribution with size of aggregate snowflakes" (1958): N(D) = N0 exp(-Lambda D) over the melted
diameter D, N0 = 3.8e3 R^-0.87 per m^3 and mm, Lambda = 2.55 R^-0.48 per mm, R in mm/h of water.
Mass and fall speed: Locatelli & Hobbs, "Fall speeds and masses of solid precipitation particles" (1974), table 1, aggregates
of unrimed radiating assemblages of dendrites: m = 0.073 D^1.4 mg, v = 0.8 D^0.16 m/s, D in mm (the flake, not melted).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Appearance, Effect, StateLook, Wind, register
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Dense, Emission, Material
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse

AGGREGATES = Material(mass_milligram=0.073, mass_exponent=1.4, speed_at_1mm=0.8, speed_exponent=0.16)

SNOWFALL = register(
    Effect(
        name="snowfall",
        emission=Emission(intensity=1.5, smallest=0.0015, largest=0.012),
        material=AGGREGATES,
        wind=Wind(),
        surface=SurfaceResponse(hides=0.008),
        dense=Dense(matter="snow"),
        appearance=Appearance(
            active=StateLook(scale_per_diameter=(0.34, 0.28, 0.16), scale_spread=0.0, opacity=0.63, opacity_spread=0.25),
            collided=StateLook(
                scale_spread=0.35,
                opacity=0.75,
                opacity_spread=0.15,
                rgb=(0.94, 0.95, 0.965),
                tone_spread=0.05,
                settle_seconds=1.5,
            ),
        ),
        haze=Haze(rgb=(0.885, 0.895, 0.91)),
        adaptation=Adaptation(air=7.5),
        ambience=Ambience(clouds=1.0, stops=-0.1, tint=(0.97, 1.0, 1.04), saturation=0.8, sky=(0.95, 0.96, 0.975)),
        prompt="Fluffy snowflakes are falling in {scene}, accumulating on surfaces. Photorealistic, high detail",
        negative_prompt="static, no snow, blurry, distorted, cartoon, low quality, grey, dirty, dark, ugly",
    )
)


def fall_speed(diameter: Float[ndarray, " n"], material: Material = AGGREGATES) -> Float[ndarray, " n"]:
    """Terminal speed in m/s by the power law of a material.

    Args:
        diameter: in metres.
        material: its `speed_law` is "power"; by default that of Locatelli & Hobbs (1974).
    """
    return material.speed_at_1mm * (1e3 * diameter) ** material.speed_exponent


def mass(diameter: Float[ndarray, " n"], material: Material = AGGREGATES) -> Float[ndarray, " n"]:
    """Mass in kg by the power law of a material.

    Args:
        diameter: in metres.
        material: by default that of Locatelli & Hobbs (1974).
    """
    return material.mass(diameter)


def number_density(melted: Float[ndarray, " n"], intensity: float) -> Float[ndarray, " n"]:
    """Flakes per m^3 of air and metre of melted diameter (Gunn & Marshall 1958).

    Args:
        melted: diameters of the melted flakes in metres.
        intensity: precipitation in mm/h of water.
    """
    slope = 2.55 * intensity**-0.48  # 1/mm
    return 1e3 * 3.8e3 * intensity**-0.87 * np.exp(-slope * 1e3 * melted)


def melted_diameter(mass_kg: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Diameter in metres of a water drop with the mass `mass_kg`."""
    return (6.0 * mass_kg / (math.pi * 1000.0)) ** (1 / 3)
