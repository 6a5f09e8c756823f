"""Which scene, and how the motion of its weather is simulated: the options that every command and the Python API share.

The text under each field is its --help. Commands that are given the same words simulate the same motion: the scene, the effect
and the options here decide what is simulated and name the file in the cache.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from pgsd_nerfstudio.physics.clock import Clock
    from pgsd_nerfstudio.scene.scene import Scene

FLAT = tyro.conf.arg(name="")
"""Marks a group of options whose flags carry no prefix."""

PARTICLES_CPU, PARTICLES_CUDA = 100_000, 1_000_000
"""Most particles that cameras see at once, where nothing is asked for: what pictures take in reasonable time."""
TRAINED_CPU, TRAINED_CUDA = 40_000, 100_000
"""The same for training, which rolls all of them out again and again."""
MOST_SECONDS = 3600.0
MOST_FRAMES = 200_000
MOST_PARTICLES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Which scene, and what it measures."""

    load_scene: Path = tyro.MISSING
    """The frozen scene: a splatfacto run folder, its config.yml, a .ckpt, a splat (.ply, .spz and others), the output folder of
    Inria's trainer, or the word demo."""
    data: Path | None = None
    """Cameras and photographs of a splat: nerfstudio's transforms.json, a COLMAP reconstruction, Inria's cameras.json, the
    folder of one of them, or a run. A run folder knows its own."""
    metres_per_unit: float | None = None
    """Length of one scene unit in metres; by default such that the cameras were held 1.5 m above the ground."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | tuple[float, float, float] | None = None
    """Which way is up in the scene's axes: the name of an axis or three numbers; by default from how the cameras were held."""
    camera: Literal["orbit"] | None = None
    """orbit makes cameras around the middle of a splat that has none."""
    trust_cameras: tyro.conf.FlagConversionOff[bool] = False
    """True: go on even if renders from the cameras do not look like their photographs."""

    def check(self) -> None:
        """Refuse what can be refused without opening the scene.

        Raises:
            ValueError: there is no such scene or data, or an option cannot be what it is.
        """
        from pgsd_nerfstudio.scene.source import check_source

        with _flags():
            check_source(self.load_scene, self.data, self.metres_per_unit, self.up, self.camera)

    def open(self, description: str | None = None) -> Scene:
        """The scene.

        Args:
            description: name of the scene in prompts; None: it is made from the name of the file.

        Raises:
            SceneError: it cannot be used, or its cameras do not fit it.
        """
        from pgsd_nerfstudio.weather.loading import load_scene

        with _flags():
            scene = load_scene(
                self.load_scene,
                self.data,
                metres_per_unit=self.metres_per_unit,
                description=description,
                up=self.up,
                camera=self.camera,
                trust_cameras=self.trust_cameras,
            )
        return replace(scene, remarks=tuple(ARGUMENT.sub(_flag, remark) for remark in scene.remarks))


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """How the motion of a weather is simulated."""

    seconds: float = 10.0
    """Length of the weather in seconds."""
    fps: float = 25.0
    """Frames per second of the simulation and of what is shown of it; 25 as in the paper's videos."""
    max_particles: int | None = None
    """Bound for time and memory: most particles that cameras see at once. All that a picture tells apart are there, as far as
    this allows; what is too far away is haze. Droplets of splashes come on top; --physics paper has its own number.
    By default 100,000 (training: 40,000), with CUDA 1,000,000 (training: 100,000)."""
    physics: Literal["metric", "paper"] = "metric"
    """metric is right in SI units; paper is the publication's solver and numbers (MPM throughout in a unit cube, no air),
    to compare with."""
    everything: tyro.conf.FlagConversionOff[bool] = False
    """Simulate also the air that no training camera sees: costs time, and free camera paths see weather everywhere."""
    collisions: tyro.conf.FlagConversionOff[bool] = True
    """Whether particles meet the scene's surface; False: they fall through it (the paper's "w/o CH")."""
    seed: Annotated[int, tyro.conf.arg(aliases=["--weather-seed"])] = 0
    """Seed of the weather: another one is another snowfall of the same kind. (Training has a seed of its own,
    --machine.seed.)"""

    def check(self) -> None:
        """Refuse values that cannot be simulated.

        Raises:
            ValueError: a value is out of its range; one sentence says which.
        """
        bounds = (("seconds", 0.0, MOST_SECONDS, " s"), ("fps", 1.0, 1000.0, ""), ("max_particles", 0, MOST_PARTICLES, ""))
        for name, least, most, unit in bounds:
            value = getattr(self, name)
            flag = name.replace("_", "-")
            if value is not None and not value > 0:
                raise ValueError(f"--{flag} must be positive, got {value:g}{unit}")
            if value is not None and not value >= least:
                raise ValueError(f"--{flag} must be at least {least:g}{unit}, got {value:g}{unit}")
            if value is not None and not value <= most:
                raise ValueError(f"--{flag} must be at most {most:g}{unit}, got {value:g}{unit}")
        if self.seconds * self.fps > MOST_FRAMES:
            raise ValueError(
                f"--seconds {self.seconds:g} at --fps {self.fps:g} are {self.seconds * self.fps:,.0f} frames; at most "
                f"{MOST_FRAMES:,} can be simulated"
            )
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"--seed must not be negative and less than 2^63, got {self.seed}")
        if self.physics not in ("metric", "paper"):
            raise ValueError(f"--physics must be metric or paper, got {self.physics!r}")
        for name in ("everything", "collisions"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"--{name} must be True or False, got {getattr(self, name)!r}")
        for name in ("max_particles", "seed"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, int):
                raise ValueError(f"--{name.replace('_', '-')} must be a whole number, got {value!r}")

    @property
    def frames(self) -> int:
        """Frames of the whole weather."""
        return max(2, round(self.seconds * self.fps))

    @property
    def clock(self) -> Clock:
        """The frames and how long each lasts."""
        from pgsd_nerfstudio.physics.clock import Clock

        return Clock(self.fps, self.frames)

    @property
    def particles(self) -> int:
        """Most particles seen at once: as asked for, else what this machine affords."""
        return self.max_particles or (PARTICLES_CUDA if _has_cuda() else PARTICLES_CPU)

    @property
    def for_training(self) -> SimulationOptions:
        """The same with as many particles as training affords, where no number was asked for."""
        return replace(self, max_particles=self.max_particles or (TRAINED_CUDA if _has_cuda() else TRAINED_CPU))


