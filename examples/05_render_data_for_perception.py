"""Data for perception: the same views in clear air, in fog and in rain, each with its depth.

Writes for each view and weather
    VIEW_WEATHER_rgb.png           8 bits, sRGB
    VIEW_WEATHER_depth.png         16 bits, millimetres along the camera's axis; 0 where nothing is
    VIEW_WEATHER_accumulation.png  8 bits, share of the light that comes from Gaussians; the rest is background
and once cameras.json: intrinsics in pixels, and poses (OpenCV, world to camera, metres of the metric frame).
The depth of the clear view is the truth about the scene; that of a weather has its flakes and drops in it.

    python examples/05_render_data_for_perception.py --output data
"""

import json
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

import pgsd_nerfstudio

VIEWS, WIDTH, HEIGHT = (0, 8), 480, 300


def write(picture: pgsd_nerfstudio.Picture, metres_per_unit: float, folder: Path, name: str) -> list[Path]:
    """The three files of one picture."""
    millimetres = (1000 * metres_per_unit * picture.depth).clamp(0, 65_535).round()
    accumulation = (255 * picture.accumulation).clamp(0, 255).round()
    paths = [folder / f"{name}_{kind}.png" for kind in ("rgb", "depth", "accumulation")]
    picture.save(paths[0])
    Image.fromarray(millimetres.numpy(force=True).astype(np.uint16)).save(paths[1])
    Image.fromarray(accumulation.numpy(force=True).astype(np.uint8)).save(paths[2])
    return paths


def main(output: Path = Path("perception")) -> None:
    scene = pgsd_nerfstudio.load_scene("demo")
    cameras, scale = scene.cameras.resized(WIDTH, HEIGHT), scene.frame.metres_per_unit
    weathers = {
        "fog": pgsd_nerfstudio.simulate(scene, pgsd_nerfstudio.effect("fog", intensity=40), seconds=1, max_particles=1_000),
        "rain": pgsd_nerfstudio.simulate(
            scene, pgsd_nerfstudio.effect("rainfall", intensity=20), seconds=1, max_particles=2_000
        ),
    }
    output.mkdir(parents=True, exist_ok=True)
    made = [output / "cameras.json"]
    metric = scene.frame.cameras_to_metric(cameras)
    about = {"intrinsics": {view: metric.Ks[view].tolist() for view in VIEWS}}
    about["world_to_camera"] = {view: metric.viewmats[view].tolist() for view in VIEWS}
    made[0].write_text(json.dumps(about, indent=1))
    for view in VIEWS:
        pictures = {name: weather.render(cameras[view], second=1.0) for name, weather in weathers.items()}
        pictures["clear"] = weathers["fog"].render_clear(cameras[view])
        for name, picture in pictures.items():
            made += write(picture, scale, output, f"{view:03d}_{name}")
    print(*made, sep="\n")


if __name__ == "__main__":
    tyro.cli(main)
