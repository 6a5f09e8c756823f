"""What one run is: the flags of `ns-train pgsd-weather`, as a plain record that pipeline, data manager and model share.

The text under each field is its --help. Defaults fit the machine at hand: on a CPU everything is small enough to end within
minutes, with CUDA it follows the paper.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

from pgsd_nerfstudio import __version__
from pgsd_nerfstudio.dynamics import FieldConfig, RegularizationWeights
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.effects.knobs import Knobs
from pgsd_nerfstudio.effects.language_model import Understanding
from pgsd_nerfstudio.effects.request import Request
from pgsd_nerfstudio.guidance.distillation import DistillationConfig
from pgsd_nerfstudio.guidance.schedules import Weighting
from pgsd_nerfstudio.plugin.environment import RunError

CUDA = torch.cuda.is_available()


@dataclass
class SceneOptions:
    """Which scene, and what it is called and measures."""

    load_scene: Path = tyro.MISSING
    """The frozen scene: a splatfacto run folder, its config.yml, a .ckpt, a 3DGS .ply (with --data), or the word demo."""
    data: Path | None = None
    """Cameras and photographs of a .ply: nerfstudio's transforms.json or its folder. A run folder knows its own."""
    scene_description: str | None = None
    """What the prompt calls the scene, such as "a garden with a table"; by default made from the scene's name."""
    metres_per_unit: float | None = None
    """Length of one scene unit in metres; by default such that the cameras were held 1.5 m above the ground."""


