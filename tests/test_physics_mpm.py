"""The dense regime against analytic solutions and published experiments, and where it must refuse or survive."""

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import (
    ACTIVE,
    REMOVED,
    RESTING,
    Elastic,
    Mpm,
    MpmConfig,
    Obstacle,
    Sand,
    Sleep,
    Snow,
    Unstable,
    Water,
)
from pgsd_nerfstudio.physics.mpm import experiments as cases
from pgsd_nerfstudio.physics.mpm.experiments_sand import heap_slope, run_out

FLOOR = Obstacle.plane((0, 0, 0.1), (0, 0, 1))
BOX = Domain((0, 0, 0), (1, 1, 1))
MATTER = (Water(), Elastic(), Snow(), Sand())


def names(matter) -> str:
    return matter.name


def heap(count: int = 500, edge: float = 0.2, at: tuple[float, float, float] = (0.4, 0.4, 0.12)) -> tuple[torch.Tensor, float]:
    """Random points in a cube, and the volume of each."""
    draw = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, generator=draw, dtype=torch.float64) * edge + torch.tensor(at), edge**3 / count


def dropped(matter, *, obstacle: Obstacle | None = FLOOR, velocity: float = 0.0, **config) -> Mpm:
    """A cube above a floor."""
    mpm = Mpm(MpmConfig(**{"dx": 0.05, **config}), BOX, obstacle)
    points, volume = heap()
    down = torch.zeros_like(points)
    down[:, 2] = -velocity
    mpm.emit(points, down, matter, volume)
    return mpm


# Laws


def test_a_free_cloud_keeps_momentum_angular_momentum_and_mass_in_double_precision():
    linear, angular, lost = cases.free_cloud("f64", 10)
    assert linear < 1e-13 and angular < 1e-12 and lost == 0


def test_a_free_cloud_keeps_momentum_angular_momentum_and_mass_in_single_precision():
    linear, angular, lost = cases.free_cloud("f32", 10)
    assert linear < 1e-6 and angular < 1e-5 and lost == 0


def test_a_spinning_ball_keeps_its_angular_momentum():
    change, gained = cases.spinning_ball("f64", 0.5)
    assert change < 1e-12
    assert -0.1 < gained <= 1e-9


def test_free_fall_is_exact_but_for_the_first_order_of_the_step():
    mpm = dropped(Snow(), obstacle=None, precision="f64", max_dt=1e-3)
    start = mpm.positions
    mpm.step(0.04)
    fallen = (mpm.positions - start)[:, 2]
    dt = 0.04 / mpm.substeps
    torch.testing.assert_close(fallen, torch.full_like(fallen, -0.5 * 9.81 * 0.04 * (0.04 + dt)), rtol=1e-9, atol=0)


def test_a_clamped_bar_swings_at_its_frequency():
    measured, expected = cases.elastic_bar(20, "f64")
    assert measured == pytest.approx(expected, rel=0.03)


def test_a_column_settles_under_its_weight():
    measured, expected = cases.hydrostatic_column(28)
    assert measured == pytest.approx(expected, rel=0.02)


def test_two_balls_bounce_and_keep_momentum():
    returned, drift, most = cases.colliding_balls("f64", 6)
    assert drift < 1e-13
    assert 0.7 < returned < 1.0
    assert most < 1 + 1e-6


def test_a_block_slides_with_coulomb_friction():
    measured, expected = cases.sliding_block(30.0, 0.3)
    assert measured == pytest.approx(expected, rel=0.02)


def test_a_block_on_a_slope_below_the_friction_angle_stays():
    measured, _ = cases.sliding_block(15.0, 0.5)
    assert abs(measured) < 0.05


def test_water_presses_with_its_weight():
    """Mean pressure in a tank is that of half the depth."""
    dx, depth = 0.01, 0.1
    tank = Obstacle.room((0, 0, 0), (8 * dx, 8 * dx, 1), 0.0)
    mpm = Mpm(MpmConfig(dx=dx), Domain((-dx, -dx, -dx), (9 * dx, 9 * dx, 2 * depth)), tank)
    points, volume = cases.lattice((0, 0, 0), (8 * dx, 8 * dx, depth), dx / 2)
    water = Water(bulk_modulus=1e5)
    mpm.emit(points, torch.zeros_like(points), water, volume)
    pressures = []
    for k in range(20):
        mpm.step(0.01)
        if k >= 5:
            ratio = mpm.volume_ratios.double().clamp_max(1)
            pressures.append(float((water.bulk_modulus / 7 * (ratio**-7 - 1) * ratio).mean()))
    assert sum(pressures) / len(pressures) == pytest.approx(water.density * 9.81 * depth / 2, rel=0.15)


