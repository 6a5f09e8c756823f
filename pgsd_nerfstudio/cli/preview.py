"""`pgsd preview`: what a weather looks like in a scene before anything is trained."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pgsd_nerfstudio.cli.asked import WeatherCommand
from pgsd_nerfstudio.cli.console import console, say
from pgsd_nerfstudio.cli.picture_size import check_size, even_size
from pgsd_nerfstudio.cli.video_file import check_name, make_folder, writing
from pgsd_nerfstudio.refusal import Refusal, refusing
from pgsd_nerfstudio.weather.options import FLAT, AnswerOptions

if TYPE_CHECKING:
    from torch import Tensor

    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.weather.weather import Weather

LONGEST = 640  # pixels of the longer side, where nothing is asked for


@dataclass(frozen=True, kw_only=True)
class Preview(WeatherCommand):
    """Show a weather in a scene without training: simulated motion, initial look, as an mp4 and a picture beside it."""

    answer: Annotated[AnswerOptions, FLAT] = field(default_factory=AnswerOptions)
    output: Path = Path("preview.mp4")
    """Where the video goes; its last frame goes beside it as .png."""
    frames: int = 50
    """Length of the video in frames; a weather that has fewer is shown as a whole."""
    width: int | None = None
    """Width in pixels; by default the shape of the training views, with 640 pixels on the longer side. What does not fit a
    shape that is given is cropped."""
    height: int | None = None
    """Height in pixels; as --width."""
    start: float | None = None
    """First second to show; by default the last ones are shown, when the most has gathered."""
    views: tuple[int, int] | None = None
    """Numbers of the two training views between which the camera moves; chosen by itself if not given."""

    def run(self) -> int:
        from rich.progress import track

        from pgsd_nerfstudio.scene.camera_path import slow_path
        from pgsd_nerfstudio.weather.making import make_weather
        from pgsd_nerfstudio.weather.prepared_scene import prepare_scene
        from pgsd_nerfstudio.weather.video import write_picture, write_video

        self._check()
        began = time.perf_counter()
        effect = self.chosen_effect()
        scene = self.open_scene()
        with refusing(ValueError):
            path = slow_path(scene, frames=self._shown, fps=self.simulation.fps, start=self._first, views=self.views)
        make_folder(self.output)
        with refusing(OSError, ValueError):  # a full disk while caching, edited pictures that do not fit
            seen = None if self.simulation.everything else path
            images = self.answer.edited_images
            weather = make_weather(prepare_scene(scene), effect, self.simulation, path=seen, edited_images=images)
        cameras = path.resized(*self._size(path))
        if not _meets_particles(weather, cameras):
            say(
                "the camera keeps away from the air in which particles are simulated, at most 20 x 20 m: it shows what they "
                "cover and none of them falling; choose other --views, or see whether --metres-per-unit is right"
            )

        def picture(index: int) -> Tensor:
            return weather.render_frame(cameras[index], self._first + index).rgb

        shown = track(range(self._shown), "rendering", console=console(), transient=True)
        poster = self.output.with_suffix(".png")
        with writing(self.output):
            write_video(self.output, (picture(index) for index in shown), self.simulation.fps)
            write_picture(poster, picture(self._shown - 1))
        say(f"{self._shown} frames in {time.perf_counter() - began:.0f} s")
        print(self.output, poster, sep="\n")
        return 0

    def _check(self) -> None:
        if not self.frames > 0:
            raise Refusal(f"--frames must be positive, got {self.frames:g}")
        check_size(self.width, self.height)
        check_name(self.output)
        if self.start is not None and not self.start >= 0:
            raise Refusal(f"--start must not be negative, got {self.start:g} s")
        with refusing(ValueError):
            self.answer.check()
            self.simulation.check()
        simulation = self.simulation
        if self._first + self._shown > simulation.frames:
            raise Refusal(
                f"{self._shown} frames from --start {self.start:g} s go beyond the end of the weather at "
                f"{simulation.seconds:g} s: use more --seconds or fewer --frames"
            )
        if self._shown < self.frames:
            say(f"the weather has {simulation.frames} frames: the video shows all of them, not {self.frames}")

    def _size(self, cameras: Cameras) -> tuple[int, int]:
        """Width and height of the pictures."""
        width, height = self.width, self.height
        if width is None and height is None:
            width, height = (LONGEST, None) if cameras.width >= cameras.height else (None, LONGEST)
        return even_size(cameras, width, height)

    @property
    def _shown(self) -> int:
        """Frames of the video: as many as asked for and as the weather has."""
        return min(self.frames, self.simulation.frames)

    @property
    def _first(self) -> int:
        """The first frame of the weather that is shown."""
        if self.start is not None:
            return round(self.start * self.simulation.fps)
        return self.simulation.frames - self._shown


def _meets_particles(weather: Weather, cameras: Cameras) -> bool:
    """Whether a camera comes so near to the simulated air that particles are seen."""
    from pgsd_nerfstudio.physics.clock import SIGHT, Domain

    bounds = weather.history.about["domain"]
    centers = weather.scene.frame.to_metric(cameras.centers).double().numpy(force=True)
    return bool((Domain(tuple(bounds[:3]), tuple(bounds[3:])).distances(centers) < SIGHT).any())
