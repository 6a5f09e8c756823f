"""The dense regime against analytic solutions, potential flow and published experiments.

Taichi starts anew for another precision, which takes seconds: what is in single precision comes first.
"""

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.laboratory.experiments import solids as cases
from pgsd_nerfstudio.laboratory.experiments.potential_flow import collapse, front, rates
from pgsd_nerfstudio.laboratory.experiments.sand import heap_slope, run_out
from pgsd_nerfstudio.laboratory.experiments.water import MARTIN_MOYCE, dam_break, dam_break_in_theory, passage
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import Elastic, Mpm, MpmConfig, Obstacle, Snow, Water

BOX = Domain((0, 0, 0), (1, 1, 1))


def cube(count: int = 500, edge: float = 0.2, at: tuple[float, float, float] = (0.4, 0.4, 0.12)) -> tuple[torch.Tensor, float]:
    draw = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, generator=draw, dtype=torch.float64) * edge + torch.tensor(at), edge**3 / count


def test_a_free_cloud_keeps_momentum_angular_momentum_and_mass_in_single_precision():
    linear, angular, lost = cases.free_cloud("f32", 10)
    assert linear < 1e-6 and angular < 1e-5 and lost == 0


def test_a_column_settles_under_its_weight():
    measured, expected = cases.hydrostatic_column(28)
    assert measured == pytest.approx(expected, rel=0.02)


def test_a_block_slides_with_coulomb_friction():
    measured, expected = cases.sliding_block(30.0, 0.3, 3)
    assert measured == pytest.approx(expected, rel=0.02)


def test_a_block_on_a_slope_below_the_friction_angle_stays():
    measured, _ = cases.sliding_block(15.0, 0.5, 3)
    assert abs(measured) < 0.05


def test_the_front_of_a_broken_dam_follows_potential_flow():
    late = [0.832, 1.4]
    fronts, (known, _) = dam_break(late, 8, 2), dam_break_in_theory(late, spacing=0.06)
    assert fronts == pytest.approx(known, rel=0.05)
    assert all(1 < z < 1 + 2 * t for z, t in zip(fronts, late, strict=True)), "ahead of Ritter's bound"


def test_water_presses_with_its_weight():
    """Mean pressure in a tank is that of half the depth."""
    dx, depth = 0.01, 0.1
    tank = Obstacle.room((0, 0, 0), (8 * dx, 8 * dx, 1), 0.0)
    mpm = Mpm(MpmConfig(dx=dx), Domain((-dx, -dx, -dx), (9 * dx, 9 * dx, 2 * depth)), tank)
    points, volume = cases.lattice((0, 0, 0), (8 * dx, 8 * dx, depth), dx / 2)
    water = Water(bulk_modulus=1e5)
    mpm.emit(points, torch.zeros_like(points), water, volume)
    pressures = []
    for k in range(12):
        mpm.step(0.01)
        if k >= 5:
            ratio = mpm.volume_ratios.double().clamp_max(1)
            pressures.append(float((water.bulk_modulus / 7 * (ratio**-7 - 1) * ratio).mean()))
    assert sum(pressures) / len(pressures) == pytest.approx(water.density * 9.81 * depth / 2, rel=0.15)


def test_single_precision_is_close_to_double():
    ends = {}
    for precision in ("f32", "f64"):
        mpm = Mpm(MpmConfig(dx=0.05, precision=precision, max_dt=2e-4), BOX, Obstacle.plane((0, 0, 0.1), (0, 0, 1)))
        points, volume = cube()
        mpm.emit(points, torch.tensor([0.0, 0.0, -2.0]).expand(500, 3), Snow(), volume)
        mpm.step(0.02)
        assert mpm.substeps >= 100
        ends[precision] = mpm.positions.double()
    assert (ends["f32"] - ends["f64"]).abs().max() < 1e-4


# Double precision


def test_a_free_cloud_keeps_momentum_angular_momentum_and_mass_in_double_precision():
    linear, angular, lost = cases.free_cloud("f64", 10)
    assert linear < 1e-13 and angular < 1e-12 and lost == 0


def test_a_spinning_ball_keeps_its_angular_momentum():
    change, gained = cases.spinning_ball("f64", 0.25)
    assert change < 1e-12
    assert -0.1 < gained <= 1e-9


def test_free_fall_is_exact_but_for_the_first_order_of_the_step():
    mpm = Mpm(MpmConfig(dx=0.05, precision="f64", max_dt=1e-3), BOX)
    points, volume = cube()
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    start = mpm.positions
    mpm.step(0.04)
    fallen = (mpm.positions - start)[:, 2]
    dt = 0.04 / mpm.substeps
    torch.testing.assert_close(fallen, torch.full_like(fallen, -0.5 * 9.81 * 0.04 * (0.04 + dt)), rtol=1e-9, atol=0)


