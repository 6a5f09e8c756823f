"""Snow in a scene: load it, simulate its weather, render a picture.

Writes one picture: what the first camera of the scene sees after three seconds of snow. Without a scene it takes the built-in
courtyard; what was made once comes from the cache.

    python examples/01_snow.py --output snow.png
    python examples/01_snow.py --load-scene garden.ply --data data/garden --output snow.png
"""

from pathlib import Path

import tyro

import pgsd_nerfstudio


def main(load_scene: str = "demo", data: Path | None = None, seconds: float = 10.0, output: Path = Path("snow.png")) -> None:
    scene = pgsd_nerfstudio.load_scene(load_scene, data=data)
    weather = pgsd_nerfstudio.simulate(scene, pgsd_nerfstudio.effect("snowfall", intensity=2.0), seconds=seconds)
    picture = weather.render(scene.cameras[0], second=3.0)  # also picture.depth and picture.accumulation
    print(picture.save(output))


if __name__ == "__main__":
    tyro.cli(main)
