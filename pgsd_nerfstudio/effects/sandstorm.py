"""Sandstorm: grains of 0.1 to 1 mm that a strong wind carries, and that settle as a thin cover.

Sizes: the sand populations of desert soils of Tegen et al. (2002). Fall speeds: Ferguson & Church (2004).
"""

from __future__ import annotations

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Appearance, Effect, StateLook, Wind, register
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Dense, Emission, Material
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
from pgsd_nerfstudio.effects.timeline import Timeline

QUARTZ = Material(mass_milligram=1.3875, mass_exponent=3.0, speed_law="sand")  # a sphere of 2650 kg/m^3

SANDSTORM = register(
    Effect(
        name="sandstorm",
        emission=Emission(
            kind="sand grains", intensity=30.0, smallest=0.1e-3, largest=1e-3, importance=5.0, most=60_000, share=0.1
        ),
        material=QUARTZ,
        wind=Wind(speed=9.0, gustiness=0.3, gust_seconds=3.0, turbulence=0.9, largest_eddy=4.0, smallest_eddy=0.5, flutter=0.0),
        timeline=Timeline(onset=5.0, arrives="as a front"),
        surface=SurfaceResponse(
            holds_degrees=40.0,
            slips_degrees=95.0,
            friction=0.5,
            settle=0.003,
            repose_degrees=33.0,
            film=0.002,
            accumulation_speedup=60.0,
            layer_density=1600.0,
            layer_thickness=0.004,
            hides=0.0015,
        ),
        dense=Dense(matter="sand", young=1e5, friction=0.6),
        appearance=Appearance(
            active=StateLook(
                scale_per_diameter=(0.36, 0.36, 0.36),
                scale_spread=0.0,
                opacity=0.97,
                opacity_spread=0.0,
                rgb=(1.0, 0.95, 0.82),
                tone_spread=0.20,
            ),
            collided=StateLook(
                scale_spread=0.4, opacity=0.35, opacity_spread=0.2, rgb=(0.80, 0.66, 0.46), tone_spread=0.08, settle_seconds=0.4
            ),
            legibility=300.0,
            exposure=1 / 50,
        ),
        haze=Haze(rgb=(0.74, 0.58, 0.38), patchiness=0.25, patch_size=32.0),
        adaptation=Adaptation(visibility=2.0, wind_across=True, air=4.0),
        ambience=Ambience(clouds=0.9, stops=-0.4, tint=(1.12, 0.98, 0.74), saturation=0.9, sky=(0.74, 0.58, 0.38)),
        prompt="A sandstorm sweeps through {scene}, sand grains fly in the wind, dust hangs in the air and sand settles on "
        "surfaces. Photorealistic, high detail",
        negative_prompt="static, clear air, no sand, snow, rain, distorted, cartoon, low quality",
    )
)
