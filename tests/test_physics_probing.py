"""The neighbourhood of landed particles: against rays onto the rings, and on shapes whose edges are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.ground.probing import PROBES, RINGS, ROUGH, SMALLEST, probed
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

PROBE = 0.12
BOX = np.array([-1.5, -1.5, -1.0]), np.array([1.5, 1.5, 1.0])


def terrain(heights, count: int = 81, hole=None) -> SurfaceMesh:
    """A height field over a square of 2 m, as triangles of 2.5 cm; `hole` tells which vertices are left out."""
    side = np.linspace(-1.0, 1.0, count)
    x, y = np.meshgrid(side, side, indexing="ij")
    ids = np.arange(count**2).reshape(count, count)
    a, b, c, d = ids[:-1, :-1].ravel(), ids[1:, :-1].ravel(), ids[1:, 1:].ravel(), ids[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    if hole is not None:
        triangles = triangles[~hole(x, y).ravel()[triangles].any(1)]
    vertices = np.stack([x, y, heights(x, y)], -1).reshape(-1, 3)
    return SurfaceMesh(torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(triangles.astype(np.int32)))


def by_rays(surface: SurfaceMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals and extents as rays find them, which are cast along the normal onto the rings from above."""
    closest = surface.closest(points)
    at, normal = closest.points.numpy().astype(float), closest.normals.numpy().astype(float)
    normal = np.where(normal[:, 2:] < 0, -normal, normal)
    x, y, z = normal.T
    first = np.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x], 1)  # the walks' own directions
    second = np.cross(normal, first)
    total, extent, goes_on = 2 * normal, np.full(len(at), SMALLEST * PROBE), np.ones(len(at), bool)
    for share in RINGS:
        radius = share * PROBE
        room = ROUGH * radius + 0.01
        same = np.zeros(len(at), int)
        for turn in 2 * math.pi * np.arange(PROBES) / PROBES:
            origin = at + 2 * room * normal + radius * (math.cos(turn) * first + math.sin(turn) * second)
            hits = surface.cast(origin, -normal)
            good = (np.abs(hits.distance.numpy() - 2 * room) <= room) & goes_on
            total[good] += hits.normal.numpy()[good]
            same += good
        goes_on &= same >= PROBES - 1
        extent[goes_on] = radius
    total *= np.where(total[:, 2:] < 0, -1.0, 1.0)
    return total / np.linalg.norm(total, axis=1, keepdims=True), extent


def test_walks_find_what_rays_find():
    rng = np.random.default_rng(0)
    surface = terrain(
        lambda x, y: 0.06 * np.sin(9 * x) * np.cos(7 * y) + 0.15 * (x > 0.4) + 0.004 * rng.normal(size=x.shape),
        hole=lambda x, y: (x + 0.5) ** 2 + (y - 0.2) ** 2 < 0.05,
    )
    points = np.column_stack([rng.uniform(-0.95, 0.95, (4000, 2)), np.zeros(4000)])
    points[:, 2] = 0.3 - surface.cast(points + np.array([0, 0, 0.3]), np.tile([0.0, 0, -1], (4000, 1))).distance.numpy()
    points = points[np.isfinite(points[:, 2])]
    at, normals, extents, found = probed(TriangleCells.of(surface, *BOX), points, PROBE)
    assert (found >= 0).all()
    np.testing.assert_allclose(at, surface.closest(points).points.numpy(), atol=1e-5)
    expected, reached = by_rays(surface, points)
    apart = np.degrees(np.arccos((normals * expected).sum(1).clip(-1, 1)))
    assert np.quantile(apart, 0.5) < 0.1 and np.quantile(apart, 0.95) < 1.0
    assert (np.abs(extents - reached) < 1e-6).mean() > 0.98


def test_the_surface_ends_at_an_edge_and_at_a_step():
    surface = terrain(lambda x, y: 0.3 * (x > 0.49))
    points = np.array([[0.0, 0, 0], [-0.96, 0.1, 0], [-0.98, 0.1, 0], [0.42, 0.1, 0]])
    extents = probed(TriangleCells.of(surface, *BOX), points, PROBE)[2]
    np.testing.assert_allclose(extents, PROBE * np.array([1.0, 0.25, 0.15, 0.5]), rtol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_the_normal_of_a_slope_is_exact(degrees):
    rise = math.tan(math.radians(degrees))
    surface = terrain(lambda x, y: 0.4 * rise * x)
    normals = probed(TriangleCells.of(surface, *BOX), np.array([[0.1, 0.2, 0.04 * rise]]), PROBE)[1]
    expected = np.array([-0.4 * rise, 0.0, 1.0])
    np.testing.assert_allclose(normals[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_windings_that_face_down_are_turned_up():
    surface = terrain(lambda x, y: 0.2 * y)
    surface = SurfaceMesh(surface.vertices, surface.triangles.flip(1))
    normals = probed(TriangleCells.of(surface, *BOX), np.array([[0.1, 0.2, 0.04]]), PROBE)[1]
    np.testing.assert_allclose(normals[0], np.array([0, -0.2, 1]) / math.hypot(0.2, 1), atol=1e-5)


def test_far_from_the_surface_nothing_is_found():
    assert probed(TriangleCells.of(terrain(lambda x, y: 0 * x), *BOX), np.array([[0.0, 0, 0.9]]), PROBE)[3].tolist() == [-1]
