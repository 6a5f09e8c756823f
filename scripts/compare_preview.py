"""Times `pgsd preview` of this build beside that of another one, by turns, and draws time against count.

python scripts/compare_preview.py --before other/venv/bin/pgsd --load-scene garden.ply --data data/garden

Each build has a cache folder of its own. What is timed is a command whose surface and answer are kept and whose motion is not:
CPU time, user and system, of the command and of what it starts. The error beside a time is that of the savings: what a camera
cannot show is left out and the scene is blended in one walk, against all particles in a scene that was blended alone before.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from matplotlib.figure import Figure
from rich.console import Console

from pgsd_nerfstudio.dynamics.in_sight import Eye
from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.laboratory.records import Record, print_records, write_records
from pgsd_nerfstudio.laboratory.rows.rasterizer import psnr
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.weather.loading import load_scene
from pgsd_nerfstudio.weather.making import make_weather
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.prepared_scene import prepare_scene

SIDE = 512  # pixels


@dataclass(frozen=True, kw_only=True)
class Compare:
    """What a preview costs in two builds."""

    before: Path
    """The program pgsd of the other build, in its own environment."""
    load_scene: Path
    """As for pgsd preview."""
    data: Path | None = None
    """As for pgsd preview."""
    effect: str = "snowfall"
    views: tuple[int, int] = (0, 1)
    """Training views between which the camera moves; builds may choose differently by themselves."""
    counts: tuple[int, ...] = (2_000, 20_000, 200_000)
    """Values of --max-particles."""
    seconds: float = 4.0
    """Length of the weather."""
    frames: int = 60
    """Length of the video."""
    rounds: int = 2
    """Timed runs of each command, by turns, of which the least counts; one more goes before, which fills the cache."""
    cache: Path | None = None
    """Folder in which both builds keep their caches; by default they are made and removed."""
    json: Path | None = None
    """Also write the rows here."""
    plot: Path | None = None
    """Also draw them here."""

    def run(self) -> list[Record]:
        """All rows."""
        folder = self.cache or Path(tempfile.mkdtemp())
        programs = {"before": self.before, "after": Path(sys.executable).with_name("pgsd")}
        rows: list[Record] = []
        try:
            for count in self.counts:
                least = dict.fromkeys(programs, float("inf"))
                for turn in range(self.rounds + 1):
                    for name, program in programs.items():
                        spent = self.timed(program, folder / name, count)
                        least[name] = min(least[name], spent) if turn else least[name]
                rows += self.rows_of(count, least["before"], least["after"], self.error(count))
        finally:
            if self.cache is None:
                shutil.rmtree(folder)
        return rows

    def timed(self, program: Path, cache: Path, count: int) -> float:
        """Seconds of CPU time of one preview, whose motion is simulated anew."""
        shutil.rmtree(cache / "motion", ignore_errors=True)
        cache.mkdir(parents=True, exist_ok=True)
        command = [str(program), "preview", "--load-scene", str(self.load_scene.resolve()), "--effect", self.effect]
        command += [] if self.data is None else ["--data", str(self.data.resolve())]
        command += ["--seconds", f"{self.seconds:g}", "--frames", str(self.frames), "--max-particles", str(count)]
        command += ["--views", *map(str, self.views)]
        command += ["--width", str(SIDE), "--height", str(SIDE), "--output", str(cache / f"{count}.mp4")]
        # Both keep compiled bytecode, as Python does by default.
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")}
        environment |= {"PGSD_CACHE": str(cache), "NUMBA_CACHE_DIR": str(cache / "kernels")}
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        # In the cache's folder, so that each build finds its own package and not the one of the present folder.
        subprocess.run(command, cwd=cache, env=environment, check=True, capture_output=True)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return ended.ru_utime - began.ru_utime + ended.ru_stime - began.ru_stime

    def rows_of(self, count: int, before: float, after: float, error: float) -> list[Record]:
        """Rows of one count; `error` in dB."""
        what = f"preview of {self.frames} frames of {SIDE}x{SIDE}, {self.effect}, at most {count:,} in the air"
        source = f"{self.load_scene.name}, {self.seconds:g} s; least of {self.rounds} by turns; surface and answer kept"
        paid = {"error": error, "error_unit": "dB, the savings", "source": source}
        return [
            Record(f"{what}: before", before, "s CPU", source=source),
            Record(f"{what}: after", after, "s CPU", **paid),
            Record(f"{what}: after / before", after / before, "", **paid),
        ]

    def error(self, count: int) -> float:
        """Least PSNR in dB of some frames against those of all particles in a scene that is blended alone before."""
        weather = make_weather(
            prepare_scene(load_scene(self.load_scene, self.data), "cpu"),
            effect(self.effect),
            SimulationOptions(seconds=self.seconds, max_particles=count),
        )
        path = slow_path(weather.scene, frames=3, fps=1.0, start=0, views=self.views).resized(SIDE, SIDE)
        worst, frame, rasterizer = float("inf"), weather.scene.frame, weather.prepared.rasterizer
        everybody = torch.ones(len(weather.history), dtype=torch.bool)
        for k in range(len(path)):
            at = round((k + 1) * (weather.frame_count - 1) / len(path))
            found = weather.render_frame(path[k], at).rgb
            eye = Eye.of(path[k], rasterizer.config, frame)
            particles = frame.gaussians_to_scene(weather.sequence.gaussians(at, everybody, eye))
            with torch.no_grad():
                rasterizer.render(path[k], None, None, weather.moment(at))
                expected = rasterizer.render(path[k], particles, None, weather.moment(at)).rgb[0]
            worst = min(worst, psnr(found, expected))
        return worst


def draw(rows: list[Record], counts: tuple[int, ...]) -> Figure:
    """Left: seconds against count, both builds. Right: the ratio, beside the error of the savings."""
    figure, (cost, ratio) = plt.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    for name, colour in (("before", "tab:gray"), ("after", "tab:blue")):
        cost.plot(counts, [row.value for row in rows if row.name.endswith(f": {name}")], "o-", color=colour, label=name)
    shares = [row for row in rows if row.name.endswith("after / before")]
    ratio.plot(counts, [row.value for row in shares], "o-", color="tab:blue")
    for count, row in zip(counts, shares, strict=True):
        ratio.annotate(f"{row.error:.0f} dB", (count, row.value), textcoords="offset points", xytext=(4, 6), fontsize=8)
    cost.set(xscale="log", xlabel="most particles in the air", ylabel="s of CPU time, the whole command", ylim=(0, None))
    ratio.set(xscale="log", xlabel="most particles in the air", ylabel="after / before", ylim=(0, 1.2))
    cost.legend()
    for axes in (cost, ratio):
        axes.grid(True, alpha=0.25)
    return figure


if __name__ == "__main__":
    compare = tyro.cli(Compare)
    found = compare.run()
    print_records("previews, before and after", found, Console())
    if compare.json is not None:
        write_records(compare.json, found)
    if compare.plot is not None:
        draw(found, compare.counts).savefig(compare.plot, dpi=110)
