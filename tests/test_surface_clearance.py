"""Clearance: no path that a ray finds to hit a mesh is called free, and few are called near."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import pgsd_nerfstudio.surface.clearance as module
from pgsd_nerfstudio.surface.clearance import CELL, PARTS, REACH, Clearance
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

LOWER, UPPER = np.array([-1.0, -1.2, -0.5]), np.array([1.1, 1.0, 1.5])


def soup(seed: int, count: int, size: float) -> SurfaceMesh:
    """Triangles of any orientation in and around the box, some of them without area."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(LOWER - 0.5, UPPER + 0.5, (count, 1, 3))
    corners = middle + rng.normal(size=(count, 3, 3)) * rng.uniform(0.05, 1.0, (count, 1, 1)) * size
    corners[::7, 2] = corners[::7, 0] + 0.3 * (corners[::7, 1] - corners[::7, 0])
    corners[::5, :, 2] = middle[::5, :, 2]
    triangles = torch.arange(3 * count, dtype=torch.int32).reshape(-1, 3)
    return SurfaceMesh(torch.from_numpy(corners.reshape(-1, 3).astype(np.float32)), triangles)


@pytest.mark.parametrize(("seed", "count", "size"), [(0, 400, 0.2), (1, 10, 1.0), (2, 60, 40.0), (3, 4000, 0.05)])
@pytest.mark.parametrize("length", [0.02, 0.3, 2.0])
def test_no_path_that_hits_is_called_free(seed, count, size, length):
    surface = soup(seed, count, size)
    clearance = Clearance.of(surface, LOWER, UPPER)
    rng = np.random.default_rng(seed)
    start = rng.uniform(LOWER - 0.1, UPPER + 0.1, (4000, 3)).astype(np.float32)
    stop = (start + rng.normal(size=start.shape) * length).astype(np.float32)
    near = clearance.near(start, stop)
    hits = (surface.cast(start, stop - start).distance <= 1.0).numpy().nonzero()[0]
    assert len(hits) > 0
    assert np.setdiff1d(hits, near).size == 0
    assert (np.diff(near) > 0).all()


def test_paths_near_a_floor_are_near_and_no_others():
    corners = torch.tensor([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    clearance = Clearance.of(SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)), LOWER, UPPER)
    z = np.linspace(-0.4, 1.4, 181, dtype=np.float32)
    start = np.column_stack([0 * z, 0 * z, z])
    near = clearance.near(start, start - np.float32([0, 0, 0.1]))
    assert np.isin(((z > 0) & (z < 0.1)).nonzero()[0], near).all()
    assert z[near].min() >= -2.1 * CELL and z[near].max() <= 0.1 + 2.1 * CELL
    raised = clearance.near(start, start - np.float32([0, 0, 0.1]), 0.2)
    assert set(near) < set(raised) and z[raised].max() <= 0.3 + 2.1 * CELL


def test_clearance_is_never_more_than_the_distance_to_the_surface():
    surface = soup(5, 30, 0.3)
    clearance = Clearance.of(surface, LOWER, UPPER)
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (20_000, 3))
    i, j, k = np.floor((points - clearance.lower) / clearance.cell).astype(int).T
    metres = clearance.parts[i, j, k] * clearance.cell / PARTS
    distance = surface.closest(points).distance.numpy()
    assert (metres <= distance + 1e-6).all()
    closer = distance < (REACH - 1) * clearance.cell
    assert (distance - metres)[closer].max() < 3.5 * clearance.cell  # the diagonals of two cells


def test_paths_outside_the_map_and_broken_ones_are_near_and_those_without_length_are_free():
    clearance = Clearance.of(SurfaceMesh.empty(), LOWER, UPPER)
    far = np.float32([[0, 0, 50], [0, 0, 0], [np.nan, 0, 0], [0, 0, 0.5]])
    assert clearance.near(far, far + np.float32([[1], [0], [0], [0.1]])).tolist() == [0, 2]


def test_cells_grow_with_the_box(monkeypatch):
    monkeypatch.setattr(module, "MAX_CELLS", 30_000)
    clearance = Clearance.of(soup(1, 10, 1.0), LOWER, UPPER)
    assert clearance.parts.size <= 40_000 and clearance.cell > CELL
