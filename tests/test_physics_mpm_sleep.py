"""Matter of the dense regime that comes to rest, carries what lands on it, and wakes under what falls hard."""

import math
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.laboratory.experiments.solids import snow_layer, throw_snowball
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import ACTIVE, RESTING, Mpm, MpmConfig, Obstacle, Sleep, Snow
from pgsd_nerfstudio.physics.mpm.layout import MASS, VOLUME

FLOOR = Obstacle.plane((0, 0, 0.1), (0, 0, 1))
BOX = Domain((0, 0, 0), (1, 1, 1))


def cube(count: int, edge: float, at: tuple[float, float, float]) -> tuple[torch.Tensor, float]:
    draw = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, generator=draw, dtype=torch.float64) * edge + torch.tensor(at), edge**3 / count


def test_what_lies_still_falls_asleep_and_carries_what_lands_on_it():
    mpm = Mpm(MpmConfig(dx=0.05, sleep=Sleep(speed=0.1, frames=2)), BOX, FLOOR)
    points, volume = cube(500, 0.2, (0.4, 0.4, 0.12))
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    for _ in range(12):
        mpm.step(0.04)
    report = mpm.report()
    assert report.resting > 450
    assert report.mass_active + report.mass_resting == mpm.report().mass
    top = float(mpm.positions[:, 2].max())
    points, volume = cube(100, 0.1, (0.45, 0.45, top + 0.1))
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    for _ in range(8):
        mpm.step(0.04)
    assert mpm.positions[500:, 2].mean() > top - 0.05
    mpm.wake()
    assert mpm.report().resting == 0
    assert not mpm._rest.shares.any()


def test_what_hangs_in_the_air_does_not_fall_asleep():
    mpm = Mpm(MpmConfig(dx=0.05, gravity=(0, 0, 0), sleep=Sleep(speed=1.0, frames=1, wake_speed=2.0)), BOX)
    points, volume = cube(500, 0.2, (0.4, 0.4, 0.12))
    mpm.emit(points, torch.zeros_like(points), Snow(), volume)
    for _ in range(3):
        mpm.step(0.04)
    assert (mpm.states == ACTIVE).all()


SLEEP = Sleep(speed=0.05, frames=2)
EDGE = 0.4


@pytest.fixture(scope="module")
def layer() -> tuple[Mpm, dict[str, torch.Tensor]]:
    mpm = snow_layer(SLEEP, EDGE)
    assert (mpm.states == RESTING).all()
    return mpm, mpm.snapshot()


def thrown(layer, speed: float, wake_speed: float = SLEEP.wake_speed, awake: bool = False) -> tuple[Mpm, int]:
    """The layer with a ball above it, and how many particles are the layer's."""
    mpm, rest = layer
    mpm = Mpm(replace(mpm.config, sleep=replace(SLEEP, wake_speed=wake_speed)), mpm.domain, mpm.obstacle)
    mpm.restore(rest)
    count = len(mpm)
    if awake:
        mpm.wake()
    throw_snowball(mpm, speed)
    return mpm, count


def crater(mpm: Mpm, count: int) -> tuple[float, int]:
    """How far the top of the layer sinks under the ball, in m, and the least number of the layer's particles that sleep."""
    start = mpm.positions[:count].double()
    under = ((start[:, :2] - EDGE / 2).norm(dim=1) < 0.08) & (start[:, 2] > start[:, 2].max() - 0.06)
    asleep = []
    for _ in range(2):
        mpm.step(0.04)
        asleep.append(int((mpm.states[:count] == RESTING).sum()))
    return float((start - mpm.positions[:count].double())[under, 2].mean()), min(asleep)


def test_a_snowball_wakes_the_snow_it_falls_on_and_compresses_it_like_snow_that_never_slept(layer):
    """The judge is the same fall onto the same layer, all of it awake."""
    sunk, asleep = crater(*thrown(layer, 5.0))
    known, none = crater(*thrown(layer, 5.0, awake=True))
    assert none == 0
    assert 0 < asleep < 2048, "either nothing woke, or everything did"
    assert known > 0.01
    assert 0.6 < sunk / known < 1.7


def test_what_comes_gently_does_not_wake_what_sleeps(layer):
    """The ball at 0.2 m/s: with the snow it would move at less than that."""
    sunk, asleep = crater(*thrown(layer, 0.2, wake_speed=0.4))
    assert sunk == 0 and asleep == 2048


def test_snow_that_never_wakes_is_a_floor(layer):
    sunk, asleep = crater(*thrown(layer, 5.0, wake_speed=math.inf))
    assert sunk == 0 and asleep == 2048


def test_the_volume_at_rest_is_that_of_what_rests_after_some_of_it_woke(layer):
    mpm, count = thrown(layer, 5.0)
    mpm.step(0.04)
    resting = mpm.states == RESTING
    assert 0 < resting.sum() < count
    volume, mass = (mpm._particles.state[: len(mpm), column][resting].double().sum() for column in (VOLUME, MASS))
    assert float(mpm._rest.shares[:, 0].double().sum() * mpm.config.dx**3) == pytest.approx(float(volume), rel=1e-4)
    assert float(mpm._rest.shares[:, 1].double().sum()) == pytest.approx(float(mass), rel=1e-4)
