"""Snow in the built-in courtyard: load a scene, simulate its weather, render a picture.

Writes one picture: what a camera of the scene sees after three seconds of snow.

    python examples/01_snow_on_demo.py --output snow.png
"""

from pathlib import Path

import tyro

import pgsd_nerfstudio


def main(output: Path = Path("snow.png")) -> None:
    scene = pgsd_nerfstudio.load_scene("demo")  # or a run of splatfacto, or a .ply with data=
    weather = pgsd_nerfstudio.simulate(scene, "snowfall", seconds=3, max_particles=3_000)
    print(weather.render(scene.cameras[0], second=3.0).save(output))


if __name__ == "__main__":
    tyro.cli(main)
