"""Wetness: the heat kernel, decay, a closed balance of water, linear functions kept by interpolation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.special import ive

import pgsd_nerfstudio.physics.ground.wetness as module
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid, Wetting
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

WETTING = Wetting(cell=0.05, diffusivity=2e-4, drying_seconds=math.inf)
MIDDLE = np.array([[0.8, 0.8, 0.8]])


def block(wetting: Wetting = WETTING, cells: int = 33) -> WetnessGrid:
    """A full cube of cells."""
    return WetnessGrid(np.ones([cells + 2 * wetting.reach] * 3, bool), np.zeros(3), wetting)


def floor_and_table() -> WetnessGrid:
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([4 * corners, 0.6 * corners + torch.tensor([0, 0, 0.75])])
    mesh = SurfaceMesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32))
    return WetnessGrid.of(mesh, Domain((-1.5, -1.5, -0.2), (1.5, 1.5, 2.0)), Wetting(diffusivity=2e-4))


@pytest.mark.parametrize("seconds", [0.04, 1.0, 30.0])
def test_a_drop_of_water_spreads_to_a_variance_of_2_d_t_along_each_axis(seconds):
    grid = block()
    grid.deposit(MIDDLE, np.array([1e-3]))
    grid.step(seconds)
    away = grid.centres - MIDDLE
    mean = grid.water @ away / grid.held
    variance = grid.water @ away**2 / grid.held
    np.testing.assert_allclose(mean, 0.0, atol=1e-12)
    np.testing.assert_allclose(variance, 2 * 2e-4 * seconds, rtol=1e-6)


def test_the_spread_drop_is_the_discrete_gaussian():
    """Lindeberg 1990: exp(-t) I_n(t) along each axis, t in squares of a cell."""
    grid = block()
    grid.deposit(MIDDLE, np.array([1.0]))
    grid.step(20.0)
    t = 2 * 2e-4 * 20.0 / 0.05**2
    line = ive(np.abs(np.arange(33) - 16), t)
    expected = (line[:, None, None] * line[:, None] * line).ravel()
    np.testing.assert_allclose(grid.water, expected, atol=1e-12)


def test_steps_may_have_any_length_on_a_surface_with_edges():
    """Against the dense exponential of the heat equation on cells that stand side by side, in one step and in many."""
    plate = np.zeros((11, 11, 11), bool)  # with a cell more on each side
    plate[1:6, 1:5, 3] = True
    wetting = replace(WETTING, reach=1, drying_seconds=120.0)
    one, many = (WetnessGrid(plate, np.zeros(3), wetting) for _ in range(2))
    for grid in (one, many):
        grid.deposit(np.array([[0.11, 0.02, 0.1], [0.2, 0.15, 0.12]]), np.array([1e-3, 2e-3]))
    centres = one.centres
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    side_by_side = (np.abs(distance - 0.05) < 1e-6).astype(float)
    flow = 2e-4 / 0.05**2 * (side_by_side - np.diag(side_by_side.sum(1)))
    expected = expm(100.0 * flow) @ one.water * math.exp(-100 / 120)
    one.step(100.0)
    for _ in range(40):
        many.step(2.5)
    np.testing.assert_allclose(one.water, expected, rtol=1e-9)
    np.testing.assert_allclose(many.water, expected, rtol=1e-9)


def test_surfaces_dry_by_the_exponential_law():
    grid = block(replace(WETTING, drying_seconds=60.0))
    grid.deposit(MIDDLE, np.array([2e-3]))
    for _ in range(90):
        grid.step(1.0)
    assert grid.held == pytest.approx(2e-3 * math.exp(-90 / 60), rel=1e-9)


def test_no_water_is_lost_or_made():
    grid, rng = floor_and_table(), np.random.default_rng(0)
    given = missed = 0.0
    for frame in range(100):
        points = rng.uniform([-1.6, -1.6, -0.05], [1.6, 1.6, 0.05], (500, 3))
        points[::3, 2] += 0.75
        mass = rng.uniform(0, 1e-6, 500)
        given += mass.sum()
        missed += grid.deposit(points, mass)
        grid.step(0.04 * (1 + frame % 3))
        assert grid.water.min() >= 0
    assert 0 < missed < 0.5 * given
    assert grid.deposited == pytest.approx(given - missed, rel=1e-9)
    assert grid.held + grid.evaporated == pytest.approx(grid.deposited, rel=1e-9)
    assert grid.evaporated > 0.01 * grid.deposited


def test_water_stays_near_the_surface_and_does_not_cross_the_air():
    grid = floor_and_table()
    grid.deposit(np.array([[0.0, 0.0, 0.75]]), np.array([1e-3]))
    grid.step(300.0)
    assert grid.sample(np.array([[0.0, 0.0, 0.75]]))[0] > 0
    assert grid.water[grid.centres[:, 2] < 0.5].sum() == 0.0
    assert grid.sample(np.array([[0.0, 0.0, 0.4], [0.0, 0.0, 50.0], [math.nan, 0.0, 0.0]])).tolist() == [0.0, 0.0, 0.0]


def test_interpolation_keeps_linear_functions_and_deposits_keep_their_centre():
    grid, rng = block(cells=9), np.random.default_rng(1)
    slope, offset = np.array([2.0, -3.0, 0.5]), 4.0
    grid.water = (grid.centres @ slope + offset) * 0.05**3
    points = rng.uniform(0.0, 0.4, (300, 3))
    np.testing.assert_allclose(grid.sample(points), points @ slope + offset, rtol=1e-12)
    grid.water[:] = 0.0
    mass = rng.uniform(size=300)
    grid.deposit(points, mass)
    np.testing.assert_allclose(grid.water @ grid.centres / grid.held, mass @ points / mass.sum(), rtol=1e-12)


def test_at_the_edge_of_the_band_a_constant_stays_a_constant():
    grid = floor_and_table()
    grid.water[:] = 3.0 * 0.05**3
    points = np.array([[0.0, 0.0, 0.09], [0.0, 0.0, 0.12], [0.68, 0.68, 0.74], [1.5, 1.5, 0.0]])
    np.testing.assert_allclose(grid.sample(points), 3.0, rtol=1e-12)


def test_memory_follows_the_area():
    grid = floor_and_table()
    assert len(grid) < 0.35 * np.prod(grid.shape)
    assert grid.bytes / len(grid) < 50


def test_nothing_to_wet_takes_no_water():
    grid = WetnessGrid.of(SurfaceMesh.empty(), Domain((0, 0, 0), (1, 1, 1)))
    assert len(grid) == 0
    assert grid.deposit(np.full((2, 3), 0.5), np.array([1.0, 2.0])) == 3.0
    grid.step(1.0)
    assert grid.sample(np.full((2, 3), 0.5)).tolist() == [0.0, 0.0]
    assert grid.deposited == grid.held == grid.evaporated == 0.0


def test_bad_settings_are_refused(monkeypatch):
    with pytest.raises(ValueError, match=r"drying_seconds > 0, got 0\.05 m, 2, 2e-05 m"):
        Wetting(drying_seconds=0.0)
    monkeypatch.setattr(module, "MAX_CELLS", 1000)
    with pytest.raises(ValueError, match=r"at most 1,000 cells, 0\.05 m make [\d,]+; take larger cells"):
        floor_and_table()
