"""Standing water: where it gathers, how high it stands, and that none of it is lost."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.standing_water import DEEPEST, FILM, StandingWater
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CELL = 0.02


def _map(height, half: float = 1.0):
    at = np.arange(-half, half + CELL / 2, CELL)
    return height(*np.meshgrid(at, at, indexing="ij")), np.array([-half, -half])


def _cells(water: StandingWater):
    x, y = (water.lower[k] + CELL * np.arange(water.ground.shape[k]) for k in range(2))
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def _cone(x, y):
    return np.minimum(0.02 * np.hypot(x, y), 0.01)


def test_water_stands_in_a_cone_as_high_as_its_volume_says():
    """V = pi h^3 / (3 slope^2)."""
    water = StandingWater.on(*_map(_cone), CELL)
    assert len(water.into) == 1
    fallen = FILM + 1e-4
    pools = water.after(fallen)
    volume = 1e-4 * water.catchment[0]
    assert pools.volumes[0] == pytest.approx(volume)
    assert pools.levels[0] == pytest.approx((3 * volume * 0.02**2 / np.pi) ** (1 / 3), rel=0.05)
    depth = water.depth(pools, _cells(water))
    assert (depth[depth > 0]).sum() * CELL**2 == pytest.approx(volume, rel=1e-9)


def test_a_full_hollow_spills_into_the_next_one_downhill():
    def two(x, y):
        slope = 0.01 * x
        return slope - 0.006 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.01) - 0.006 * np.exp(-((x + 0.5) ** 2 + y**2) / 0.01)

    water = StandingWater.on(*_map(two), CELL)
    assert len(water.into) == 2
    upper, lower = np.argsort(-water.brims)
    assert water.into[upper] == lower and water.into[lower] == -1
    pools = water.after(0.05)
    alone = StandingWater.on(*_map(lambda x, y: np.where(x > 0, 0.01 * x, two(x, y))), CELL).after(0.05)
    assert pools.volumes[lower] == pytest.approx(alone.volumes[0], rel=0.05)


@pytest.mark.parametrize("millimetres", [0.0, 0.1, 1.0, 5.0, 100.0])
def test_what_has_fallen_is_held_or_has_run_off(millimetres: float):
    rng = np.random.default_rng(0)
    rough = np.repeat(np.repeat(rng.normal(0, 0.004, (20, 20)), 5, 0), 5, 1)
    rough[40:50, 10:20] = np.nan
    water = StandingWater.on(rough, np.zeros(2), CELL)
    fallen = millimetres * 1e-3
    pools = water.after(fallen)
    assert pools.held + pools.ran_off == pytest.approx(fallen * water.area, abs=1e-12)
    assert (pools.volumes >= 0).all() and pools.ran_off >= -1e-12
    assert ((water.into < 0) | (water.into > np.arange(len(water.into)))).all()


def test_deep_hollows_drain():
    water = StandingWater.on(*_map(lambda x, y: np.minimum(0.5 * np.hypot(x, y), 0.4)), CELL)
    assert water.depth(water.after(1.0), _cells(water)).max() <= DEEPEST + 1e-9


def test_a_slope_holds_none_and_a_map_without_ground_neither():
    slope = StandingWater.on(*_map(lambda x, y: 0.05 * x), CELL)
    assert len(slope.into) == 0
    assert slope.after(0.01).held == pytest.approx(FILM * slope.area)
    assert (slope.depth(slope.after(0.01), _cells(slope)) < 0).all()
    empty = StandingWater.of(SurfaceMesh.empty(), Domain((-1, -1, 0), (1, 1, 2)), unevenness=0.003)
    assert empty.area == 0 and empty.after(0.01).held == 0


def test_a_tilt_of_the_capture_does_not_empty_level_ground():
    """A floor whose up is wrong by a degree holds what a level one holds."""
    held = []
    for tilt in (0.0, 0.0175):
        corners = torch.tensor([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
        corners[:, 2] = tilt * corners[:, 0]
        floor = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
        water = StandingWater.of(floor, Domain((-2, -2, -0.3), (2, 2, 2)), unevenness=0.003)
        held.append(water.after(0.02).volumes.sum())
        assert water.level[1] == pytest.approx(tilt, abs=1e-4)
    assert held[1] == pytest.approx(held[0], rel=0.02) and held[0] > 1e-3
