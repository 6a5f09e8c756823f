"""`pgsd simulate`: the motion prior by itself, with a report of what happened."""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgsd_nerfstudio.cli.asked import WeatherCommand
from pgsd_nerfstudio.cli.console import say
from pgsd_nerfstudio.refusal import Refusal, refusing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Simulate(WeatherCommand):
    """Simulate a weather in a scene, physics only. Interrupted, it goes on where it was; the other commands find the result."""

    output: Path = Path("simulation")
    """Folder for report.json and report.png."""

    def run(self) -> int:
        from pgsd_nerfstudio.physics.record.report import report
        from pgsd_nerfstudio.storage import atomic_write
        from pgsd_nerfstudio.surface.mesh import surface_of
        from pgsd_nerfstudio.weather.adapting import adapted
        from pgsd_nerfstudio.weather.making import motion_of
        from pgsd_nerfstudio.weather.prepared_scene import prepare_scene

        effect = self.chosen_effect()
        try:
            self.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Refusal(f"{self.output} cannot be a folder ({error.strerror}); choose another --output") from error
        began = time.perf_counter()
        scene = self.open_scene()
        with refusing(ValueError, OSError):
            prepared = prepare_scene(scene)
            effect, said = adapted(effect, prepared)
            for remark in said:
                say(remark)
            history = motion_of(prepared, surface_of(scene, prepared.rasterizer), effect, self.simulation)
        found = report(history, effect.material)
        found["scale"] = {"metres_per_unit": scene.frame.metres_per_unit, "source": scene.frame.source}
        found["wall_seconds"] = time.perf_counter() - began
        # Kilobytes on Linux, bytes on macOS.
        found["peak_memory_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )
        paths = self.output / "report.json", self.output / "report.png"
        # Both take their names when both are whole.
        with refusing(OSError), atomic_write(paths[0]) as text, atomic_write(paths[1]) as plots:
            text.write_text(json.dumps(found, indent=1) + "\n")
            draw(found).savefig(plots, dpi=110, format="png")
        print(*paths, sep="\n")
        return 0


def draw(found: dict[str, Any]) -> Figure:
    """Counts, mass, momentum and energy over the time of a report."""
    from matplotlib.figure import Figure

    rows, seconds = found["per_frame"], [frame / found["fps"] for frame in range(found["frames"])]
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    (counts, masses), (momentum, energy) = figure.subplots(2, 2, sharex=True)
    counts.plot(seconds, rows["in_air"], label="in the air")
    counts.plot(seconds, rows["resting"], label="resting")
    counts.set_ylabel("simulated particles")
    masses.plot(seconds, rows["mass_in_air"], label="in the air")
    masses.plot(seconds, rows["mass_resting"], label="resting")
    masses.set_ylabel("mass, kg")
    for axis, name in enumerate("xyz"):
        momentum.plot(seconds, [value[axis] for value in rows["momentum"]], label=name)
    momentum.set_ylabel("momentum in the air, kg m/s")
    energy.plot(seconds, rows["kinetic_energy"], label="kinetic, in the air")
    energy.set_ylabel("energy, J")
    for axes in (counts, masses, momentum, energy):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    for axes in (momentum, energy):
        axes.set_xlabel("time, s")
    lost = f"mass emitted {found['mass_emitted']:.4g} kg, lost {found['mass_lost']:.2g} kg"
    figure.suptitle(f"{found['about'].get('effect', 'weather')}: {found['particles']:,} particles, {lost}")
    return figure
