"""A video: rain while the camera moves slowly from one training view towards another.

A path is one camera for each frame, so that weather and camera move on together. `slow_path` chooses two views and goes from
one to the other; any other `Cameras` do as well.

Writes one second of video.

    python examples/03_a_camera_path.py --output rain.mp4
"""

from pathlib import Path

import tyro

import pgsd_nerfstudio


def main(output: Path = Path("rain.mp4")) -> None:
    scene = pgsd_nerfstudio.load_scene("demo")
    weather = pgsd_nerfstudio.simulate(scene, "rainfall", seconds=2, max_particles=3_000)
    path = pgsd_nerfstudio.slow_path(scene, frames=25, fps=weather.fps).resized(480, 300)
    pictures = weather.frames(path, start=1.0)
    pgsd_nerfstudio.write_video(output, (picture.rgb for picture in pictures), weather.fps)
    print(output)


if __name__ == "__main__":
    tyro.cli(main)