def test_no_water_is_ahead_of_ritters_bound():
    for late, front, _ in cases.dam_break(6):
        assert 1 < front < 1 + 2 * late


def test_the_same_input_gives_the_same_bits():
    ends = []
    for _ in range(2):
        mpm = dropped(Snow(), velocity=2.0)
        mpm.step(0.04)
        ends.append(mpm.positions)
    assert torch.equal(*ends)


def test_single_precision_is_close_to_double():
    ends = {}
    for precision in ("f32", "f64"):
        mpm = dropped(Snow(), velocity=2.0, precision=precision, max_dt=2e-4)
        mpm.step(0.02)
        assert mpm.substeps >= 100
        ends[precision] = mpm.positions.double()
    assert (ends["f32"] - ends["f64"]).abs().max() < 1e-4


# Kernels against their plain form


@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_scattering_with_atomics_as_on_the_gpu_gives_the_same(matter):
    ends = []
    for atomic in (False, True):
        mpm = dropped(matter, velocity=2.0, precision="f64")
        mpm._atomic = atomic
        mpm.step(0.02)
        ends.append(mpm.positions)
    torch.testing.assert_close(*ends, atol=1e-9, rtol=0)


def test_singular_values_are_those_of_numpy():
    """Also of nearly the identity, whose products vanish in single precision, and of a mirrored matrix."""
    import taichi as ti

    from pgsd_nerfstudio.physics.mpm.constitutive import assembled, singular_values
    from pgsd_nerfstudio.physics.mpm.runtime import start

    @ti.kernel
    def decompose(f: ti.types.ndarray(ndim=3), out: ti.types.ndarray(ndim=2)):
        for n in range(f.shape[0]):
            m = ti.Matrix([[f[n, i, j] for j in ti.static(range(3))] for i in ti.static(range(3))])
            u, values, v = singular_values(m)
            again = assembled(u, values, v)
            for i in ti.static(range(3)):
                out[n, i] = values[i]
                for j in ti.static(range(3)):
                    out[n, 3 + 3 * i + j] = again[i, j]

    rng = np.random.default_rng(0)
    hard = np.eye(3) + np.array([[0, 1e-25, 1e-3], [0, 0, 0], [0, 0, 0]])
    flat = np.diag([1.0, 1.0, 1e-3])
    matrices = np.concatenate(
        [np.eye(3) + 0.4 * rng.normal(size=(200, 3, 3)), [np.eye(3), hard, flat, np.diag([1.0, 1.0, -0.5])]]
    )
    for precision, tolerance in (("f64", 1e-9), ("f32", 2e-5)):
        start("cpu", precision)
        dtype = np.float64 if precision == "f64" else np.float32
        out = np.zeros((len(matrices), 12), dtype)
        decompose(matrices.astype(dtype), out)
        assert np.isfinite(out).all()
        values = np.sort(np.abs(out[:, :3]), 1)
        np.testing.assert_allclose(values, np.sort(np.linalg.svd(matrices)[1], 1), atol=tolerance)
        np.testing.assert_allclose(out[:, 3:].reshape(-1, 3, 3), matrices, atol=tolerance)
        assert (np.sign(out[:, :3].prod(1)) == np.sign(np.linalg.det(matrices))).all()


def test_stress_is_the_slope_of_energy():
    """The work of gravity turns into kinetic and elastic energy, none is made: a swinging elastic ball."""
    mpm = dropped(Elastic(youngs_modulus=1e4), precision="f64", obstacle=None, gravity=(0, 0, 0), max_dt=1e-4)
    stretch = torch.eye(3, dtype=torch.float64) * 1.1
    points, volume = heap(at=(0.4, 0.4, 0.6))
    mpm = Mpm(mpm.config, BOX)
    mpm.emit(points, torch.zeros_like(points), Elastic(youngs_modulus=1e4), volume, stretch.expand(len(points), 3, 3))
    start = mpm.report()
    assert start.elastic > 0 and start.kinetic == 0
    mpm.step(4e-3)
    now = mpm.report()
    assert now.kinetic > 0.1 * start.elastic
    assert now.energy == pytest.approx(start.energy, rel=0.03)


