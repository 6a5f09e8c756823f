"""Caught mass and share of the sky against view factors and the geometry of slanted rain."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.physics.laws.populations import fall_speed, number_density
from pgsd_nerfstudio.response.exposure import Exposure, arrivals
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CALM = replace(effect("rainfall"), wind=replace(effect("rainfall").wind, speed=0.0, turbulence=0.0, gustiness=0.0))


def quad(corners: list[tuple[float, float, float]]) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]])


def mesh(*quads) -> SurfaceMesh:
    vertices = torch.cat([v for v, _ in quads])
    return SurfaceMesh(vertices, torch.cat([t + 4 * k for k, (_, t) in enumerate(quads)]).int())


GROUND = quad([(-20.0, -20, 0), (20, -20, 0), (20, 20, 0), (-20, 20, 0)])


def flat_at(points: torch.Tensor) -> Gaussians:
    n = len(points)
    scales = torch.tensor([0.02, 0.02, 0.002]).expand(n, 3)
    return Gaussians(points, torch.tensor([1.0, 0, 0, 0]).expand(n, 4), scales, torch.ones(n), torch.full((n, 3), 0.5))


def test_open_ground_catches_all_and_sees_all_of_the_sky():
    found = Exposure.of(flat_at(torch.tensor([[0.3, 0.2, 0.0], [3.0, -1.0, 0.01]])), mesh(GROUND), effect("snowfall"))
    assert found.catches == pytest.approx([1.0, 1.0], abs=1e-5)
    assert found.sky == pytest.approx([1.0, 1.0], abs=0.09)
    assert not found.loose.any() and found.level.min() > 0.99


@pytest.mark.parametrize("height", [0.5, 1.0, 2.0])
def test_a_square_roof_takes_its_view_factor_from_the_sky(height: float):
    side = 1.0  # half of the roof's
    roof = quad([(-side, -side, height), (-side, side, height), (side, side, height), (side, -side, height)])
    points = torch.tensor([[0.001 * k, 0.0, 0.0] for k in range(8)])
    shares = [Exposure.of(flat_at(points), mesh(GROUND, roof), CALM, seed=seed).sky.mean() for seed in range(6)]
    # View factor of a small area to a parallel rectangle above its corner, four of them (Howell, catalog B-3).
    x = side / height
    corner = 2 * x / math.sqrt(1 + x * x) * math.atan(x / math.sqrt(1 + x * x)) / (2 * math.pi)
    assert np.mean(shares) == pytest.approx(1 - 4 * corner, abs=0.05)


def test_nothing_falls_under_a_roof_in_still_air():
    roof = quad([(-1.0, -1, 1.0), (-1, 1, 1), (1, 1, 1), (1, -1, 1)])
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, 0], [0.9, 0.9, 0], [1.1, 0, 0]])), mesh(GROUND, roof), CALM)
    assert found.catches.tolist() == [0.0, 0.0, pytest.approx(1.0, abs=1e-5)]


def test_a_wall_catches_what_the_wind_drives_against_it_and_its_lee_nothing():
    windy = replace(CALM, wind=replace(CALM.wind, speed=4.0, direction_degrees=0.0))
    west = quad([(0.0, -3, 0), (0, -3, 3), (0, 3, 3), (0, 3, 0)])  # its open side looks to -x, against the wind
    east = quad([(0.3, -3, 0), (0.3, 3, 0), (0.3, 3, 3), (0.3, -3, 3)])
    house = mesh(GROUND, west, east)
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, 1.5], [0.3, 0, 1.5]])), house, windy)
    emission, material = windy.emission, windy.material
    d = np.geomspace(emission.smallest, emission.largest, 4000)
    mass = number_density(d, emission, material) * material.mass(d)
    slowness = np.trapz(mass, d) / np.trapz(mass * fall_speed(d, material), d)  # mean of 1 / speed, by flux
    assert found.normals[:, 0] == pytest.approx([-1.0, 1.0], abs=1e-5)
    assert found.catches[0] == pytest.approx(4.0 * slowness, rel=0.05)
    assert found.catches[1] == 0


def test_the_underside_of_a_thin_sheet_catches_nothing():
    """Open below, so that no shelter could do it: what comes from above hits the other side."""
    sheet = quad([(-1.0, -1, 2.0), (-1, 1, 2), (1, 1, 2), (1, -1, 2)])  # its open side looks down
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, 2.0]])), mesh(sheet), effect("snowfall"))
    assert found.normals[0, 2] == pytest.approx(-1.0, abs=1e-5)
    assert found.catches[0] == 0


def test_mass_comes_down_at_the_speeds_of_the_sizes_that_carry_it():
    snow = effect("snowfall")
    ways, shares = arrivals(snow, 4000, torch.Generator().manual_seed(0))
    assert float((shares * -ways[:, 2]).sum()) == pytest.approx(1.0, abs=1e-4)
    along = ways[:, :2] @ torch.tensor([math.cos(math.radians(25.0)), math.sin(math.radians(25.0))])
    assert along.mean() == pytest.approx(snow.wind.speed, abs=0.02)


def test_gaussians_under_the_ground_belong_to_it_and_those_in_the_air_do_not():
    """The ground lets light through to Gaussians deep below it; they show the mulch on it, and that gets the snow."""
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, -0.3], [0.0, 0, -1.4], [0.0, 0, 0.7]])), mesh(GROUND), CALM)
    assert found.loose.tolist() == [False, False, True]
    assert found.catches[:2] == pytest.approx([1.0, 1.0], abs=1e-5) and 0 < found.catches[2] <= 1.0001


def test_what_stands_under_a_table_is_no_part_of_it():
    table = quad([(-1.0, -1, 0.8), (1, -1, 0.8), (1, 1, 0.8), (-1, 1, 0.8)])
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, 0.15], [0.0, 0, -1.4], [0.0, 0, 0.75]])), mesh(GROUND, table), CALM)
    assert found.loose.tolist() == [True, False, False]
    assert found.catches.tolist() == [0.0, 0.0, pytest.approx(1.0, abs=1e-5)]


def test_without_a_surface_everything_is_loose_and_open():
    found = Exposure.of(flat_at(torch.tensor([[0.0, 0, 0.5]])), SurfaceMesh.empty(), CALM)
    assert found.loose.all() and found.catches.min() > 0 and found.sky.min() > 0.9


def test_the_same_seed_gives_the_same_exposure():
    points = flat_at(torch.rand(50, 3, generator=torch.Generator().manual_seed(1)))
    one, two = (Exposure.of(points, mesh(GROUND), effect("sandstorm"), seed=4) for _ in range(2))
    assert torch.equal(one.catches, two.catches) and torch.equal(one.sky, two.sky)
