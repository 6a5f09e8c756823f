"""Times the motion prior of this build beside that of another one, by turns, on the demo or a scene of your own.

python scripts/compare_motion.py --before other/venv/bin/python
python scripts/compare_motion.py --before other/venv/bin/python --load-scene garden.ply --data data/garden --memory

Both builds get the same surface, domain and cameras and simulate in processes of their own. What counts is the least CPU time
of several runs by turns, per particle and frame, setup included. Dense matter is left out; it has rows of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console

from pgsd_nerfstudio.laboratory.records import Record, print_records, write_records
from pgsd_nerfstudio.laboratory.rows.motion_costs import CASES, SECONDS
from pgsd_nerfstudio.physics import domain_of
from pgsd_nerfstudio.physics.ground.lowest import down_to_ground
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.surface.mesh import surface_of
from pgsd_nerfstudio.weather.loading import load_scene

RUN = """
import json, resource, sys, time
from dataclasses import replace
import numpy as np, torch
try:
    from pgsd_nerfstudio.effects import effect
    from pgsd_nerfstudio.physics import simulate_metric as simulate
except ImportError:  # names of 0.1
    from pgsd_nerfstudio.physics import simulate
    from pgsd_nerfstudio.weather import effect
from pgsd_nerfstudio.physics import Clock, Domain
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

case, name, count, frames, seen = np.load(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5] == "seen"
cameras = Cameras(*(torch.from_numpy(case[key]) for key in ("viewmats", "Ks")), int(case["width"]), int(case["height"]))
domain, light = Domain(tuple(case["lower"].tolist()), tuple(case["upper"].tolist())), replace(effect(name), dense=None)

def run(count, frames):
    surface = SurfaceMesh(torch.from_numpy(case["vertices"]), torch.from_numpy(case["triangles"]))
    began = time.process_time(), time.perf_counter()
    history = simulate(
        surface, light, Clock(frames=frames), domain, max_particles=count, cameras=cameras if seen else None, progress=False
    )
    return time.process_time() - began[0], time.perf_counter() - began[1], history.positions.shape[0]

run(300, 3)  # compiles
spent, wall, rows = run(count, frames)
print(json.dumps([spent, wall, rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]))
"""


@dataclass(frozen=True, kw_only=True)
class Compare:
    """What the motion prior costs in two builds."""

    before: Path
    """The interpreter of the other build, in its own environment."""
    load_scene: Path | None = None
    """As for pgsd preview; by default the demo."""
    data: Path | None = None
    """As for pgsd preview."""
    rounds: int = 3
    """Runs of each case, by turns, of which the least counts."""
    seconds: float = SECONDS
    """Length of the weather."""
    seen: bool = False
    """Simulate what the scene's cameras see rather than everything. The builds may differ in what that is."""
    memory: bool = False
    """Also simulate 10 s of rain with 500,000 in the air in this build, and print the most memory that the process had."""
    json: Path | None = None
    """Also write the rows here."""

    def run(self) -> list[Record]:
        """All rows."""
        rows: list[Record] = []
        with tempfile.TemporaryDirectory() as folder:
            where = self.loaded_from
            case = self.case(Path(folder))
            for name, count in CASES:
                found: dict[str, list[list[float]]] = {"before": [], "after": []}
                for _ in range(self.rounds):
                    for build, python in (("before", self.before), ("after", Path(sys.executable))):
                        found[build].append(self.simulated(python, case, name, count, round(25 * self.seconds)))
                costs = {build: min(1e9 * spent / total for spent, _, total, _ in runs) for build, runs in found.items()}
                what = f"motion prior, {name}, {count:,} in the air"
                for build, runs in found.items():
                    wall = min(1e9 * wall / total for _, wall, total, _ in runs)
                    source = f"{where}, {self.seconds:g} s, {runs[0][2]:,.0f} rows, {wall:.0f} ns by the clock"
                    rows.append(Record(f"{what}: {build}", costs[build], "ns CPU per particle and frame", source=source))
                source = f"{where}, least of {self.rounds} by turns"
                rows.append(Record(f"{what}: after / before", costs["after"] / costs["before"], "", source=source))
            if self.memory:
                spent, _, total, most = self.simulated(Path(sys.executable), case, "rainfall", 500_000, 250)
                source = f"{where}, {total:,.0f} rows, {spent:.0f} s CPU; interpreter and libraries included"
                name = "motion prior, rainfall, 500,000 in the air, 250 frames: memory"
                rows.append(Record.judged(name, most / 2**20, "GiB", "<= 8", source=source))
        return rows

    @property
    def loaded_from(self) -> str:
        """Name of the scene."""
        return "demo" if self.load_scene is None else self.load_scene.name

    def case(self, folder: Path) -> Path:
        """File of the surface, domain and cameras, which both builds read."""
        scene = demo_scene() if self.load_scene is None else load_scene(self.load_scene, self.data)
        surface = surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), progress=False)
        domain, cameras = down_to_ground(domain_of(scene), surface), scene.frame.cameras_to_metric(scene.cameras)
        file = folder / "case.npz"
        np.savez(
            file,
            vertices=surface.vertices.numpy(),
            triangles=surface.triangles.numpy(),
            lower=domain.lower,
            upper=domain.upper,
            viewmats=cameras.viewmats.numpy(),
            Ks=cameras.Ks.numpy(),
            width=cameras.width,
            height=cameras.height,
        )
        return file

    def simulated(self, python: Path, case: Path, name: str, count: int, frames: int) -> list[float]:
        """CPU seconds, seconds by the clock, rows, and most memory in KiB of one simulation in a process of its own."""
        command = [str(python.absolute()), "-c", RUN, str(case), name, str(count), str(frames), "seen" if self.seen else "all"]
        # In a folder of their own, so that each build finds its own package and not the one of the present folder. Both keep
        # compiled bytecode, as Python does by default.
        left_out = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
        environment = {key: value for key, value in os.environ.items() if key not in left_out}
        done = subprocess.run(command, cwd=case.parent, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{python} could not simulate {name}:\n{done.stderr}")
        return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    chosen = tyro.cli(Compare)
    found = chosen.run()
    print_records("motion prior, before and after", found, Console())
    if chosen.json is not None:
        write_records(chosen.json, found)