def test_a_clamped_bar_swings_at_its_frequency():
    measured, expected = cases.elastic_bar(12, "f64")
    assert measured == pytest.approx(expected, rel=0.03)


def test_two_balls_bounce_and_keep_momentum():
    returned, drift, most = cases.colliding_balls("f64", 4)
    assert drift < 1e-13
    assert 0.6 < returned < 1.0
    assert most < 1 + 1e-6


def test_elastic_energy_turns_into_motion_and_none_is_made():
    """A stretched ball let go."""
    points, volume = cube(at=(0.4, 0.4, 0.6))
    mpm = Mpm(MpmConfig(dx=0.05, precision="f64", gravity=(0, 0, 0), max_dt=1e-4), BOX)
    stretch = 1.1 * torch.eye(3, dtype=torch.float64)
    mpm.emit(points, torch.zeros_like(points), Elastic(youngs_modulus=1e4), volume, stretch.expand(len(points), 3, 3))
    start = mpm.report()
    assert start.elastic > 0 and start.kinetic == 0
    mpm.step(4e-3)
    now = mpm.report()
    assert now.kinetic > 0.1 * start.elastic
    assert now.energy == pytest.approx(start.energy, rel=0.03)


# The judge of the water


def test_potential_flow_finds_the_velocity_of_a_known_flow():
    """phi = x^2 - y^2 between mirrors; on the surface of a column its gradient is known."""
    side = np.stack([np.ones(81), np.linspace(2, 0, 81)], 1)
    top = np.stack([np.linspace(0, 1, 41)[:-1], np.full(40, 2.0)], 1)
    surface = np.concatenate([top, side])
    velocity, _ = rates(surface, surface[:, 0] ** 2 - surface[:, 1] ** 2)
    smooth = np.r_[2:25, 60:119]  # away from the corner, where the spline of the surface rings
    np.testing.assert_allclose(velocity[smooth], surface[smooth] * [2, -2], atol=0.02)


def test_the_front_leaves_out_the_share_of_the_water_it_is_asked_to():
    """A triangle: of its area (1 - x / 2)^2 lies beyond x."""
    triangle = np.stack([np.linspace(0, 2, 200), np.linspace(1, 0, 200)], 1)
    assert front(triangle, 0.0) == 2.0
    assert front(triangle, 0.04) == pytest.approx(2 * (1 - math.sqrt(0.04)), rel=1e-3)


def test_potential_flow_begins_to_fall_as_the_fourier_series_of_a_rectangle_says():
    """The top at the back wall: the pressure is harmonic, 0 on top and face, its slope g on the floor and 0 at the wall."""
    k = (np.arange(40) + 0.5) * math.pi / 2
    acceleration = -((-1.0) ** np.arange(40) / (k * np.cosh(k))).sum()
    assert acceleration == pytest.approx(-0.89, abs=0.01)
    fallen = collapse([0.2], 2.0, 0.05)[0][0, 1] - 2
    assert fallen == pytest.approx(acceleration * 0.2**2 / 2, rel=0.03)


def test_the_front_of_potential_flow_starts_from_rest_and_stays_behind_ritters():
    """At first it moves with the square of time, and never faster than 2 sqrt(g h)."""
    fronts = [front(surface, 0.0) - 1 for surface in collapse([0.05, 0.1, 0.5, 0.6], 2.0, 0.05)]
    assert fronts[1] / fronts[0] == pytest.approx(4, rel=0.15)
    assert (fronts[3] - fronts[2]) / 0.1 < 2 * math.sqrt(2)


# Published experiments, at the resolution they need


@pytest.mark.slow
@pytest.mark.parametrize(("aspect", "cells"), [(1.0, 16), (2.0, 12)])
def test_a_column_of_sand_runs_out_as_lube_measured(aspect, cells):
    measured, known = run_out(aspect, cells)
    assert measured == pytest.approx(known, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_a_heap_comes_to_rest_at_its_angle_of_repose(degrees):
    assert heap_slope(degrees, 16) == pytest.approx(degrees, abs=3.0)


@pytest.mark.slow
def test_the_front_of_a_broken_dam_moves_as_fast_as_martin_and_moyce_measured():
    late = sorted({t for t, _ in MARTIN_MOYCE} | set(np.linspace(0.6, 4.0, 18).round(3).tolist()))
    fronts = dam_break(late, 16, 4)
    assert fronts == pytest.approx(dam_break_in_theory(late)[0], rel=0.03)
    (start, begin), (end, goal) = MARTIN_MOYCE[1], MARTIN_MOYCE[4]
    assert passage(late, fronts, begin, goal) == pytest.approx(end - start, rel=0.1)
