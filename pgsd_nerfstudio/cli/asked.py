"""What every command that makes weather is asked for, and the steps with which each of them begins."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from pgsd_nerfstudio.cli.console import say
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.refusal import refusing
from pgsd_nerfstudio.weather.options import FLAT, SceneOptions, SimulationOptions

if TYPE_CHECKING:
    from pgsd_nerfstudio.effects import Effect
    from pgsd_nerfstudio.scene.scene import Scene


@dataclass(frozen=True, kw_only=True)
class WeatherCommand:
    """Which scene, which weather, and how its motion is simulated; the same options as those of ns-train pgsd-weather."""

    scene: Annotated[SceneOptions, FLAT] = field(default_factory=SceneOptions)
    weather: Annotated[EffectOptions, FLAT] = field(default_factory=EffectOptions)
    simulation: Annotated[SimulationOptions, FLAT] = field(default_factory=SimulationOptions)

    def chosen_effect(self) -> Effect:
        """The effect that is asked for; all options are checked, and what is to be said about them is said.

        Raises:
            Refusal: an option cannot be used.
        """
        with refusing(ValueError, OSError):
            self.scene.check()
            self.simulation.check()
            self.weather.check()
            if self.weather.llm is not None:
                say(f"asking {self.weather.llm} what {self.weather.weather!r} means")
            effect, remarks = self.weather.resolve()
        for remark in remarks:
            say(remark)
        return effect

    def open_scene(self) -> Scene:
        """The scene that is asked for.

        Raises:
            Refusal: it cannot be used.
        """
        with refusing(ValueError, OSError):
            say(f"opening {self.scene.load_scene}")
            scene = self.scene.open()
        say(f"{len(scene.gaussians):,} Gaussians, {len(scene.cameras)} views; {scene.frame.source}")
        for remark in scene.remarks:
            say(remark)
        return scene
