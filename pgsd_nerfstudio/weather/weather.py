"""The weather of a scene: moving particles and the scene's answer, rendered from any camera at any second."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
from pgsd_nerfstudio.dynamics.in_sight import Eye
from pgsd_nerfstudio.dynamics.sequence import GaussianSequence
from pgsd_nerfstudio.dynamics.sparkle import Sparkle
from pgsd_nerfstudio.effects import Effect, InitialLook, initial_look
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.physics.record.report import report
from pgsd_nerfstudio.rendering.compilation import small_steps
from pgsd_nerfstudio.response.answer import Answer, Shown
from pgsd_nerfstudio.response.landed import in_place
from pgsd_nerfstudio.response.prepare import to_metric
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.picture import Picture, picture_of
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.stored import StoredWeather, open_parts, save_parts
from pgsd_nerfstudio.weather.video import write_video


@dataclass(frozen=True, eq=False, repr=False)
class Weather:
    """One weather in one scene. Frame f shows the second f / fps; seconds count from the beginning of the weather."""

    prepared: PreparedScene
    effect: Effect
    options: SimulationOptions
    history: ParticleHistory
    """The simulated motion, in metres of the metric frame (z up, ground at z = 0)."""
    answer: Answer
    """How the frozen scene looks under the weather."""
    trained: GaussianSequence | None = None
    """What training has learned to show; None: the motion as simulated, with the initial look."""

    @cached_property
    def look(self) -> InitialLook:
        """The initial look of all particles; collided ones are in the light of their place."""
        look = initial_look(self.effect, self.history, seed=self.options.seed)
        return in_place(look, self.history, self.answer, to_metric(self.scene))

    @cached_property
    def sequence(self) -> GaussianSequence:
        """What is shown of the motion: what is trained, or the simulated motion and the initial look, bit for bit."""
        if self.trained is not None:
            return self.trained
        # A field that has learned nothing adds nothing, whatever its box and its speed.
        field = DynamicsField(torch.zeros(2, 3), 1.0, self.frame_count).to(self.history.device)
        shown = self.effect.appearance
        return Rollout(self.history, self.look, field, exposure=shown.exposure, sparkle=Sparkle.of(shown.active))

    def __repr__(self) -> str:
        what = f"{self.effect.name} in {self.scene.name}, {self.frame_count / self.fps:g} s"
        return f"Weather({what}, {len(self.history):,} particles)"

    @property
    def scene(self) -> Scene:
        """The frozen scene."""
        return self.prepared.scene

    @property
    def frame_count(self) -> int:
        """Frames of the weather."""
        return self.history.frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.history.fps

    def frame_at(self, second: float) -> int:
        """The frame that is nearest to a second.

        Raises:
            ValueError: the second lies before the beginning or after the end of the weather.
        """
        end = self.frame_count / self.fps
        if not 0.0 <= second <= end:
            raise ValueError(f"this weather lasts from second 0 to {end:g}, asked for {second:g}")
        return min(round(second * self.fps), self.frame_count - 1)

    def positions(self, second: float) -> Float[Tensor, "n 3"]:
        """Where the particles are, in metres of the metric frame: the active ones, then the collided ones.

        Raises:
            ValueError: the second is outside of the weather.
        """
        return self.sequence.gaussians(self.frame_at(second)).means

    def gaussians(self, frame: int, camera: Cameras | None = None) -> Gaussians:
        """The particles of a frame as Gaussians in scene units with plain RGB: the active ones, then the collided ones.

        Args:
            frame: number of the frame.
            camera: one camera in scene units that will see them: those within its reach, and what lies behind or beside it may
                be missing. None: all particles.

        Raises:
            IndexError: there is no such frame.
            ValueError: there is not exactly one camera.
        """
        place = self.scene.frame
        eye = None if camera is None else Eye.of(camera, self.prepared.rasterizer.config, place)
        with torch.no_grad(), small_steps(3 * self.options.particles):
            return place.gaussians_to_scene(self.sequence.gaussians(frame, eye=eye))

    def moment(self, frame: int) -> Shown | None:
        """The answer of the frozen scene at a frame; None where it still looks as it was trained."""
        with small_steps(3 * len(self.scene.gaussians)):
            return self.answer.at(frame / self.fps)

    def render(self, camera: Cameras, second: float) -> Picture:
        """What a camera sees at a second.

        Args:
            camera: one camera in scene units, such as `scene.cameras[0]` (`.resized(width, height)` for another size).
            second: seconds since the beginning of the weather.

        Raises:
            ValueError: the second is outside of the weather, or there is not exactly one camera.
        """
        return self.render_frame(camera, self.frame_at(second))

    def render_frame(self, camera: Cameras, frame: int) -> Picture:
        """What a camera sees at a frame, as `render`.

        Raises:
            IndexError: there is no such frame.
            ValueError: there is not exactly one camera.
        """
        return picture_of(self.prepared, camera, self.gaussians(frame, camera), self.moment(frame))

    def render_clear(self, camera: Cameras) -> Picture:
        """What a camera sees of the scene without the weather, as it was trained.

        Raises:
            ValueError: there is not exactly one camera.
        """
        return picture_of(self.prepared, camera, None, None)

    def frames(self, cameras: Cameras, start: float = 0.0) -> Iterator[Picture]:
        """One picture for each camera, at frames that follow each other.

        Args:
            cameras: a camera path at the weather's frames per second.
            start: second of the first picture.

        Raises:
            ValueError: the path leaves the weather.
        """
        first = self.frame_at(start)
        if first + len(cameras) > self.frame_count:
            raise ValueError(
                f"{len(cameras)} pictures from second {start:g} need {first + len(cameras)} frames, "
                f"this weather has {self.frame_count}"
            )
        return (self.render_frame(cameras[k], first + k) for k in range(len(cameras)))

    def save_video(self, path: str | Path, cameras: Cameras, start: float = 0.0) -> Path:
        """Write the pictures along a camera path as an H.264 mp4; returns its path.

        Args:
            path: of the video.
            cameras: as for `frames`.
            start: as for `frames`.

        Raises:
            ValueError: the camera path leaves the weather.
            OSError: it could not be written; nothing is left behind.
        """
        write_video(path, (picture.rgb for picture in self.frames(cameras, start)), self.fps)
        return Path(path).expanduser()

    def report(self) -> dict[str, object]:
        """Counts, masses, momentum and energy by frame, as plain values for JSON; see physics.record.report."""
        return report(self.history, self.effect.material)

    def shown_by(self, sequence: GaussianSequence) -> Weather:
        """The same weather with another motion and look, such as a trained one."""
        return replace(self, trained=sequence)

    def save(self, folder: str | Path) -> Path:
        """Keep the weather in a folder: motion, answer, effect and options; the scene itself stays where it is.

        What training has learned is not in it; a run of ns-train keeps that.

        Returns:
            The folder.

        Raises:
            OSError: it could not be written.
        """
        folder = Path(folder).expanduser()
        save_parts(folder, self.scene, StoredWeather(self.effect, self.options, self.history, self.answer))
        return folder

    @staticmethod
    def open(folder: str | Path, scene: Scene, device: torch.device | str | None = None) -> Weather:
        """The weather that `save` kept, in the metric frame in which it was made; nothing is simulated.

        Args:
            folder: of `save`, or of a run of ns-train (then without what it has learned).
            scene: the scene for which it was made.
            device: cpu or cuda; by default cuda where there is one.

        Raises:
            StoredWeatherError: a file is missing or damaged, of another version, or the scene is another one.
        """
        return Weather.open_prepared(folder, prepare_scene(scene, device))

    @staticmethod
    def open_prepared(folder: str | Path, prepared: PreparedScene) -> Weather:
        """As `open`, with a scene that is on its device already; its metric frame is replaced by the stored one."""
        parts, frame = open_parts(Path(folder).expanduser(), prepared.scene)
        prepared = replace(prepared, scene=replace(prepared.scene, frame=frame))
        history = parts.history.to(prepared.device)
        answer = parts.answer.to(prepared.device).struck_by(history)
        answer = answer.beside(history.about.get("sharpness"))
        return Weather(prepared, parts.effect, parts.options, history, answer)
