"""Effects: the configuration of each weather, and the look that its particles have before training."""

from typing import TYPE_CHECKING, Any

from pgsd_nerfstudio.effects.effect import EFFECTS, Appearance, Effect, StateLook, Wind, effect
from pgsd_nerfstudio.effects.fog import FOG
from pgsd_nerfstudio.effects.matter import Dense, Emission, Material
from pgsd_nerfstudio.effects.rainfall import RAINFALL
from pgsd_nerfstudio.effects.sandstorm import SANDSTORM
from pgsd_nerfstudio.effects.snowfall import SNOWFALL
from pgsd_nerfstudio.effects.surface_response import Splash, SurfaceResponse

if TYPE_CHECKING:
    from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook, initial_look

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


def __getattr__(name: str) -> Any:
    """Import the look on first use: it needs torch, and `pgsd --help` shows the options of a weather without torch."""
    if name not in ("InitialLook", "ParticleLook", "initial_look"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pgsd_nerfstudio.effects import appearance

    return getattr(appearance, name)
