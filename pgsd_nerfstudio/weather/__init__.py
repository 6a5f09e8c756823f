"""What falls: one Effect per weather, pure configuration, and the look it starts from."""

from pgsd_nerfstudio.weather.appearance import InitialLook, ParticleLook, initial_look
from pgsd_nerfstudio.weather.effect import (
    EFFECTS,
    Appearance,
    Effect,
    Emission,
    Material,
    StateLook,
    SurfaceResponse,
    Wind,
    effect,
)
from pgsd_nerfstudio.weather.snowfall import SNOWFALL

__all__ = [
    "EFFECTS",
    "SNOWFALL",
    "Appearance",
    "Effect",
    "Emission",
    "InitialLook",
    "Material",
    "ParticleLook",
    "StateLook",
    "SurfaceResponse",
    "Wind",
    "effect",
    "initial_look",
]