def test_an_obstacle_on_a_grid_acts_like_the_analytic_one():
    axis = torch.linspace(0, 1, 41, dtype=torch.float64)
    z = torch.meshgrid(axis, axis, axis, indexing="ij")[2]
    normal = torch.zeros(*z.shape, 3, dtype=torch.float64)
    normal[..., 2] = 1
    sampled = Obstacle.from_grid(z - 0.1, normal, (0, 0, 0), 1 / 40)
    ends = []
    for obstacle in (FLOOR, sampled):
        mpm = dropped(Snow(), obstacle=obstacle, velocity=1.0, precision="f64")
        mpm.step(0.05)
        ends.append(mpm.positions)
    torch.testing.assert_close(*ends, atol=1e-6, rtol=0)


# Materials


@pytest.mark.parametrize("make", [Elastic, Snow, Sand])
@pytest.mark.parametrize(
    "numbers",
    [
        {"poisson": 0.5},
        {"poisson": 0.7},
        {"poisson": -0.1},
        {"youngs_modulus": -1.0},
        {"youngs_modulus": math.nan},
        {"density": 0},
    ],
)
def test_impossible_materials_are_refused(make, numbers):
    with pytest.raises(ValueError, match=r"must (lie in|be positive)"):
        make(**numbers)


def test_hardening_of_snow_is_bounded_on_both_sides():
    mpm = dropped(Snow(), velocity=20.0)
    mpm.step(0.04)
    ratios = mpm.volume_ratios
    assert ratios.min() >= 0.6 - 1e-6 and ratios.max() <= 1.5 + 1e-6
    assert ratios.min() < 0.95, "the impact has compressed nothing"


def test_water_stays_within_its_volume():
    mpm = dropped(Water(), velocity=5.0)
    mpm.step(0.04)
    assert mpm.volume_ratios.min() >= 0.8 - 1e-6 and mpm.volume_ratios.max() <= 1.02 + 1e-6


@pytest.mark.parametrize("factor", [0.01, 1.0, 1000.0])
@pytest.mark.parametrize("make", [Elastic, Snow, Sand])
def test_any_stiffness_runs_or_is_refused_with_its_cause(make, factor):
    base = make()
    matter = make(youngs_modulus=base.youngs_modulus * factor, poisson=0.49)
    mpm = dropped(matter, velocity=1.0, max_substeps=600)
    try:
        mpm.step(0.01)
    except Unstable as refusal:
        assert factor == 1000.0
        assert "sound travels at" in str(refusal) and matter.name in str(refusal)
    assert mpm.positions.isfinite().all()


# Hard cases


@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_a_step_that_is_far_too_long_is_divided(matter):
    mpm = dropped(matter, velocity=1.0, max_dt=100 * 0.05 / 50)
    assert mpm.step(0.01) > 1
    assert mpm.positions.isfinite().all()
    assert mpm.report().removed == 0


@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_ten_thousand_particles_in_one_cell(matter):
    mpm = Mpm(MpmConfig(dx=0.05), BOX, FLOOR)
    points, volume = heap(10_000, 0.05, (0.4, 0.4, 0.3))
    mpm.emit(points, torch.zeros_like(points), matter, volume)
    mpm.step(0.005)
    assert mpm.report().active == 10_000
    assert mpm.velocities.norm(dim=1).max() < 1.0


@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_nothing_passes_a_thin_plate_at_300_m_per_second(matter):
    plate = Obstacle.box((0.0, 0.0, 0.4), (1.0, 1.0, 0.5))
    mpm = Mpm(MpmConfig(dx=0.05), BOX, plate)
    points, volume = heap(300, 0.2, (0.4, 0.4, 0.7))
    velocity = torch.zeros_like(points)
    velocity[:, 2] = -300.0
    mpm.emit(points, velocity, matter, volume)
    mpm.step(0.003)
    here = mpm.states != REMOVED
    assert here.any()
    assert mpm.positions[here, 2].min() > 0.5 - 1e-4


