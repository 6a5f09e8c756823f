"""Short ways and nearest points among the cells' triangles, against Embree's rays and nearest points."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.surface.short_ways import first_met, grid_of, nearest
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

LOWER, UPPER = np.array([-1.0, -1.2, -0.5]), np.array([1.1, 1.0, 1.5])


def soup(seed: int, count: int, size: float) -> SurfaceMesh:
    """Triangles of any orientation in and around the box."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(LOWER - 0.3, UPPER + 0.3, (count, 1, 3))
    corners = middle + rng.normal(size=(count, 3, 3)) * rng.uniform(0.05, 1.0, (count, 1, 1)) * size
    triangles = torch.arange(3 * count, dtype=torch.int32).reshape(-1, 3)
    return SurfaceMesh(torch.from_numpy(corners.reshape(-1, 3).astype(np.float32)), triangles)


def lists(cells: TriangleCells) -> tuple[np.ndarray, ...]:
    return (cells.first, cells.members, cells.triangles.reshape(-1), cells.vertices.reshape(-1))


@numba.njit
def ways(start, direction, reach, grid, parts, first, members, triangles, vertices):
    found = np.empty(len(start))
    for n in range(len(start)):
        (x, y, z), (dx, dy, dz) = start[n], direction[n]
        t, which, _, _ = first_met(x, y, z, dx, dy, dz, reach, grid, parts, first, members, triangles, vertices)
        found[n] = t if which >= 0 else np.inf
    return found


@numba.njit
def points(at, reach, grid, first, members, triangles, vertices):
    found = np.empty(len(at))
    for n in range(len(at)):
        x, y, z = at[n]
        distance, which, _, _ = nearest(x, y, z, reach, grid, first, members, triangles, vertices)
        found[n] = distance if which >= 0 else np.inf
    return found


@pytest.mark.parametrize(("count", "size"), [(400, 0.2), (10, 2.0), (4000, 0.05)])
@pytest.mark.parametrize("length", [0.02, 0.3, 2.0])
def test_short_ways_meet_what_rays_meet(count, size, length):
    surface, rng = soup(1, count, size), np.random.default_rng(2)
    cells = TriangleCells.of(surface, LOWER, UPPER)
    start = rng.uniform(LOWER, UPPER, (4000, 3))
    direction = rng.normal(size=start.shape)
    direction[:1000, :2] = 0.0  # along an axis
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ends = start + length * direction
    within = ((ends > LOWER) & (ends < UPPER)).all(1)
    start, direction = start[within].astype(np.float32).astype(float), direction[within]
    found = ways(start, direction, length, grid_of(cells), cells.clearance.parts.reshape(-1), *lists(cells))
    expected = surface.first_hits(start, direction).distance.astype(float)
    expected[expected > length] = np.inf
    differ = np.isfinite(found) != np.isfinite(expected)
    assert np.isfinite(expected).sum() > 5
    # One may end at a triangle to the last bit, or pass at its edge.
    assert differ.sum() <= 1
    np.testing.assert_allclose(found[~differ], expected[~differ], atol=1e-5)


@pytest.mark.parametrize(("count", "size"), [(400, 0.2), (10, 2.0), (4000, 0.05)])
def test_nearest_points_are_those_of_the_whole_mesh(count, size):
    surface, rng = soup(3, count, size), np.random.default_rng(4)
    cells = TriangleCells.of(surface, LOWER, UPPER)
    at = rng.uniform(LOWER, UPPER, (3000, 3))
    found = points(at, 0.25, grid_of(cells), *lists(cells))
    expected = surface.closest(at).distance.numpy()
    close = expected < 0.25
    assert close.sum() > 20
    np.testing.assert_allclose(found[close], expected[close], atol=1e-5)
    assert np.isinf(found[~close]).all()


def test_sides_of_triangles_meet():
    """A square of two triangles: they meet along the diagonal, and nowhere else."""
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    cells = TriangleCells.of(
        SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)), np.zeros(3), np.ones(3)
    )
    met = (cells.across >= 0).nonzero()[0]
    assert len(met) == 2 and cells.across[met].tolist() == met[::-1].tolist()
    ends = {tuple(sorted((int(cells.triangles[n // 3, n % 3]), int(cells.triangles[n // 3, (n % 3 + 1) % 3])))) for n in met}
    places = {tuple(map(tuple, np.sort(cells.vertices[list(pair)], 0).tolist())) for pair in ends}
    assert places == {((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))}


def test_an_empty_mesh_has_no_triangles():
    cells = TriangleCells.of(SurfaceMesh.empty(), LOWER, UPPER)
    assert len(cells.members) == len(cells.triangles) == 0
    assert np.isinf(points(np.zeros((2, 3)), 0.1, grid_of(cells), *lists(cells))).all()
