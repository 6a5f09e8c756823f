"""What falls: one Effect per weather, pure configuration, and the look it starts from."""

from pgsd_nerfstudio.weather.appearance import InitialLook, ParticleLook, initial_look
from pgsd_nerfstudio.weather.effect import EFFECTS, Appearance, Effect, StateLook, Wind, effect
from pgsd_nerfstudio.weather.fog import FOG
from pgsd_nerfstudio.weather.matter import Dense, Emission, Material
from pgsd_nerfstudio.weather.rainfall import RAINFALL
from pgsd_nerfstudio.weather.sandstorm import SANDSTORM
from pgsd_nerfstudio.weather.snowfall import SNOWFALL
from pgsd_nerfstudio.weather.touch import Splash, SurfaceResponse

__all__ = [
    "EFFECTS",
    "FOG",
    "RAINFALL",
    "SANDSTORM",
    "SNOWFALL",
    "Appearance",
    "Dense",
    "Effect",
    "Emission",
    "InitialLook",
    "Material",
    "ParticleLook",
    "Splash",
    "StateLook",
    "SurfaceResponse",
    "Wind",
    "effect",
    "initial_look",
]
