"""`pgsd preview`: what a weather looks like in a scene before anything is trained."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pgsd_nerfstudio.cli.refusal import Refusal, refusing
from pgsd_nerfstudio.effects.knobs import Knobs

if TYPE_CHECKING:
    from rich.console import Console
    from torch import Tensor

    from pgsd_nerfstudio.effects import Effect
    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.scene.scene import Scene


@dataclass(kw_only=True)
class Simulated:
    """Which scene, and how the weather in it is simulated; not frozen, since the knobs of a weather are not."""

    load_scene: str
    """A splatfacto run (folder, config.yml or .ckpt), a 3DGS .ply (then with --data), or the word demo."""
    data: Path | None = None
    """Folder of transforms.json, or the file; a .ply needs it for its cameras."""
    metres_per_unit: float | None = None
    """Length of a scene unit in metres; estimated from the cameras' height above the ground if not given."""
    seconds: float = 10.0
    """Length of the simulated weather in seconds."""
    fps: float = 25.0
    """Frames per second, of the simulation and of what is shown of it."""
    max_particles: int | None = None
    """Most particles in the air at once, each standing for several real ones; by default 20,000.
    A preview with CUDA takes 200,000."""
    seed: int = 0
    """Seed of everything random."""
    physics: Literal["metric", "paper"] = "metric"
    """metric is right in SI units; paper is the publication's solver and numbers, to compare with."""
    everything: bool = False
    """Simulate also the air that no training camera can see."""


