"""Rainfall: drops of 0.5 to 5 mm that streak, splash and wet what they hit.

Sizes: Marshall & Palmer, "The distribution of raindrops with size" (1948). Fall speeds: Beard (1976), see physics.fall_speeds.
"""

from __future__ import annotations

from pgsd_nerfstudio.weather.effect import Appearance, Effect, StateLook, Wind, register
from pgsd_nerfstudio.weather.matter import Emission, Material
from pgsd_nerfstudio.weather.touch import Splash, SurfaceResponse

WATER = Material(mass_milligram=0.5236, mass_exponent=3.0, speed_law="rain")  # pi / 6 mg: a sphere of 1 g/cm^3

RAINFALL = register(
    Effect(
        name="rainfall",
        emission=Emission(kind="raindrops", intensity=12.0, smallest=0.0005, largest=0.005, importance=1.0),
        material=WATER,
        wind=Wind(speed=2.0, turbulence=0.25, flutter=0.0),
        surface=SurfaceResponse(landing="wets", splash=Splash(), accumulates=False),
        appearance=Appearance(
            active=StateLook(
                scale_per_diameter=(0.9, 0.9, 0.9),
                scale_spread=0.0,
                opacity=0.95,
                opacity_spread=0.15,
                rgb=(0.86, 0.89, 0.93),
            ),
            exposure=1 / 60,
        ),
        prompt="Heavy rain is falling in {scene}, raindrops streak through the air and splash, surfaces are wet and dark. "
        "Photorealistic, high detail",
        negative_prompt="static, no rain, dry, sunny, blurry, distorted, cartoon, low quality",
    )
)
