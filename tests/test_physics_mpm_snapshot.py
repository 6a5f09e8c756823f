"""A run of the dense regime that goes on from a snapshot is the run that was never interrupted."""

import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import RESTING, Elastic, Mpm, MpmConfig, Obstacle, Sand, Sleep, Snow, Water

FLOOR = Obstacle.plane((0, 0, 0.1), (0, 0, 1))
BOX = Domain((0, 0, 0), (1, 1, 1))
SOON = Sleep(speed=0.3, frames=2, wake_speed=0.5)


def made(obstacle: Obstacle = FLOOR, sleep: Sleep | None = SOON, **config) -> Mpm:
    return Mpm(MpmConfig(**{"dx": 0.05, "sleep": sleep, **config}), BOX, obstacle)


def pour(mpm: Mpm, seed: int, height: float, speed: float = 0.0) -> None:
    draw = torch.Generator().manual_seed(seed)
    for n, matter in enumerate((Snow(), Sand(friction_degrees=100 / 3), Water(), Elastic(youngs_modulus=1e5 / 3))):
        points = torch.rand(100, 3, generator=draw, dtype=torch.float64) * 0.15
        points += torch.tensor([0.2 + 0.3 * (n // 2), 0.2 + 0.3 * (n % 2), height])
        mpm.emit(points, torch.tensor([0.0, 0.0, -speed]).expand(100, 3), matter, 0.15**3 / 100)


def run(mpm: Mpm, steps: int) -> None:
    for _ in range(steps):
        mpm.step(0.02)


def same(a: Mpm, b: Mpm) -> bool:
    one, other = a.snapshot(), b.snapshot()
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def test_a_run_from_a_snapshot_is_bit_for_bit_the_uninterrupted_one():
    straight, again = made(), made()
    pour(straight, 1, 0.11)
    run(straight, 8)
    asleep = straight.states == RESTING
    assert asleep.any(), "nothing sleeps: the volume at rest is not tested"
    saved = straight.snapshot()
    pour(again, 3, 0.5)  # what was here before must leave no trace
    run(again, 3)
    again.restore(saved)
    assert same(straight, again) and again.seconds == straight.seconds
    woke = []
    for mpm in (straight, again):
        pour(mpm, 2, 0.3, 4.0)
        for _ in range(6):
            mpm.step(0.02)
            woke.append(int((mpm.states[: len(asleep)][asleep] != RESTING).sum()))
    assert max(woke) > 0, "nothing woke: waking is not tested"
    assert same(straight, again)
    assert again.report() == straight.report()


def test_a_snapshot_is_a_copy():
    mpm = made()
    pour(mpm, 1, 0.11)
    saved = mpm.snapshot()
    before = {key: value.clone() for key, value in saved.items()}
    run(mpm, 2)
    assert all(torch.equal(saved[key], before[key]) for key in saved)


def test_a_snapshot_of_another_setting_is_refused():
    mpm = made()
    pour(mpm, 1, 0.11)
    saved = mpm.snapshot()
    with pytest.raises(ValueError, match="fits only the setting"):
        made(dx=0.04).restore(saved)
    with pytest.raises(ValueError, match="fits only the setting"):
        made(Obstacle.plane((0, 0, 0.12), (0, 0, 1))).restore(saved)
    with pytest.raises(ValueError, match="fits only the setting"):
        made(sleep=None).restore(saved)
    with pytest.raises(ValueError, match="missing: signal"):
        made().restore({key: value for key, value in saved.items() if key != "signal"})
    with pytest.raises(ValueError, match=r"computes in torch.float32, the snapshot was taken in torch.float64"):
        made().restore({**saved, "state": saved["state"].double()})


def test_an_empty_simulation_can_be_saved_and_restored():
    mpm = made()
    mpm.restore(made().snapshot())
    assert len(mpm) == 0 and mpm.step(0.1) == 0