@dataclass(frozen=True, kw_only=True)
class AnswerOptions:
    """How the frozen scene answers the weather."""

    edited_images: Path | None = None
    """Folder of training views as an image editor shows them under this weather, named as the originals are.
    The scene's look is fitted to them (1000 iterations, as in the paper; cached). By default it follows from geometry."""

    def check(self) -> None:
        """Refuse a folder that is not there.

        Raises:
            ValueError: there is no such folder.
        """
        if self.edited_images is not None:
            from pgsd_nerfstudio.response.edited_pictures import edited_folder

            edited_folder(self.edited_images)


ARGUMENT = re.compile(r"(?<![\w./-])(data|metres_per_unit|up|camera|trust_cameras)=('(\w+)'|True)?")


@contextmanager
def _flags() -> Iterator[None]:
    """Sentences that speak of arguments, as Python has them, speak of flags where a command was typed."""
    from pgsd_nerfstudio.scene.errors import SceneError

    try:
        yield
    except SceneError as error:
        raise SceneError(ARGUMENT.sub(_flag, str(error))) from error


def _flag(argument: re.Match[str]) -> str:
    value = argument[3] or argument[2]
    return f"--{argument[1].replace('_', '-')}" + (f" {value}" if value else "")


def _has_cuda() -> bool:
    if importlib.util.find_spec("torch") is None:
        return False
    import torch

    return torch.cuda.is_available()