@dataclass
class WeatherOptions(Knobs, SceneOptions):
    """One weather for one scene, and how it is learned."""

    seconds: float = 10.0
    """Length of the weather in seconds."""
    fps: float = 25.0
    """Frames of weather per second, as in the paper's videos."""
    max_particles: int = 100_000 if CUDA else 8_000
    """At most this many particles are in the air at once, each then standing for several; bounds the time of every step."""
    physics: Literal["metric", "paper"] = "metric"
    """How the weather moves: metric is right in SI units; paper is the publication's solver and numbers (MPM throughout in a
    unit cube, no air), to compare with."""
    everything: bool = False
    """Simulate also the air that no training camera can see; costs time, and free camera paths see weather everywhere."""
    weather_seed: int = 0
    """Another seed, another snowfall of the same kind. (--machine.seed varies the training only.)"""
    edited_images: Path | None = None
    """Folder of training views as an image editor shows them under this weather, named as the originals are: the scene's look
    is fitted to them (1000 iterations, as in the paper) and comes with the weather. By default it follows from geometry."""
    surfaces_in_clips: bool | None = None
    """Whether training clips show the scene's answer (cover, wetness, light, haze), as what is looked at does. By default they
    do, except with the bundled prior, which has only ever seen flakes in a scene that stays as it is."""
    prior: str = "bundled"
    """The video prior: bundled (small, knows only clips like the demo's), a diffusers folder of CogVideoX or Wan 2.1, or a
    hub id such as THUDM/CogVideoX-2b or Wan-AI/Wan2.1-T2V-1.3B-Diffusers."""
    prompt: str | None = None
    """What the video prior is told; by default the effect's own prompt, or that of --weather, with the scene's description."""
    negative_prompt: str | None = None
    """What the video prior is told to keep away from; by default the effect's own."""
    steps: int | None = None
    """Training steps. By default the paper's 1000 with CUDA, on a CPU 60, as many as pass in a few minutes with the bundled
    prior. That one has only seen snow: for any other weather it teaches nothing good, so that by default nothing is learned
    from it, and the run keeps the simulated motion and the curated look."""
    distillation: DistillationConfig = field(default_factory=DistillationConfig)
    """How the video prior's predictions become a gradient; the paper's ablations of SDS variants."""
    tiny_vae: Path | None = None
    """Weights of taecvx (.safetensors or .pth), a small encoder in place of the prior's own, at a fraction of memory
    and time. How far its gradient agrees with the full one is printed at the start."""
    dynamics: FieldConfig = field(default_factory=FieldConfig)
    """What the field may change; the paper's ablations of fixed appearance, fixed rotation and fixed motion ("w/o PG")."""
    motion: Literal["particle", "field", "deformation"] = "particle"
    """What moves a particle that has left its simulated path: its own simulated velocity (the paper), that of the place where
    it is (field), or no simulation at all but a learned deformation of scattered particles (the paper's "w/o Motion")."""
    collisions: bool = True
    """Whether the motion prior meets the scene's surface; off particles fall through it (the paper's "w/o CH")."""
    begin: Literal["rollout", "simulation"] = "rollout"
    """Where a training clip starts: from the state that the roll-out reaches, or from the simulation (the paper's code), which
    never shows training the drift of the full-length video."""
    gradient_frames: int | None = None
    """Frames through which the gradient follows the recurrence: the whole clip by default, 1 as in the paper's code."""
    regularization: RegularizationWeights = field(default_factory=RegularizationWeights)
    """Weights of the physics and appearance losses; --regularization.without xyz leaves one out, app all of the appearance."""
    lr: float = 1e-4 if CUDA else 1e-3
    """Learning rate of the field at the start, falling to zero along a cosine. The paper's 1e-4 is meant for 1000 steps; the
    few steps of a CPU need the larger one."""
    look_lr: float = 2e-3 if CUDA else 2e-2
    """Learning rate of the look that all particles share, along the same cosine: 14 numbers (logits, log scales, colours), each
    of which can move by no more than the sum of all rates."""
    weights: Weighting = "adaptive"
    """How the physics and appearance losses are weighed: times the magnitude of the video loss (the paper), as they are, or by
    one of the paper's schedules over the training (all three worse, it says)."""
    trajectory: Literal["near", "any"] = "near"
    """Camera path of a training clip: from a random training view to one of the six nearest, or to any other, as in the paper
    (whose straight way through a ring of views leads across its middle within a third of a second)."""
    layers: int | None = None
    """Without a GPU: press the frozen scene behind every 16x16 pixels into so many layers, which makes training frames faster
    at a small error (64 for 96x64 pixels, 16 for larger ones). The error, larger where weather lies on surfaces than where it
    flies, is printed with the first clip; by default exact."""
    refresh_every: int = 50
    """Steps between roll-outs of the whole weather, which keep the look of what lies for the clips in between; what flies is
    always where the present weights lead it."""
    clip_every: int = 20
    """Steps between training clips that go to the log as pictures, their frames side by side (--vis tensorboard); 0: never."""
    clip_frames: int | None = None
    """Frames of a training clip; by default 9 as in the paper, or what the video prior was made for if that is less."""
    clip_height: int | None = None
    """Height of a training clip in pixels; by default what the video prior was made for."""
    clip_width: int | None = None
    """Width of a training clip in pixels; by default what the video prior was made for."""
    export_time: float = 1.0
    """The moment that ns-export gaussian-splat writes, from 0 (start of the weather) to 1 (its end)."""
    understood: tyro.conf.Suppress[dict[str, Any] | None] = None
    """What the words of --weather were taken for when the run was configured: who opens it later asks nobody."""
    training_seed: tyro.conf.Suppress[int] = 42
    """--machine.seed, for those who do not see the machine's configuration."""
    version: tyro.conf.Suppress[str] = __version__
    """The version of this plugin that wrote the config."""

    @staticmethod
    def unset() -> WeatherOptions:
        """Options without a scene: the default of nested configurations, until the trainer's hands its own on."""
        return WeatherOptions(load_scene=Path())

    @property
    def taught(self) -> bool:
        """Whether anything is learned: the bundled prior knows no weather but snow, unless it is told to try."""
        return self.steps is not None or self.prior != "bundled" or self.chosen_effect().name == "snowfall"

    @property
    def training_steps(self) -> int:
        """Steps of the run; a single one that changes nothing where nothing is to be learned."""
        default = 1000 if CUDA else 60
        return (default if self.taught else 1) if self.steps is None else self.steps

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the first step by group of parameters."""
        return {"field": self.lr, "look": self.look_lr} if self.taught else {"field": 0.0, "look": 0.0}

    @property
    def answering_clips(self) -> bool:
        """Whether training clips show the scene's answer."""
        return self.prior != "bundled" if self.surfaces_in_clips is None else self.surfaces_in_clips

    @property
    def frames(self) -> int:
        """Frames of the whole weather."""
        return max(2, round(self.seconds * self.fps))

    def check(self) -> None:
        """Judge what can be judged before any work.

        Raises:
            RunError: a value cannot be used; the sentence says which and why.
        """
        if str(self.load_scene) != "demo" and not self.load_scene.exists():
            raise RunError(
                f"no scene at {self.load_scene}: expected a splatfacto run folder, config.yml, .ckpt or .ply, or the word demo"
            )
        if self.data is not None and not self.data.exists():
            raise RunError(f"no data at {self.data}: expected nerfstudio's transforms.json or its folder")
        if self.edited_images is not None and not self.edited_images.is_dir():
            raise RunError(f"--edited-images must be a folder of edited training views, found none at {self.edited_images}")
        positive = {
            "seconds": self.seconds,
            "fps": self.fps,
            "max-particles": self.max_particles,
            "steps": self.training_steps,
            "refresh-every": self.refresh_every,
        }
        for name, value in positive.items():
            if not value > 0:
                raise RunError(f"--{name} must be positive, got {value}")
        if self.gradient_frames is not None and self.gradient_frames < 1:
            raise RunError(f"--gradient-frames must be at least 1, got {self.gradient_frames}")
        if self.tiny_vae is not None and not self.tiny_vae.is_file():
            raise RunError(f"no tiny VAE at {self.tiny_vae}: expected a file with the weights of taecvx")
        if not 0.0 <= self.export_time <= 1.0:
            raise RunError(f"--export-time must lie in 0-1, got {self.export_time}")
        if self.layers is not None and (CUDA or self.layers < 1):
            raise RunError(f"--layers must be at least 1 and is meant for machines without CUDA, got {self.layers}")
        self.chosen_effect()

    def chosen_effect(self) -> Effect:
        """The effect with all knobs turned; words were read when the run was configured, and mean the same ever after.

        Raises:
            RunError: there is no such effect, or a knob cannot be used.
        """
        return self._effect_and_remarks()[0]

    def remarks(self) -> list[str]:
        """How the words for the weather were read, and what cannot be done; raises as `chosen_effect`."""
        return self._effect_and_remarks()[1]

    def understand(self) -> None:
        """Keep with the options what the words for the weather mean, so that the run's config.yml says it.

        Raises:
            RunError: they name nothing that could be in the air, or an answer cannot be kept in the cache.
        """
        with _refusing():
            asked = self.asked()
        if asked is None:
            self.understood = None
            return
        self.understood = {
            **self._words(),
            "by": asked.by,
            "remark": asked.remark,
            "request": json.loads(asked.request.to_json()),
        }

    def _effect_and_remarks(self) -> tuple[Effect, list[str]]:
        with _refusing():
            return self.turned(self._understood() or self.asked())

    def _understood(self) -> Understanding | None:
        """What is kept, if it is of the same words and reader."""
        kept = self.understood
        if kept is None or any(kept.get(name) != value for name, value in self._words().items()):
            return None
        return Understanding(request=Request.from_json(json.dumps(kept["request"])), by=kept["by"], remark=kept["remark"])

    def _words(self) -> dict[str, str | None]:
        return {name: getattr(self, name) for name in ("weather", "llm", "llm_url")}

    def command(self) -> str:
        """The ns-train command that makes this run's motion prior again."""
        words = ["ns-train", "pgsd-weather"]
        turned = [knob.name for knob in fields(Knobs) if getattr(self, knob.name) != knob.default]
        simulated = ["seconds", "fps", "max_particles", "physics", "everything", "weather_seed"]
        for name in ("load_scene", "data", "metres_per_unit", *turned, *simulated):
            value = getattr(self, name)
            if value is not None:
                words += [f"--{name.replace('_', '-')}", str(value)]
        return shlex.join(words)


@contextmanager
def _refusing() -> Iterator[None]:
    """What the weather refuses, as an error of the run."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise RunError(str(error)) from error


def check_version(found: str | None) -> None:
    """Refuse configs of another version, whose fields may mean something else.

    Raises:
        RunError: the first two parts of the version differ.
    """
    if found is None or found.split(".")[:2] != __version__.split(".")[:2]:
        raise RunError(
            f"this config was written by pgsd_nerfstudio {found or 'of an unknown version'}, installed is {__version__}: "
            f"train the run again, or install the version that wrote it"
        )
