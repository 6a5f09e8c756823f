"""A weather of your own: a built-in effect with other numbers.

An Effect is a frozen dataclass of numbers with units; `dataclasses.replace` changes some of them. Here snow becomes the embers
of a fire at night: few and orange, carried by a gusty wind, gone where they land. Its name is new, and files bear it.

Writes two pictures of the same view: clear.png without weather, embers.png with it.

    python examples/02_your_own_effect.py --output embers
"""

from dataclasses import replace
from pathlib import Path

import tyro

import pgsd_nerfstudio

ORANGE = (1.0, 0.55, 0.15)


def embers() -> pgsd_nerfstudio.Effect:
    """Embers in the night."""
    snow = pgsd_nerfstudio.effect("snowfall", intensity=1.0, exposure=1 / 50)
    assert snow.haze is not None and snow.ambience is not None
    return replace(
        snow,
        name="embers",
        wind=replace(snow.wind, speed=2.0, gustiness=0.8, turbulence=0.6, flutter=0.4),  # m/s
        surface=replace(snow.surface, landing="vanishes"),
        appearance=replace(snow.appearance, active=replace(snow.appearance.active, rgb=ORANGE, opacity=0.95)),
        haze=replace(snow.haze, rgb=(0.10, 0.06, 0.05)),
        ambience=replace(snow.ambience, stops=-2.5, sky=(0.05, 0.05, 0.08), tint=(1.0, 0.85, 0.75)),
        prompt="Glowing embers fly through {scene} at night. Photorealistic, high detail",
    )


def main(output: Path = Path("embers")) -> None:
    scene = pgsd_nerfstudio.load_scene("demo")
    weather = pgsd_nerfstudio.simulate(scene, embers(), seconds=2, max_particles=2_000)
    camera = scene.cameras[0]
    print(weather.render_clear(camera).save(output / "clear.png"))
    print(weather.render(camera, second=2.0).save(output / "embers.png"))


if __name__ == "__main__":
    tyro.cli(main)
