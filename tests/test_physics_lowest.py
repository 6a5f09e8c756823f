"""The air reaches down to low ground, is as it was over level ground, and is not deepened by strays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.physics.clock import Clock, Domain
from pgsd_nerfstudio.physics.ground.lowest import DEEPEST, ROOM, down_to_ground
from pgsd_nerfstudio.physics.metric import simulate_metric
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.3), (2.0, 2.0, 2.0))
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def ground(*squares: tuple[float, float, float, float]) -> SurfaceMesh:
    """Level squares that face up: from x to x, half width along y, height."""
    vertices = [torch.tensor([[a, -b, z], [c, -b, z], [c, b, z], [a, b, z]]) for a, c, b, z in squares]
    return SurfaceMesh(torch.cat(vertices), torch.cat([FACES + 4 * k for k in range(len(squares))]))


@pytest.mark.parametrize("height", [0.0, -0.08, 1.5])
def test_over_level_ground_nothing_changes(height):
    assert down_to_ground(DOMAIN, ground((-5, 5, 5, height))) == DOMAIN


def test_the_air_reaches_below_a_terrace_to_the_lawn():
    found = down_to_ground(DOMAIN, ground((-5, 1, 5, 0.0), (1, 5, 5, -0.9)))
    assert found.lower == pytest.approx((-2.0, -2.0, -0.9 - ROOM)) and found.upper == DOMAIN.upper


def test_strays_and_abysses_do_not_deepen_it():
    assert down_to_ground(DOMAIN, ground((-5, 5, 5, 0.0), (0.0, 0.04, 0.02, -3.0))) == DOMAIN
    assert down_to_ground(DOMAIN, ground((-5, 1, 5, 0.0), (1, 5, 5, -2 * DEEPEST))) == DOMAIN
    assert down_to_ground(DOMAIN, SurfaceMesh.empty()) == DOMAIN
    high = Domain((-2.0, -2.0, 5.0), (2.0, 2.0, 30.0))  # around a drone
    assert down_to_ground(high, ground((-5, 5, 5, 0.0))) == high
    ceiling = ground((-5, 5, 5, -1.0))
    assert down_to_ground(DOMAIN, replace(ceiling, triangles=ceiling.triangles[:, [0, 2, 1]])) == DOMAIN  # it faces down


def test_flakes_land_on_a_lawn_below_the_terrace_as_on_the_terrace():
    steps = ground((-5, 0, 5, 0.0), (0, 5, 5, -0.9))
    still = effect("snowfall")
    still = replace(still, wind=replace(still.wind, speed=0.0, turbulence=0.0, gustiness=0.0))
    domain = down_to_ground(DOMAIN, steps)
    run = simulate_metric(steps, still, Clock(25.0, 75), domain, max_particles=1500, progress=False)
    last = run.positions[(run.offsets[1:] - 1)[run.collided]]
    low, high = (last[:, 2] < -0.85).sum(), (last[:, 2] > -0.05).sum()
    assert low > 200 and float(low / high) == pytest.approx(1.0, abs=0.2)
