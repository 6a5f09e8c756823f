"""What falls: one Effect per weather, pure configuration, and the look it starts from."""

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
    """The look needs torch and is imported when it is asked for: `pgsd --help` knows the knobs of a weather without it."""
    if name not in ("InitialLook", "ParticleLook", "initial_look"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pgsd_nerfstudio.effects import appearance

    return getattr(appearance, name)
