"""Where the dense regime must refuse or survive: stiffness, speed, thin plates, crowds, domains of any size."""

import math

import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import (
    ACTIVE,
    REMOVED,
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


def test_the_same_input_gives_the_same_bits():
    ends = []
    for _ in range(2):
        mpm = dropped(Snow(), velocity=2.0)
        mpm.step(0.04)
        ends.append(mpm.positions)
    assert torch.equal(*ends)


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


@pytest.mark.parametrize("offset", [0.0, 0.4, 0.7])
@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_nothing_passes_a_plate_of_two_cells_at_300_m_per_second(matter, offset):
    """Wherever the plate lies between the nodes."""
    bottom = 0.4 + offset * 0.05
    mpm = Mpm(MpmConfig(dx=0.05), BOX, Obstacle.box((0.0, 0.0, bottom), (1.0, 1.0, bottom + 0.1)))
    points, volume = heap(300, 0.2, (0.4, 0.4, 0.7))
    velocity = torch.zeros_like(points)
    velocity[:, 2] = -300.0
    mpm.emit(points, velocity, matter, volume)
    mpm.step(0.003)
    here = mpm.states != REMOVED
    assert here.any()
    assert mpm.positions[here, 2].min() > bottom + 0.1 - 1e-4


def test_a_plate_of_less_than_two_cells_is_refused_and_holds_when_grown():
    plate = Obstacle.box((0.0, 0.0, 0.4), (1.0, 1.0, 0.46))
    with pytest.raises(
        ValueError, match=r"two cells thick, here 0.1 m.* has 0.06 m: use dx <= 0.03 m, or Obstacle.grown\(0.02\)"
    ):
        Mpm(MpmConfig(dx=0.05), BOX, plate)
    mpm = Mpm(MpmConfig(dx=0.05), BOX, plate.grown(0.02))
    points, volume = heap(300, 0.2, (0.4, 0.4, 0.7))
    mpm.emit(points, torch.tensor([0.0, 0.0, -300.0]).expand(300, 3), Sand(), volume)
    mpm.step(0.003)
    assert mpm.positions[mpm.states != REMOVED, 2].min() > 0.48 - 1e-4


@pytest.mark.parametrize("degrees", [0.0, 30.0])
def test_a_sheet_without_an_inside_holds_when_grown_by_a_cell(degrees):
    """A table that was seen from above only: distances are positive on both of its sides."""
    axis = torch.linspace(0, 1, 101, dtype=torch.float64)
    x, _, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    normal = torch.tensor([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))], dtype=torch.float64)
    height = (x - 0.5) * normal[0] + (z - 0.463) * normal[2]
    sheet = Obstacle.from_grid(height.abs(), height.sign()[..., None] * normal, (0, 0, 0), 0.01, thickness=0.0)
    with pytest.raises(ValueError, match="thinnest plate has 0 m"):
        Mpm(MpmConfig(dx=0.05), BOX, sheet)
    mpm = Mpm(MpmConfig(dx=0.05), BOX, sheet.grown(0.05))
    points, volume = heap(300, 0.2, (0.4, 0.4, 0.7))
    mpm.emit(points, -300.0 * normal.expand(300, 3), Water(), volume)
    mpm.step(0.003)
    here = mpm.positions[mpm.states != REMOVED].double() - torch.tensor([0.5, 0.0, 0.463])
    assert len(here) and (here @ normal).min() > 0.05 - 2e-3


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
    with pytest.raises(ValueError, match=r"the wake speed must exceed the speed of falling asleep, got 0.01 and 0.02 m/s"):
        Sleep(wake_speed=0.01)
    with pytest.raises(ValueError, match="grows by a finite length of 0 or more, got -1 m"):
        FLOOR.grown(-1.0)
