"""Numbers instead of pictures: where the particles are, and what the weather weighs.

Everything is in metres of the metric frame (z up, ground at z = 0), kilograms and seconds. A simulated particle stands for
several real ones (`history.represents`); masses are those of the real ones.

Writes positions.csv, the places of all particles at second 3; report.json, particles, mass, momentum and energy by frame; and
a folder, from which `Weather.open` makes the same weather again, on any machine that has the scene.

    python examples/04_positions_and_reports.py --output numbers
"""

import json
from pathlib import Path

import numpy as np
import tyro

import pgsd_nerfstudio


def main(output: Path = Path("numbers")) -> None:
    scene = pgsd_nerfstudio.load_scene("demo")
    weather = pgsd_nerfstudio.simulate(scene, "snowfall", seconds=3, max_particles=3_000)
    output.mkdir(parents=True, exist_ok=True)

    places, report = output / "positions.csv", output / "report.json"
    np.savetxt(places, weather.positions(3.0).numpy(force=True), fmt="%.4f", delimiter=",", header="x,y,z", comments="")
    report.write_text(json.dumps(weather.report(), indent=1))
    folder = weather.save(output / "weather")
    again = pgsd_nerfstudio.Weather.open(folder, scene)
    assert again.positions(3.0).equal(weather.positions(3.0))
    print(places, report, folder, sep="\n")


if __name__ == "__main__":
    tyro.cli(main)
