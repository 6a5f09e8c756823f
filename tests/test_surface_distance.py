"""The distance grid against shapes whose distance is known in closed form, whole and damaged."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import pgsd_nerfstudio.surface.distance as module
from pgsd_nerfstudio.surface.distance import DistanceGrid
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CELL = 0.05
LOWER, UPPER = np.array([-1.0, -1.0, -0.2]), np.array([1.0, 1.0, 1.6])
CENTER, RADIUS, HALF = np.array([0.03, -0.01, 0.7]), 0.5, np.array([0.41, 0.52, 0.32])


def sheet(first, second, origin, cells: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A parallelogram of 2 cells^2 triangles."""
    u, v = np.meshgrid(np.arange(cells + 1) / cells, np.arange(cells + 1) / cells, indexing="ij")
    vertices = np.asarray(origin) + u[..., None] * np.asarray(first) + v[..., None] * np.asarray(second)
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b = a + cells + 1
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])


def join(parts) -> tuple[np.ndarray, np.ndarray]:
    shift = np.cumsum([0, *(len(v) for v, _ in parts[:-1])])
    return np.concatenate([v for v, _ in parts]), np.concatenate([f + k for (_, f), k in zip(parts, shift, strict=True)])


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Of half edge 1, its sides facing outwards."""
    sides = []
    for axis in range(3):
        first, second = np.roll(np.eye(3), axis, 1)[[1, 2]] * 2
        normal = np.cross(first, second) / 4
        sides += [sheet(first, second, normal - (first + second) / 2), sheet(second, first, -normal - (first + second) / 2)]
    return join(sides)


def ball() -> tuple[np.ndarray, np.ndarray]:
    vertices, triangles = cube()
    return CENTER + RADIUS * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), triangles


def box() -> tuple[np.ndarray, np.ndarray]:
    vertices, triangles = cube()
    return CENTER + HALF * vertices, triangles


def floor(height: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    return sheet([8, 0, 0], [0, 8, 0], [-4, -4, height], cells=120)


def to_ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p - CENTER, axis=-1) - RADIUS


def to_box(p: np.ndarray) -> np.ndarray:
    q = np.abs(p - CENTER) - HALF
    return np.linalg.norm(q.clip(0), axis=-1) + q.max(-1).clip(max=0)


def to_floor(p: np.ndarray) -> np.ndarray:
    return p[..., 2] - 0.02


SHAPES = {"ball": (ball, to_ball), "box": (box, to_box), "floor": (floor, to_floor)}


def mesh(part, *, removed: float = 0.0, flipped: float = 0.0) -> SurfaceMesh:
    vertices, triangles = part
    rng = np.random.default_rng(0)
    triangles = np.where(rng.uniform(size=len(triangles))[:, None] < flipped, triangles[:, ::-1], triangles)
    triangles = triangles[rng.uniform(size=len(triangles)) >= removed]
    return SurfaceMesh(torch.from_numpy(vertices).float(), torch.from_numpy(triangles.copy()).int())


def grid_of(part, **damage) -> DistanceGrid:
    return DistanceGrid.of(mesh(part, **damage), LOWER, UPPER, CELL)


def lattice(grid: DistanceGrid) -> np.ndarray:
    return grid.lower + grid.cell * np.stack(np.meshgrid(*map(np.arange, grid.values.shape), indexing="ij"), -1)


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_the_analytic_ones_and_clamped_beyond_the_band(name):
    make, truth = SHAPES[name]
    grid = grid_of(make())
    expected = truth(lattice(grid)).clip(-3 * CELL, 3 * CELL)
    assert np.abs(grid.values - expected).max() < 1.5e-3  # the ball is a polyhedron
    if name != "ball":
        assert np.abs(grid.values - expected).max() < 1e-5
    assert grid.band == pytest.approx(3 * CELL)
    assert grid.asked < 0.55 * grid.values.size


@pytest.mark.parametrize("name", SHAPES)
def test_damaged_meshes_keep_their_sides(name):
    """5 % of the triangles gone, 30 % turned around."""
    make, truth = SHAPES[name]
    grid = grid_of(make(), removed=0.05, flipped=0.3)
    expected = truth(lattice(grid))
    wrong = np.sign(grid.values) != np.sign(expected)
    assert wrong[np.abs(expected) > CELL].mean() < 3e-4
    assert wrong[np.abs(expected) > CELL / 2].mean() < 1e-3
    assert wrong.mean() < 0.004
    right = grid.values[~wrong] - expected.clip(-3 * CELL, 3 * CELL)[~wrong]
    assert np.quantile(np.abs(right), 0.99) < 0.1 * CELL


@pytest.mark.parametrize("make", [ball, box, floor])
def test_flipped_triangles_change_nothing_off_the_surface(make):
    whole, flipped = grid_of(make()), grid_of(make(), flipped=0.3)
    np.testing.assert_allclose(np.abs(flipped.values), np.abs(whole.values), atol=1e-6)
    turned = np.abs(whole.values)[np.sign(flipped.values) != np.sign(whole.values)]
    assert len(turned) <= 2 and (turned < 0.05 * CELL).all()  # a point on a facet's edge may see either side


def test_a_body_on_the_floor_joins_it():
    grid = grid_of(join([box(), floor()]), removed=0.05, flipped=0.3)
    at = np.array([[0.0, 0.0, 0.7], [0.0, 0.0, 0.25], [0.9, 0.9, 0.1], [0.0, 0.0, 1.5], [0.0, 0.0, -0.15], [0.9, 0.9, -0.2]])
    value, _ = grid.sample(at)
    assert (np.sign(value) == [-1, 1, 1, 1, -1, -1]).all()


@pytest.mark.parametrize("flipped", [0.0, 0.3])
def test_below_a_table_top_of_one_sheet_is_air_and_below_the_floor_there_is_none(flipped):
    """TSDF meshes have only the side that cameras saw."""
    top = sheet([0.8, 0, 0], [0, 0.8, 0], [-0.4, -0.4, 0.71])
    grid = grid_of(join([top, floor()]), flipped=flipped)
    at = lattice(grid)
    below_floor, air = at[..., 2] < -0.01, (at[..., 2] > 0.03) & (at[..., 2] < 0.45)
    assert (grid.values[below_floor] < 0).mean() > 0.99
    assert (grid.values[air | (at[..., 2] > 0.76)] > 0).all()


@pytest.mark.parametrize("name", SHAPES)
def test_samples_and_normals_between_lattice_points(name):
    make, truth = SHAPES[name]
    grid, rng = grid_of(make()), np.random.default_rng(1)
    points = rng.uniform(LOWER, UPPER, (20_000, 3))
    smooth = np.abs(truth(points)) < 2 * CELL
    if name == "box":  # away from its edges, where the distance bends
        smooth &= (np.abs(points - CENTER) < HALF - 3.5 * CELL).sum(1) == 2
    points = points[smooth]
    assert len(points) > 300
    value, gradient = grid.sample(points)
    step = 1e-4
    expected = np.stack([(truth(points + d) - truth(points - d)) / (2 * step) for d in step * np.eye(3)], 1)
    assert np.abs(value - truth(points)).max() < 0.06 * CELL
    assert np.linalg.norm(gradient - expected, axis=1).max() < 0.12
    cosine = (grid.normals(points) * expected).sum(1)
    assert cosine.min() > math.cos(math.radians(7))


def test_the_gradient_is_the_slope_of_the_samples():
    grid, rng = grid_of(ball()), np.random.default_rng(2)
    points = CENTER + 0.5 * rng.normal(size=(500, 3)) / 2
    h = 1e-6
    within = (np.abs((points - grid.lower) / CELL % 1 - 0.5) < 0.49).all(1)
    points = points[within]
    slope = np.stack([(grid.sample(points + d)[0] - grid.sample(points - d)[0]) / (2 * h) for d in h * np.eye(3)], 1)
    np.testing.assert_allclose(grid.sample(points)[1], slope, atol=1e-6)


def test_trilinear_functions_are_kept():
    grid = DistanceGrid.of(SurfaceMesh.empty(), np.zeros(3), np.full(3, 0.5), 0.1)
    x, y, z = np.moveaxis(lattice(grid), -1, 0)
    grid.values[:] = 1 + 2 * x - y + 3 * z + 4 * x * y * z
    points = np.random.default_rng(0).uniform(0, 0.5, (100, 3))
    x, y, z = points.T
    value, gradient = grid.sample(points)
    np.testing.assert_allclose(value, 1 + 2 * x - y + 3 * z + 4 * x * y * z, atol=1e-6)
    np.testing.assert_allclose(gradient, np.stack([2 + 4 * y * z, -1 + 4 * x * z, 3 + 4 * x * y], 1), atol=1e-5)


def test_without_a_mesh_everything_is_outside():
    grid = DistanceGrid.of(SurfaceMesh.empty(), LOWER, UPPER, CELL)
    assert (grid.values == np.float32(3 * CELL)).all() and grid.asked == 0
    value, gradient = grid.sample(np.array([[0.0, 0.0, 0.5], [99.0, 0.0, 0.0]]))
    np.testing.assert_allclose(value, 3 * CELL, rtol=1e-6)
    assert np.abs(gradient).max() < 1e-6 and np.abs(grid.normals(np.zeros((1, 3)))).max() < 1e-2


def test_the_box_covers_what_was_asked_for_and_its_border_holds_beyond():
    grid = grid_of(floor())
    assert (grid.upper >= UPPER - 1e-9).all() and (grid.upper < UPPER + CELL).all()
    grid.values[:] = lattice(grid)[..., 0]
    value, _ = grid.sample(
        np.array([[-50.0, 0.3, 0.1], [-1.0, 0.3, 0.1], [0.52, 9.0, -9.0], [1.0, 0.3, 0.1], [50.0, 0.3, 0.1]])
    )
    np.testing.assert_allclose(value, [-1.0, -1.0, 0.52, 1.0, 1.0], atol=1e-6)


def test_bad_boxes_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="needs a box"):
        DistanceGrid.of(SurfaceMesh.empty(), UPPER, LOWER, CELL)
    monkeypatch.setattr(module, "MAX_POINTS", 1000)
    with pytest.raises(ValueError, match=r"points are more than 1,000: take cells larger than 0\.05 m"):
        DistanceGrid.of(SurfaceMesh.empty(), LOWER, UPPER, CELL)
