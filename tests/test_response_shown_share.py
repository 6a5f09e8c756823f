"""The haze beside the particles that are shown: nothing of it is lost, and nothing is counted twice."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import FOG, RAINFALL, SNOWFALL
from pgsd_nerfstudio.physics.air.reach import shown
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.populations import integral
from pgsd_nerfstudio.response.haze_field import HazeField, areas_in_air, full_extinction
from pgsd_nerfstudio.scene.frame import Frame

BOX = Domain((-5.0, -5.0, 0.0), (5.0, 5.0, 4.0))
FRAME = Frame(2.0, torch.eye(3), torch.zeros(3))  # 2 m to a unit
VIEW, LENS = torch.eye(4), (torch.tensor([[400.0, 0, 200], [0, 400, 150], [0, 0, 1]]), 400, 300)


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL], ids=lambda e: e.name)
@pytest.mark.parametrize("sharpness", [300.0, 2500.0])
def test_particles_and_haze_take_together_what_all_of_the_weather_takes(effect, sharpness):
    """By a fine sum over distance: areas of what is shown, and the optical depth of the haze."""
    haze = HazeField.of(effect, FRAME, BOX).beside(effect, sharpness).at(0.0)
    assert haze is not None
    diameters, areas = areas_in_air(effect)
    simulated = (diameters >= effect.emission.smallest) & (diameters <= effect.emission.largest)
    for metres in (0.5, 3.0, 12.0, 60.0):
        steps = (np.arange(400) + 0.5) / 400 * metres
        drawn = sum(integral(areas * simulated * shown(sharpness * diameters, at), diameters) for at in steps) * metres / 400
        point = torch.tensor([[0.0, 0.0, metres / 2.0]])
        found = float(haze.optical_depth(point, VIEW, *LENS)[0])
        assert found + drawn == pytest.approx(metres * full_extinction(effect), rel=2e-3)
    near = float(haze.optical_depth(torch.tensor([[0.0, 0.0, 0.1]]), VIEW, *LENS)[0]) / 0.2
    assert near < 0.75 * full_extinction(effect)  # before the lens almost all is drawn


def test_what_is_thinned_alike_everywhere_leaves_the_haze_as_it_is():
    plain = HazeField.of(SNOWFALL, FRAME, BOX)
    assert plain.beside(SNOWFALL, None).shown is None
    assert HazeField.of(FOG, FRAME, BOX).beside(FOG, 1000.0).shown is None


def test_another_sharpness_is_another_haze():
    keys = {HazeField.of(SNOWFALL, FRAME, BOX).beside(SNOWFALL, value).key(1.0) for value in (None, 500.0, 1000.0)}
    assert len(keys) == 3


def test_the_air_of_a_background_counts_as_that_of_a_point_there():
    haze = HazeField.of(replace(SNOWFALL, haze=SNOWFALL.haze), FRAME, BOX).beside(SNOWFALL, 2000.0).at(0.0)
    assert haze is not None
    depth = float(haze.optical_depth(torch.tensor([[0.0, 0.0, 25.0]]), VIEW, *LENS)[0])
    assert 0 < depth < 50 * full_extinction(SNOWFALL)
    assert math.isfinite(depth)
