"""Write a camera path for `ns-render camera-path`: a slow path between two training views while the whole weather passes.

python scripts/make_camera_path.py --load-scene demo --output path.json
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import tyro

from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.weather.loading import load_scene


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """A slow path between two training views, written for ns-render."""

    load_scene: str
    """The scene that ns-train was given."""
    data: Path | None = None
    """The data that ns-train was given."""
    output: Path = Path("camera_path.json")
    """File that the camera path is written to."""
    width: int = 544
    """Width in pixels."""
    height: int = 352
    """Height in pixels."""
    seconds: float = 10.0
    """Length of the video; the weather passes from its beginning to its end."""
    fps: int = 25
    """Frames per second."""
    views: tuple[int, int] | None = None
    """Indices of the two training views. By default two that look at the middle of the scene."""

    def write(self) -> None:
        """Write the file and print its name."""
        scene = load_scene(self.load_scene, self.data)
        frames = round(self.seconds * self.fps)
        cameras = slow_path(scene, frames=frames, fps=self.fps, views=self.views).resized(self.width, self.height)
        keys = [
            {
                "camera_to_world": pose.flatten().tolist(),
                "fov": math.degrees(2 * math.atan(self.height / (2 * float(K[1, 1])))),
                "aspect": self.width / self.height,
                "render_time": index / max(1, frames - 1),
            }
            for index, (pose, K) in enumerate(zip(cameras.opengl(), cameras.Ks, strict=True))
        ]
        path = {
            "camera_type": "perspective",
            "render_height": self.height,
            "render_width": self.width,
            "fps": self.fps,
            "seconds": self.seconds,
            "is_cycle": False,
            "camera_path": keys,
        }
        self.output.parent.mkdir(parents=True, exist_ok=True)
        self.output.write_text(json.dumps(path))
        print(self.output)


if __name__ == "__main__":
    tyro.cli(CameraPath).write()
