"""`pgsd render`: a video of a trained run at the weather's own rate, and of runs from elsewhere without running their files."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgsd_nerfstudio.cli.console import console, say
from pgsd_nerfstudio.cli.picture_size import check_size, even_size
from pgsd_nerfstudio.cli.video_file import check_name, make_folder, writing
from pgsd_nerfstudio.refusal import refusing

if TYPE_CHECKING:
    from torch import Tensor

    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.weather.weather import Weather


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a trained run as a video that every player shows (H.264, 4:2:0, even sizes).

    By default each frame of the weather is shown once, at its own rate; along a camera path the whole weather passes. Unlike
    ns-render it runs nothing that the run's config.yml names, and knows the times of a path also where only its keyframes have
    them."""

    load_config: Path
    """The config.yml of the run, or its folder."""
    camera_path: Path | None = None
    """A camera path, as ns-viewer draws it and pgsd path writes it; by default slowly from one training view to another."""
    output: Path = Path("render.mp4")
    """Where the video goes."""
    width: int | None = None
    """Width in pixels; by default in the shape of the camera path or of the training views."""
    height: int | None = None
    """Height in pixels; as --width."""

    def run(self) -> int:
        from rich.progress import track

        from pgsd_nerfstudio.plugin.saved_run import open_run
        from pgsd_nerfstudio.weather.video import write_video

        check_name(self.output)
        check_size(self.width, self.height)
        make_folder(self.output)
        began = time.perf_counter()
        say(f"opening {self.load_config}")
        with refusing(ValueError):
            weather = open_run(self.load_config)
            cameras, frames, fps = self._path(weather)
            cameras = cameras.resized(*even_size(cameras, self.width, self.height))
        shown = track(range(len(frames)), "rendering", console=console(), transient=True)

        def picture(index: int) -> Tensor:
            return weather.render_frame(cameras[index], frames[index]).rgb

        with writing(self.output):
            write_video(self.output, map(picture, shown), fps)
        say(f"{len(frames)} frames at {fps:g} per second, rendered in {time.perf_counter() - began:.0f} s")
        print(self.output)
        return 0

    def _path(self, weather: Weather) -> tuple[Cameras, list[int], float]:
        """Cameras, the frame of the weather that each sees, and pictures per second."""
        from pgsd_nerfstudio.scene.camera_path import slow_path
        from pgsd_nerfstudio.scene.path_file import read_camera_path
        from pgsd_nerfstudio.scene.path_times import path_times

        count = weather.frame_count
        if self.camera_path is None:
            return slow_path(weather.scene, frames=count, fps=weather.fps), list(range(count)), weather.fps
        path = read_camera_path(self.camera_path)
        found = path_times(path.times, seconds=count / weather.fps, frames=count)
        if found.remark is not None:
            say(found.remark)
        frames = [round(moment * (count - 1)) for moment in found.times]
        return path.cameras, frames, len(frames) / path.seconds