@dataclass(kw_only=True)
class Preview(Knobs, Simulated):
    """Show a weather in a scene without training: simulated motion, initial look, as an mp4 and a picture beside it."""

    output: Path = Path("preview.mp4")
    """Where the video goes; its last frame goes beside it as .png."""
    frames: int = 50
    """Length of the video in frames."""
    width: int = 640
    """Width in pixels."""
    height: int = 360
    """Height in pixels."""
    edited_images: Path | None = None
    """Folder of training views as an image editor shows them under this weather, named as the originals are.
    The scene's look is fitted to them (1000 iterations, kept in the cache) and comes with the weather."""
    start: float | None = None
    """First second to show; by default the last ones are shown, when the most has gathered."""
    views: tuple[int, int] | None = None
    """Numbers of the two training views between which the camera moves; chosen by itself if not given."""

    def run(self) -> int:
        from rich.progress import track

        from pgsd_nerfstudio.cli.video import write_picture, write_video

        self._check()
        began = time.perf_counter()
        effect = effect_told(self, self.output.parent)
        with refusing(ValueError, FileNotFoundError):
            say(f"opening {self.load_scene}")
            scene = open_scene(self.load_scene, self.data, self.metres_per_unit)
            cameras = self._cameras(scene)
        self._make_folder()
        say(f"{len(scene.gaussians):,} Gaussians, {len(scene.cameras)} views; {scene.frame.source}")
        with refusing(OSError, ValueError):  # a full disk while caching, edited pictures that do not fit
            picture = self._pictures(scene, effect, cameras)
        poster = self.output.with_suffix(".png")
        shown = track(range(self.frames), "rendering", console=console(), transient=True)
        try:
            write_video(self.output, (picture(index) for index in shown), self.fps)
            write_picture(poster, picture(self.frames - 1))
        except OSError as error:
            raise Refusal(
                f"{self.output} could not be written ({error}): free some space or choose another --output"
            ) from error
        say(f"{self.frames} frames in {time.perf_counter() - began:.0f} s")
        print(self.output, poster, sep="\n")
        return 0

    def _check(self) -> None:
        for name in ("frames", "width", "height", "fps", "seconds", "max_particles"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise Refusal(f"--{name.replace('_', '-')} must be positive, got {value:g}")
        if min(self.width, self.height) < 16:
            raise Refusal(f"a video needs at least 16x16 pixels, got {self.width}x{self.height}")
        if self.output.suffix.lower() != ".mp4":
            raise Refusal(f"--output must end in .mp4, got {self.output}")
        if self.start is not None and not self.start >= 0:
            raise Refusal(f"--start must not be negative, got {self.start:g} s")

    def _make_folder(self) -> None:
        """The folder of the output, before anything costly is done."""
        try:
            self.output.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Refusal(f"{self.output} cannot be written ({error.strerror}); choose another --output") from error

    @property
    def _first(self) -> int:
        """The first frame of the weather that is shown."""
        if self.start is not None:
            return round(self.start * self.fps)
        return max(0, round(self.seconds * self.fps) - self.frames)

    def _cameras(self, scene: Scene) -> Cameras:
        from pgsd_nerfstudio.scene.camera_path import choose_views, fly

        count = len(scene.cameras)
        first, last = self.views or choose_views(scene.cameras, scene.frame)
        if not (0 <= first < count and 0 <= last < count):
            raise ValueError(f"--views must lie in 0-{count - 1}, the training views of this scene, got {first} {last}")
        cameras = fly(scene.cameras, first, last, start=self._first, frames=self.frames, fps=self.fps)
        return cameras.resized(self.width, self.height)

    def _pictures(self, scene: Scene, effect: Effect, cameras: Cameras) -> Callable[[int], Tensor]:
        """Surface and motion prior; then a function from the number of a picture to the picture [H, W, 3]."""
        import torch

        from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
        from pgsd_nerfstudio.effects import initial_look
        from pgsd_nerfstudio.physics import MAX_PARTICLES, Clock, motion_prior
        from pgsd_nerfstudio.rendering.choice import choose_rasterizer
        from pgsd_nerfstudio.response.landed import in_place
        from pgsd_nerfstudio.response.prepare import answer_of, edits_of
        from pgsd_nerfstudio.surface.mesh import surface_of

        device = "cuda" if torch.cuda.is_available() else "cpu"
        rasterizer = choose_rasterizer(scene.gaussians, device)
        surface = surface_of(scene, rasterizer)
        clock = Clock(self.fps, max(round(self.seconds * self.fps), self._first + self.frames))
        # As many as ns-train takes by default, so that training finds this motion prior in the cache.
        most = self.max_particles or (200_000 if device == "cuda" else MAX_PARTICLES)
        how = {"profile": self.physics, "everything": self.everything}
        history = motion_prior(scene, surface, effect, clock, seed=self.seed, max_particles=most, **how).to(device)
        edits = None if self.edited_images is None else edits_of(scene, self.edited_images, device, seed=self.seed)
        answer = answer_of(scene, surface, effect, seconds=self.seconds, seed=self.seed, edits=edits).to(device)
        # A field that has learned nothing hands on the simulated motion and the initial look, bit for bit.
        look, field = initial_look(effect, history, seed=self.seed), DynamicsField.for_history(history)
        look = in_place(look, history, answer, scene.frame.to_metric(scene.gaussians.means))
        rollout = Rollout(history, look, field, exposure=effect.appearance.exposure)
        cameras = cameras.to(device)

        def picture(index: int) -> Tensor:
            frame = self._first + index
            weather = scene.frame.gaussians_to_scene(rollout.gaussians(frame))
            return rasterizer.render(cameras[index], weather, None, answer.at(frame / self.fps)).rgb[0]

        return picture


def effect_told(knobs: Knobs, folder: Path) -> Effect:
    """The effect that the knobs ask for, after all has been said that is to be said about it; `folder` keeps answers."""
    with refusing(ValueError, OSError):
        knobs.judge()
        if knobs.llm is not None:
            say(f"asking {knobs.llm} what {knobs.weather!r} means")
        effect, remarks = knobs.effect_asked(folder)
    for remark in remarks:
        say(remark)
    return effect


def open_scene(path: str, data: Path | None, metres_per_unit: float | None) -> Scene:
    """`load_scene` that can also ask nerfstudio for the cameras of a run, which is imported only then (it takes seconds)."""
    from pgsd_nerfstudio.scene.loading import load_scene

    def run_cameras(config: Path) -> tuple[Cameras, tuple[Path, ...]]:
        from pgsd_nerfstudio.plugin.run_cameras import run_cameras as ask_nerfstudio

        return ask_nerfstudio(config)

    return load_scene(path, data, metres_per_unit=metres_per_unit, run_cameras=run_cameras)


def console() -> Console:
    """Where progress goes; stdout holds only the paths of what was made."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def say(line: str) -> None:
    console().print(line, style="dim", markup=False)
