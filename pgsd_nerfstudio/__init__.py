"""Weather for any 3D Gaussian scene, in Python and as a nerfstudio method.

    import pgsd_nerfstudio

    scene = pgsd_nerfstudio.load_scene("garden.ply", data="garden")
    weather = pgsd_nerfstudio.simulate(scene, pgsd_nerfstudio.effect("snowfall", intensity=2.0), seconds=10)
    weather.render(scene.cameras[0], second=3.0).save("snow.png")

The names below are the public API. They are imported when they are first used, so that `import pgsd_nerfstudio` is quick and
needs neither torch nor nerfstudio. All other names are internal and may change from version to version.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pgsd_nerfstudio.version import __version__

if TYPE_CHECKING:
    from pgsd_nerfstudio.effects.effect import Effect, effect
    from pgsd_nerfstudio.effects.options import EffectOptions
    from pgsd_nerfstudio.scene.camera_path import slow_path
    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.scene.scene import Scene, SceneError
    from pgsd_nerfstudio.weather.loading import load_scene
    from pgsd_nerfstudio.weather.making import simulate
    from pgsd_nerfstudio.weather.picture import Picture
    from pgsd_nerfstudio.weather.stored import StoredWeatherError
    from pgsd_nerfstudio.weather.video import write_video
    from pgsd_nerfstudio.weather.weather import Weather

__all__ = [
    "Cameras",
    "Effect",
    "EffectOptions",
    "Picture",
    "Scene",
    "SceneError",
    "StoredWeatherError",
    "Weather",
    "__version__",
    "effect",
    "load_scene",
    "simulate",
    "slow_path",
    "write_video",
]

_PLACES = {
    "Cameras": "scene.cameras",
    "Effect": "effects.effect",
    "EffectOptions": "effects.options",
    "Picture": "weather.picture",
    "Scene": "scene.scene",
    "SceneError": "scene.scene",
    "StoredWeatherError": "weather.stored",
    "Weather": "weather.weather",
    "effect": "effects",  # the whole room: its modules register the built-in effects
    "load_scene": "weather.loading",
    "simulate": "weather.making",
    "slow_path": "scene.camera_path",
    "write_video": "weather.video",
}

# OpenMP threads that wait by spinning slow each other down. Read when torch is loaded: in nerfstudio's own commands, which load
# it first, the shell has to say so.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
