"""Makes docs/gallery: one contact sheet per effect, four times from left to right, two views, before and after training.

python scripts/make_gallery.py --load-scene garden.ply --data data/garden

Each effect is trained by `ns-train pgsd-weather` if its run is not there yet; what was made is not made again, so the script
can be interrupted. Below each other: first view before and after training, second view before and after; where nothing was
learned (the bundled prior knows only snow) before is after, and shown once.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw
from rich.console import Console

from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
from pgsd_nerfstudio.effects.effect import EFFECTS
from pgsd_nerfstudio.scene.camera_path import choose_views
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.weather.video import to_bytes

TIMES = (0.05, 0.35, 0.65, 0.95)  # of the whole weather, those of the paper's own sheets
GAP = 4  # pixels between pictures
console = Console(stderr=True, highlight=False)


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Contact sheets of all effects on one scene."""

    load_scene: str = "demo"
    """The scene, as ns-train takes it."""
    data: Path | None = None
    """The data of a .ply, as ns-train takes it."""
    effects: tuple[str, ...] = tuple(EFFECTS)
    """Which effects."""
    output: Path = Path("docs/gallery")
    """Where the sheets go."""
    runs: Path = Path("outputs/gallery")
    """Where the runs go."""
    steps: int | None = None
    """Training steps of each effect; by default what ns-train takes."""
    width: int = 320
    """Width of one picture in pixels."""
    quality: int = 82
    """Of the JPEG files."""

    def make(self) -> None:
        self.output.mkdir(parents=True, exist_ok=True)
        for name in self.effects:
            sheet = self._sheet(self._run(name))
            path = self.output / f"{Path(self.load_scene).stem}_{name}.jpg"
            sheet.save(path, quality=self.quality, optimize=True)
            console.print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")

    def _run(self, name: str) -> Path:
        """The config.yml of a trained run of an effect."""
        place = self.runs / f"{Path(self.load_scene).stem}-{name}"
        run = place / "pgsd-weather" / "gallery"
        if not (run / "finished").exists():
            shutil.rmtree(run, ignore_errors=True)
            # The one beside this Python, whether or not its folder is on the PATH.
            train = str(Path(sys.executable).with_name("ns-train"))
            words = [train, "pgsd-weather", "--load-scene", self.load_scene, "--effect", name]
            words += [] if self.steps is None else ["--steps", str(self.steps)]
            words += [] if self.data is None else ["--data", str(self.data)]
            words += ["--output-dir", str(self.runs), "--experiment-name", place.name, "--timestamp", "gallery"]
            subprocess.run(words, check=True)
            (run / "finished").touch()
        return run / "config.yml"

    def _sheet(self, config: Path) -> Image.Image:
        from nerfstudio.utils.eval_utils import eval_setup

        _, pipeline, _, _ = eval_setup(config)
        model = pipeline.model
        scene, history = model.prepared.scene, model.history
        exposure = model.config.options.chosen_effect().appearance.exposure
        untrained = Rollout(history, model.rollout.look, DynamicsField.for_history(history), exposure=exposure)
        learned = not model.rollout.field.still() or any(bool(p.any()) for p in model.look.parameters())
        rows = []
        for view in choose_views(scene.cameras, scene.frame):
            camera = scene.cameras[view]
            camera = camera.resized(self.width, round(self.width * camera.height / camera.width)).to(model.device)
            rows.append([self._picture(model, camera, untrained, share) for share in TIMES])
            if learned:
                rows.append([self._picture(model, camera, model.rollout, share) for share in TIMES])
        return self._joined(rows, model.config.options.simulation.seconds, learned)

    def _picture(self, model, camera: Cameras, rollout: Rollout, share: float) -> np.ndarray:  # type: ignore[no-untyped-def]
        frame = model.frame_at(share)
        weather = model.prepared.scene.frame.gaussians_to_scene(rollout.gaussians(frame))
        with torch.no_grad():
            return to_bytes(model.render(camera, weather, None, model.answer, frame).rgb[0])

    def _joined(self, rows: list[list[np.ndarray]], seconds: float, learned: bool) -> Image.Image:
        height, width = rows[0][0].shape[:2]
        size = (len(TIMES) * (width + GAP) - GAP, len(rows) * (height + GAP) - GAP)
        sheet = Image.new("RGB", size, (255, 255, 255))
        pen = ImageDraw.Draw(sheet)
        for i, row in enumerate(rows):
            for j, picture in enumerate(row):
                corner = (j * (width + GAP), i * (height + GAP))
                sheet.paste(Image.fromarray(picture), corner)
                said = f"{TIMES[j] * seconds:.1f} s" + (", after training" if learned and i % 2 else "")
                pen.text((corner[0] + 6, corner[1] + 4), said, fill="white", stroke_width=2, stroke_fill="black")
        return sheet


if __name__ == "__main__":
    tyro.cli(Gallery).make()
