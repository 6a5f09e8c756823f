"""`pgsd path`: a camera path for ns-render, along which the whole weather passes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from pgsd_nerfstudio.cli.console import say
from pgsd_nerfstudio.cli.picture_size import check_size, even_size
from pgsd_nerfstudio.refusal import Refusal, refusing
from pgsd_nerfstudio.weather.options import FLAT, MOST_FRAMES, SceneOptions

if TYPE_CHECKING:
    from pgsd_nerfstudio.scene.cameras import Cameras
    from pgsd_nerfstudio.scene.scene import Scene

LONGEST = 960  # pixels of the longer side, where nothing is asked for


@dataclass(frozen=True, kw_only=True)
class PathCommand:
    """Write a camera path for ns-render camera-path and pgsd render; the weather passes along it once, from beginning to
    end. The viewer loads it too, from the folder camera_paths of a run."""

    kind: tyro.conf.Positional[Literal["orbit", "interpolate", "dolly", "still"]]
    """orbit: around the middle of the scene. interpolate: from one training view to another. dolly: straight ahead from a view.
    still: a view that stays."""
    scene: Annotated[SceneOptions, FLAT] = field(default_factory=SceneOptions)
    output: Path = Path("camera_path.json")
    """File that the path is written to."""
    seconds: float = 10.0
    """Length of the video; that of the weather lets it pass at its own rate."""
    fps: float = 25.0
    """Pictures per second."""
    width: int | None = None
    """Width in pixels; by default the shape of the training views, at most 960 pixels on the longer side."""
    height: int | None = None
    """Height in pixels."""
    views: tuple[int, int] | None = None
    """interpolate: numbers of the two training views; by default two that look at the middle of the scene, so slow a path that
    it may end before the second."""
    view: int | None = None
    """dolly, still: number of the training view; by default one that looks at the middle of the scene."""
    degrees: float = 360.0
    """orbit: by how much it turns, against the clock as seen from above; negative: with it."""
    forward: float = 0.3
    """dolly: how far it goes, as a part of the way to the middle of the scene; negative: backwards."""

    def run(self) -> int:
        from pgsd_nerfstudio.scene.path_file import write_camera_path

        frames = self._frames()
        with refusing(ValueError, OSError):
            self.scene.check()
            scene = self.scene.open()
        for remark in scene.remarks:
            say(remark)
        with refusing(ValueError):
            cameras = self._cameras(scene, frames)
            cameras = cameras.resized(*even_size(cameras, self.width, self.height, LONGEST))
        with refusing(OSError):
            write_camera_path(self.output, cameras, self.fps)
        say(f"{frames} frames of {cameras.width}x{cameras.height}, {self.seconds:g} s; the whole weather passes along the path")
        print(self.output)
        return 0

    def _frames(self) -> int:
        for name in ("seconds", "fps"):
            value = getattr(self, name)
            if not 0 < value < float("inf"):
                raise Refusal(f"--{name} must be positive, got {value:g}")
        check_size(self.width, self.height)
        if self.seconds * self.fps > MOST_FRAMES:
            raise Refusal(
                f"--seconds {self.seconds:g} at --fps {self.fps:g} are more than {MOST_FRAMES:,} frames: use less of either"
            )
        return max(1, round(self.seconds * self.fps))

    def _cameras(self, scene: Scene, frames: int) -> Cameras:
        from pgsd_nerfstudio.scene.camera_path import dolly_path, orbit_path, slow_path, still_path

        if self.kind == "orbit":
            return orbit_path(scene, frames=frames, degrees=self.degrees)
        if self.kind == "dolly":
            return dolly_path(scene, frames=frames, forward=self.forward, view=self.view)
        if self.kind == "still":
            return still_path(scene, frames=frames, view=self.view)
        return slow_path(scene, frames=frames, fps=self.fps, views=self.views)
