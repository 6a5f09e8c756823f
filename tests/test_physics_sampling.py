"""Points on a surface within a box: those of plain sampling, at a cost that does not grow with what lies outside the box."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.ground.sampling import points_within
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.5), (2.0, 2.0, 3.0))
LOWER, UPPER = np.array(DOMAIN.lower), np.array(DOMAIN.upper)


def floor(half: float, height: float = 0.1) -> SurfaceMesh:
    """A level square of two triangles."""
    corners = torch.tensor([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def all_points(surface: SurfaceMesh, spacing: float) -> np.ndarray:
    """Every lattice point of every triangle, one by one."""
    found = []
    for corners in surface.vertices.double().numpy()[surface.triangles.numpy()]:
        longest = max(np.linalg.norm(corners[a] - corners[b]) for a, b in ((0, 1), (1, 2), (2, 0)))
        steps = 1
        while longest / steps > spacing:
            steps *= 2
        for i in range(steps + 1):
            for j in range(steps + 1 - i):
                u, v = i / steps, j / steps
                found.append((1 - u - v) * corners[0] + u * corners[1] + v * corners[2])
    return np.array(found)


def rows(points: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(point) for point in points.round(9).tolist()}


def test_in_the_box_the_points_are_those_of_plain_sampling():
    rng = np.random.default_rng(0)
    middles, sizes = rng.uniform(-5, 5, (40, 1, 3)), rng.choice([0.05, 0.5, 4.0, 20.0], (40, 1, 1))
    vertices = torch.from_numpy((middles + sizes * rng.normal(size=(40, 3, 3))).reshape(-1, 3)).float()
    surface = SurfaceMesh(vertices, torch.arange(120, dtype=torch.int32).reshape(-1, 3))
    expected = all_points(surface, 0.3)
    within = expected[((expected >= LOWER) & (expected <= UPPER)).all(1)]
    found = np.concatenate(list(points_within(surface, LOWER, UPPER, 0.3)))
    assert len(within) > 500
    assert rows(within) <= rows(found) <= rows(expected)
    assert len(found) < 0.5 * len(expected)


def test_every_point_of_a_triangle_has_one_within_the_spacing():
    found = np.concatenate(list(points_within(floor(1000.0), LOWER, UPPER, 0.2)))
    rng = np.random.default_rng(0)
    at = np.column_stack([rng.uniform(-2, 2, (500, 2)), np.full(500, 0.1)])
    assert np.linalg.norm(at[:, None] - found, axis=2).min(1).max() <= 0.2


@pytest.mark.parametrize(
    "make", [lambda mesh: Ground.of(mesh, SurfaceResponse(), DOMAIN).cells.clearance.parts, lambda mesh: _keys(mesh)]
)
def test_maps_of_a_floor_do_not_depend_on_how_far_it_goes_and_neither_does_their_memory(make):
    """A floor of 400 km in points 6 cm apart would be 10^14 of them."""
    expected = make(floor(3.0))
    tracemalloc.start()
    found = make(floor(2e5))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(found, expected)
    assert peak < 200e6


def _keys(mesh: SurfaceMesh) -> np.ndarray:
    return WetnessGrid.of(mesh, DOMAIN).keys


def test_pieces_are_small_however_many_triangles_there_are():
    vertices = torch.rand(300_000, 3, generator=torch.Generator().manual_seed(0)) * 0.02
    surface = SurfaceMesh(vertices, torch.arange(300_000, dtype=torch.int32).reshape(-1, 3))
    sizes = [len(piece) for piece in points_within(surface, LOWER, UPPER, 0.002)]
    assert len(sizes) > 5 and max(sizes) <= 500_000


def test_an_empty_surface_and_one_outside_the_box_have_no_points():
    assert list(points_within(SurfaceMesh.empty(), LOWER, UPPER, 0.1)) == []
    assert list(points_within(floor(3.0, height=9.0), LOWER, UPPER, 0.1)) == []
