"""Fog: droplets that are too small and too many to be seen one by one, carried by the wind in parcels.

Each simulated particle is a parcel of air with its droplets; all parcels have the same extinction. The sizes are those of
Shettle & Fenn's advection fog (1979).
"""

from __future__ import annotations

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Appearance, Effect, StateLook, Wind, register
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Emission, Material
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse

FOG = register(
    Effect(
        name="fog",
        emission=Emission(
            kind="fog droplets", intensity=20.0, smallest=2e-6, largest=150e-6, importance=2.0, most=3000, share=0.35
        ),
        material=Material(mass_milligram=0.5236, mass_exponent=3.0, speed_law="fog"),
        wind=Wind(speed=0.5, gustiness=0.25, turbulence=0.12, flutter=0.0, diffusivity=0.01),
        surface=SurfaceResponse(landing="glides", accumulates=False),
        appearance=Appearance(
            active=StateLook(
                scale_m=(0.26, 0.22, 0.15),
                scale_spread=0.6,
                opacity=None,
                rgb=(0.86, 0.88, 0.90),
                tone_spread=0.02,
            )
        ),
        haze=Haze(rgb=(0.80, 0.82, 0.84), patchiness=0.55, patch_size=8.0, scale_height=6.0),
        adaptation=Adaptation(visibility=2.5),
        ambience=Ambience(clouds=1.0, stops=-0.1, tint=(0.98, 1.0, 1.03), saturation=0.85, sky=(0.80, 0.82, 0.84)),
        prompt="Dense fog drifts through {scene}, soft patches of mist hide what is far away. Photorealistic, high detail",
        negative_prompt="static, clear air, sunny, distorted, cartoon, low quality",
    )
)