@pytest.mark.parametrize("size", [1e-3, 1e4])
@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_domains_of_a_millimetre_and_of_ten_kilometres(size, matter):
    domain = Domain((0, 0, 0), (size, size, size))
    mpm = Mpm(MpmConfig(dx=size / 20), domain, Obstacle.plane((0, 0, 0.1 * size), (0, 0, 1)))
    points, volume = heap(500, 0.2, (0.4, 0.4, 0.12))
    mpm.emit(points * size, torch.zeros_like(points), matter, volume * size**3)
    mpm.step(1e-3 * size)
    assert mpm.positions.isfinite().all()
    assert mpm.report().mass == pytest.approx(matter.density * (0.2 * size) ** 3, rel=1e-5)


def test_without_gravity_nothing_starts_to_move():
    mpm = dropped(Sand(), gravity=(0, 0, 0))
    start = mpm.positions
    mpm.step(0.04)
    assert torch.equal(mpm.positions, start)


def test_what_is_emitted_in_a_wall_comes_out_or_is_counted():
    mpm = Mpm(MpmConfig(dx=0.05), BOX, FLOOR)
    points, volume = heap(100, 0.2, (0.4, 0.4, 0.0))
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    mpm.step(0.02)
    report = mpm.report()
    assert report.active == 100
    assert mpm.positions[mpm.states == ACTIVE, 2].min() > 0.1 - 1e-5
    assert mpm.velocities.norm(dim=1).max() < 5.0


def test_what_leaves_the_domain_is_removed_and_counted():
    mpm = dropped(Snow(), obstacle=None)
    mass = mpm.report().mass
    for _ in range(12):
        mpm.step(0.04)
    report = mpm.report()
    assert report.removed == 500 and report.active == 0
    assert report.mass_removed == pytest.approx(mass, rel=1e-6)
    assert mpm.step(1.0) == 0


def test_too_many_substeps_are_refused_before_anything_moves():
    mpm = dropped(Snow(), velocity=50.0, max_substeps=3)
    start = mpm.positions
    with pytest.raises(Unstable, match=r"needs \d+ substeps .* because a particle of snow moves at 50 m/s"):
        mpm.step(0.04)
    assert torch.equal(mpm.positions, start)


def test_a_quantity_that_is_not_finite_is_named():
    mpm = dropped(Snow())
    mpm._particles.state[7, 3] = math.nan
    with pytest.raises(FloatingPointError, match=r"the (position|velocity) of \d+ particles \(first: \d+\) is not finite at"):
        mpm.step(0.01)


def test_bad_emission_and_grids_are_refused():
    mpm = Mpm(MpmConfig(dx=0.05), BOX)
    one = torch.full((1, 3), 0.5)
    with pytest.raises(ValueError, match="velocities must be finite"):
        mpm.emit(one, one * math.inf, Snow(), 1e-6)
    with pytest.raises(ValueError, match="volumes must be positive"):
        mpm.emit(one, one, Snow(), 0.0)
    with pytest.raises(ValueError, match="grid nodes"):
        Mpm(MpmConfig(dx=0.05), Domain((0, 0, 0), (1e4, 1e4, 1e4)))
    with pytest.raises(ValueError, match="dx must be positive"):
        MpmConfig(dx=-1.0)


# Rest


def test_what_lies_still_falls_asleep_and_carries_what_lands_on_it():
    mpm = dropped(Snow(), sleep=Sleep(speed=0.05, frames=3))
    for _ in range(25):
        mpm.step(0.04)
    report = mpm.report()
    assert report.resting > 450
    assert report.mass_active + report.mass_resting == pytest.approx(report.mass, rel=1e-6)
    top = float(mpm.positions[:, 2].max())
    points, volume = heap(100, 0.1, (0.45, 0.45, top + 0.1))
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    for _ in range(15):
        mpm.step(0.04)
    assert mpm.positions[500:, 2].mean() > top - 0.05
    mpm.wake()
    assert mpm.report().resting == 0


def test_what_hangs_in_the_air_does_not_fall_asleep():
    mpm = dropped(Snow(), obstacle=None, gravity=(0, 0, 0), sleep=Sleep(speed=1.0, frames=1))
    for _ in range(3):
        mpm.step(0.04)
    assert (mpm.states == ACTIVE).all() and not (mpm.states == RESTING).any()


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
def test_water_is_less_than_a_fifth_ahead_of_martin_and_moyce():
    """10 % are not met: without friction at the floor the front is 6 to 16 % ahead."""
    for _, front, known in cases.dam_break(10):
        assert known < front < 1.2 * known
