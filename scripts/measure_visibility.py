"""Prints how visible each effect is at its defaults in one scene: the rows of laboratory/visibility.py.

python scripts/measure_visibility.py --load-scene garden.ply --data data/garden

`pgsd verify weather` has the same rows for the courtyard that is built in; captures lie outside of the repository.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from pgsd_nerfstudio.laboratory.records import Record, print_records, write_records
from pgsd_nerfstudio.laboratory.visibility import changed_rows, clear_row, flicker_rows
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.weather.loading import load_scene
from pgsd_nerfstudio.weather.prepared_scene import prepare_scene


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Figures of the weather in one scene."""

    load_scene: str = "demo"
    """As for pgsd preview."""
    data: Path | None = None
    """As for pgsd preview."""
    width: int = 480
    """Of the pictures, pixels."""
    instants: tuple[int, ...] = (2, 14, 24)
    """Frames over which shares of changed pixels are averaged."""
    frames: int = 12
    """Changes from frame to frame of fog and sand."""
    json: Path | None = None
    """Also write the rows here."""

    def run(self) -> list[Record]:
        """All rows."""
        prepared = prepare_scene(load_scene(self.load_scene, self.data), "cpu")
        path = slow_path(prepared.scene, frames=50)
        view = path[25]
        view = view.resized(self.width, round(self.width * view.height / view.width))
        return [
            *changed_rows(prepared, path, view, self.instants),
            *flicker_rows(prepared, path, view, self.frames),
            clear_row(prepared, path, view),
        ]


if __name__ == "__main__":
    asked = tyro.cli(Measure)
    found = asked.run()
    print_records(f"weather in {asked.load_scene}", found, Console())
    if asked.json is not None:
        write_records(asked.json, found)
