"""Makes docs/gallery and the picture at the top of the README: contact sheets of all effects with their defaults, untrained.

python scripts/make_gallery.py --load-scene garden.ply --data data/garden
python scripts/make_gallery.py --load-scene demo --poster docs/images/poster.png

One sheet per effect: four moments from left to right; below each other the effect's default intensity, another one, and a
weather in words. Only what the one view sees is simulated, so that motions are not those of other commands.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image, ImageDraw
from rich.console import Console

from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.scene.camera_path import choose_views
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.weather.loading import load_scene
from pgsd_nerfstudio.weather.making import make_weather
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.video import to_bytes
from pgsd_nerfstudio.weather.weather import Weather

TIMES = (0.05, 0.35, 0.65, 0.95)  # of the whole weather, those of the publication's own sheets
SHOWN: dict[str, tuple[tuple[str, EffectOptions], ...]] = {
    "snowfall": (
        ("1.5 mm/h", EffectOptions(effect="snowfall")),
        ("4 mm/h", EffectOptions(effect="snowfall", intensity=4.0)),
        ('"purple snow"', EffectOptions(weather="purple snow")),
    ),
    "rainfall": (
        ("20 mm/h", EffectOptions(effect="rainfall")),
        ("50 mm/h", EffectOptions(effect="rainfall", intensity=50.0)),
        ('"drizzle"', EffectOptions(weather="drizzle")),
    ),
    "fog": (
        ("as far as the scene's background asks", EffectOptions(effect="fog")),
        ("twice as dense", EffectOptions(effect="fog", amount=2.0)),
        ('"magic particles"', EffectOptions(weather="magic particles")),
    ),
    "sandstorm": (
        ("as far as the scene's background asks", EffectOptions(effect="sandstorm")),
        ("half as dense", EffectOptions(effect="sandstorm", amount=0.5)),
        ('"yellow sand"', EffectOptions(weather="yellow sand")),
    ),
}
"""Rows of each sheet: what stands on the first picture, and the weather."""
GAP = 4  # pixels between pictures
POSTER = 960  # pixels
console = Console(stderr=True, highlight=False)


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Contact sheets of all effects on one scene."""

    load_scene: str = "demo"
    """The scene, as pgsd preview takes it."""
    data: Path | None = None
    """The data of a splat, as pgsd preview takes it."""
    effects: tuple[str, ...] = tuple(SHOWN)
    """Which effects."""
    seconds: float = 10.0
    """Length of each weather in seconds."""
    output: Path = Path("docs/gallery")
    """Where the sheets go."""
    width: int = 320
    """Width of one picture in pixels."""
    quality: int = 82
    """Of the JPEG files."""
    poster: Path | None = None
    """Where a large picture of the default snow goes; by default none is made."""

    def make(self) -> None:
        self.output.mkdir(parents=True, exist_ok=True)
        scene = load_scene(self.load_scene, self.data)
        prepared, view = prepare_scene(scene), scene.cameras[choose_views(scene.cameras, scene.frame)[0]]
        for name in self.effects:
            rows = []
            for said, options in SHOWN[name]:
                weather = self._weather(prepared, options, view)
                rows.append((said, [self._picture(weather, view, share) for share in TIMES]))
                if self.poster is not None and options == EffectOptions(effect="snowfall"):
                    _picture(weather, view, TIMES[-1] * self.seconds, POSTER).save(self.poster)
            path = self.output / f"{Path(self.load_scene).stem}_{name}.jpg"
            self._sheet(rows).save(path, quality=self.quality, optimize=True)
            console.print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")

    def _weather(self, prepared: PreparedScene, options: EffectOptions, view: Cameras) -> Weather:
        effect, remarks = options.resolve()
        for remark in remarks:
            console.print(remark, style="dim", markup=False)
        return make_weather(prepared, effect, SimulationOptions(seconds=self.seconds), path=view)

    def _picture(self, weather: Weather, view: Cameras, share: float) -> Image.Image:
        return _picture(weather, view, share * self.seconds, self.width)

    def _sheet(self, rows: list[tuple[str, list[Image.Image]]]) -> Image.Image:
        width, height = rows[0][1][0].size
        sheet = Image.new("RGB", (len(TIMES) * (width + GAP) - GAP, len(rows) * (height + GAP) - GAP), (255, 255, 255))
        pen = ImageDraw.Draw(sheet)
        for i, (said, pictures) in enumerate(rows):
            for j, picture in enumerate(pictures):
                corner = (j * (width + GAP), i * (height + GAP))
                sheet.paste(picture, corner)
                text = f"{TIMES[j] * self.seconds:.1f} s" + ("" if j else f", {said}")
                pen.text((corner[0] + 6, corner[1] + 4), text, fill="white", stroke_width=2, stroke_fill="black")
        return sheet


def _picture(weather: Weather, view: Cameras, second: float, width: int) -> Image.Image:
    camera = view.resized(width, round(width * view.height / view.width))
    return Image.fromarray(to_bytes(weather.render(camera, second).rgb))


if __name__ == "__main__":
    tyro.cli(Gallery).make()
