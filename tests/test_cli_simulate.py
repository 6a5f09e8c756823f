"""Laws of `pgsd simulate`: the report accounts for every particle and every milligram."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.effects import SNOWFALL
from pgsd_nerfstudio.effects.snowfall import fall_speed, mass
from pgsd_nerfstudio.physics import Clock, Domain, simulate_metric
from pgsd_nerfstudio.physics.record.report import report
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 3.0))


@pytest.fixture(scope="module")
def history():
    floor = torch.tensor([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
    surface = SurfaceMesh(floor, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    return simulate_metric(surface, SNOWFALL, Clock(frames=75), DOMAIN, max_particles=1500, progress=False)


def test_every_particle_and_its_mass_is_accounted_for(history):
    found = report(history, SNOWFALL.material)
    rows, about = found["per_frame"], history.about
    assert rows["resting"][-1] <= about["landed"] and rows["resting"] == sorted(rows["resting"])
    each = mass(history.diameters.double().numpy(), SNOWFALL.material) * history.represents.double().numpy()
    assert found["mass_emitted"] == pytest.approx(each.sum(), rel=1e-9)
    assert abs(found["mass_lost"]) < 1e-9 * found["mass_emitted"]
    assert rows["mass_in_air"][0] == pytest.approx(each[(history.births == 0).numpy()].sum(), rel=1e-9)
    assert found["particle_frames"] == sum(rows["in_air"])


def test_the_momentum_downwards_is_that_of_the_fall_speeds(history):
    """Turbulence without divergence hardly moves the mean: the sum of mass times terminal speed, within 3 %."""
    found = report(history, SNOWFALL.material)
    flying = history.active(40).numpy()
    diameters = history.diameters.double().numpy()[flying]
    heavy = mass(diameters, SNOWFALL.material) * history.represents.double().numpy()[flying]
    assert -found["per_frame"]["momentum"][40][2] == pytest.approx((heavy * fall_speed(diameters)).sum(), rel=0.03)
    assert found["per_frame"]["kinetic_energy"][40] > 0.5 * (heavy * fall_speed(diameters) ** 2).sum() * 0.95


def test_the_command_writes_report_and_picture(yard, tmp_path, capsys):
    ply, data = yard
    words = ["--load-scene", str(ply), "--data", str(data), "--seconds", "1", "--max-particles", "500"]
    assert run(["simulate", *words, "--output", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "out" / name) for name in ("report.json", "report.png")]
    found = json.loads((tmp_path / "out" / "report.json").read_text())
    assert found["frames"] == len(found["per_frame"]["in_air"]) == 25
    assert found["scale"]["metres_per_unit"] > 0 and found["scale"]["source"] and found["peak_memory_bytes"] > 1e7
    picture = np.asarray(Image.open(tmp_path / "out" / "report.png").convert("RGB"))
    assert picture.shape[0] > 300 and picture.std() > 5


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--seconds", "0"], "--seconds must be positive, got 0"),
        (["--effect", "hail"], "known are: "),
        (["--intensity", "-1"], "intensity must lie in"),
    ],
)
def test_bad_input_gets_one_sentence(yard, tmp_path, capsys, flags, sentence):
    ply, data = yard
    words = ["--load-scene", str(ply), "--data", str(data), "--output", str(tmp_path / "out")]
    assert run(["simulate", *words, *flags]) == 1
    assert sentence in capsys.readouterr().err
