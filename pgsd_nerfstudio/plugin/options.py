"""What one run is: the options of `ns-train pgsd-weather`, as one record that pipeline, data manager and model share.

The text under each field is its --help. Groups of options carry no prefix in their flags. Defaults fit the machine at hand: on
a CPU everything is small enough to end within minutes, with CUDA it follows the paper.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.effects.language_model import Understanding
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.effects.request import Request
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.training_options import CUDA, ClipOptions, GuidanceOptions, LearningOptions, MotionOptions
from pgsd_nerfstudio.version import __version__
from pgsd_nerfstudio.weather.options import FLAT, AnswerOptions, SceneOptions, SimulationOptions


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """One weather for one scene, and how it is learned."""

    scene: Annotated[SceneOptions, FLAT] = field(default_factory=SceneOptions)
    weather: Annotated[EffectOptions, FLAT] = field(default_factory=EffectOptions)
    simulation: Annotated[SimulationOptions, FLAT] = field(default_factory=SimulationOptions)
    answer: Annotated[AnswerOptions, FLAT] = field(default_factory=AnswerOptions)
    guidance: Annotated[GuidanceOptions, FLAT] = field(default_factory=GuidanceOptions)
    motion: Annotated[MotionOptions, FLAT] = field(default_factory=MotionOptions)
    clips: Annotated[ClipOptions, FLAT] = field(default_factory=ClipOptions)
    learning: Annotated[LearningOptions, FLAT] = field(default_factory=LearningOptions)
    export_time: float = 1.0
    """The moment that ns-export gaussian-splat writes, from 0 (start of the weather) to 1 (its end)."""
    understood: tyro.conf.Suppress[dict[str, Any] | None] = None
    """What the words of --weather were taken for when the run was configured: opening the run later asks nobody."""
    training_seed: tyro.conf.Suppress[int] = 42
    """--machine.seed, for those who do not see the machine's configuration."""
    version: tyro.conf.Suppress[str] = __version__
    """The version of this plugin that wrote the config."""

    @staticmethod
    def unset() -> RunOptions:
        """Options without a scene: the default of nested configurations, until the trainer's hands its own on."""
        return RunOptions(scene=SceneOptions(load_scene=Path()))

    @property
    def taught(self) -> bool:
        """Whether anything is learned: the bundled prior knows no weather but snow, unless it is told to try."""
        bundled = self.guidance.prior == "bundled"
        return self.learning.steps is not None or not bundled or self.chosen_effect().name == "snowfall"

    @property
    def training_steps(self) -> int:
        """Steps of the run; a single one that changes nothing where nothing is to be learned."""
        if self.learning.steps is not None:
            return self.learning.steps
        return (1000 if CUDA else 60) if self.taught else 1

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the first step by group of parameters."""
        return {"field": self.learning.lr, "look": self.learning.look_lr} if self.taught else {"field": 0.0, "look": 0.0}

    @property
    def knows_wide_flakes(self) -> bool:
        """Whether the prior has only seen clips in which a flake is never thinner than a pixel, as the bundled one has.

        Its clips are drawn so; everything else shows what particles cover.
        """
        return self.guidance.prior == "bundled"

    @property
    def answering_clips(self) -> bool:
        """Whether training clips show the scene's answer."""
        shown = self.clips.surfaces_in_clips
        return self.guidance.prior != "bundled" if shown is None else shown

    def absolute(self) -> RunOptions:
        """The same with absolute paths, so that the run can be opened from any folder."""
        scene = self.scene
        if str(scene.load_scene) != "demo":
            scene = replace(scene, load_scene=Path(scene.load_scene).expanduser().resolve())
        if scene.data is not None:
            scene = replace(scene, data=scene.data.expanduser().resolve())
        return replace(self, scene=scene)

    def check(self) -> None:
        """Check what can be checked before any work.

        Raises:
            RunError: a value cannot be used; the sentence says which and why.
        """
        with _refusing():
            for group in (self.scene, self.simulation, self.answer, self.guidance, self.motion, self.clips, self.learning):
                group.check()
            if not 0.0 <= self.export_time <= 1.0:
                raise ValueError(f"--export-time must lie in 0-1, got {self.export_time}")
        self.chosen_effect()

    def chosen_effect(self) -> Effect:
        """The effect of all options; words were read when the run was configured, and mean the same ever after.

        Raises:
            RunError: there is no such effect, or an option cannot be used.
        """
        return self._effect_and_remarks()[0]

    def remarks(self) -> list[str]:
        """How the words for the weather were read, and what cannot be done; raises as `chosen_effect`."""
        return self._effect_and_remarks()[1]

    def with_words_understood(self) -> RunOptions:
        """The same with the meaning of the words for the weather, so that the run's config.yml says it.

        Raises:
            RunError: they name nothing that could be in the air, or an answer cannot be stored in the cache.
        """
        with _refusing():
            understanding = self.weather.understand()
        if understanding is None:
            return replace(self, understood=None)
        meaning = {"by": understanding.by, "remark": understanding.remark}
        request = json.loads(understanding.request.to_json())
        return replace(self, understood={**self._words(), **meaning, "request": request})

    def _effect_and_remarks(self) -> tuple[Effect, list[str]]:
        with _refusing():
            return self.weather.resolve_understood(self._understood() or self.weather.understand())

    def _understood(self) -> Understanding | None:
        """What is stored, if it is of the same words and reader."""
        stored = self.understood
        if stored is None or any(stored.get(name) != value for name, value in self._words().items()):
            return None
        request = Request.from_json(json.dumps(stored["request"]))
        return Understanding(request=request, by=stored["by"], remark=stored["remark"])

    def _words(self) -> dict[str, str | None]:
        return {name: getattr(self.weather, name) for name in ("weather", "llm", "llm_url")}

    def command(self) -> str:
        """The ns-train command that makes this run's motion prior again."""
        words = ["ns-train", "pgsd-weather"]
        for group in (self.scene, self.weather, self.simulation):
            for option in fields(group):
                value = getattr(group, option.name)
                if option.name == "load_scene" or value != option.default:
                    words += [f"--{option.name.replace('_', '-')}", str(value)]
        return shlex.join(words)


@contextmanager
def _refusing() -> Iterator[None]:
    """Errors of bad input become an error of the run."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise RunError(str(error)) from error


def check_version(found: str | None) -> None:
    """Refuse configs of another version, whose fields may mean something else.

    Args:
        found: the version that a config.yml names, if any.

    Raises:
        RunError: the first two parts of the version differ.
    """
    if found is None or found.split(".")[:2] != __version__.split(".")[:2]:
        raise RunError(
            f"this config was written by pgsd_nerfstudio {found or 'of an unknown version'}, installed is {__version__}: "
            f"train the run again, or install the version that wrote it"
        )
