"""Rainfall: drops of 1 to 5 mm that streak, splash and wet surfaces.

Sizes: Marshall & Palmer, "The distribution of raindrops with size" (1948). Fall speeds: Beard (1976), in
physics.laws.fall_speeds.
"""

from __future__ import annotations

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Appearance, Effect, StateLook, Wind, register
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Emission, Material
from pgsd_nerfstudio.effects.surface_response import Splash, SurfaceResponse

WATER = Material(mass_milligram=0.5236, mass_exponent=3.0, speed_law="rain")  # pi / 6 mg: a sphere of 1 g/cm^3

RAINFALL = register(
    Effect(
        name="rainfall",
        emission=Emission(kind="raindrops", intensity=20.0, smallest=0.0010, largest=0.005, importance=1.5),
        material=WATER,
        wind=Wind(speed=2.0, turbulence=0.25, flutter=0.0),
        surface=SurfaceResponse(landing="wets", splash=Splash(), accumulates=False, darkens=0.012),
        appearance=Appearance(
            # pi / 4 D^2 = 2 pi (0.36 D)^2 0.97: a drop covers what a disc of its diameter does.
            active=StateLook(
                scale_per_diameter=(0.36, 0.36, 0.36),
                scale_spread=0.0,
                opacity=0.97,
                opacity_spread=0.0,
                rgb=(0.92, 0.94, 0.97),
                tone_spread=0.1,
            ),
            legibility=8.0,
            exposure=1 / 50,
        ),
        haze=Haze(rgb=(0.62, 0.66, 0.70)),
        adaptation=Adaptation(air=7.5),
        ambience=Ambience(clouds=0.95, stops=-0.3, tint=(0.94, 1.0, 1.07), saturation=0.8, sky=(0.66, 0.70, 0.74)),
        prompt="Heavy rain is falling in {scene}, raindrops streak through the air and splash, surfaces are wet and dark. "
        "Photorealistic, high detail",
        negative_prompt="static, no rain, dry, sunny, blurry, distorted, cartoon, low quality",
    )
)
