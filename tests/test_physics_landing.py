"""Landing: no path through the surface, flat on it, not on walls, not over edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import roma
import torch

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.5), (2.0, 2.0, 3.0))
TILT = math.radians(30)


def square(middle: tuple[float, float, float], half: float, slope: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square that rises along x by `slope` radians, facing up."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners = np.column_stack([corners[:, 0] * math.cos(slope), corners[:, 1], corners[:, 0] * math.sin(slope)])
    return corners + middle, np.array([[0, 1, 2], [0, 2, 3]])


def mesh(*parts: tuple[np.ndarray, np.ndarray]) -> SurfaceMesh:
    shift = np.cumsum([0, *(len(v) for v, _ in parts[:-1])])
    vertices = torch.from_numpy(np.concatenate([v for v, _ in parts]).astype(np.float32))
    return SurfaceMesh(
        vertices, torch.from_numpy(np.concatenate([f + k for (_, f), k in zip(parts, shift, strict=True)])).int()
    )


def ground(*parts: tuple[np.ndarray, np.ndarray], response: SurfaceResponse | None = None) -> Ground:
    return Ground.of(mesh(*parts), response or SurfaceResponse(), DOMAIN)


FLOOR, TABLE, RAMP = square((0, 0, 0), 3.0), square((0, 0, 0.7), 0.5), square((1.2, 1.2, 1.5), 0.4, TILT)


def test_no_path_passes_the_surface():
    """The map of free air spares rays, never hits: compared with a ray for every path."""
    there = ground(FLOOR, TABLE, RAMP)
    rng = np.random.default_rng(0)
    start = (np.asarray(DOMAIN.lower) + rng.uniform(size=(20_000, 3)) * np.asarray(DOMAIN.size)).astype(np.float32)
    stop = start + rng.normal(scale=[0.03, 0.03, 0.06], size=(20_000, 3)).astype(np.float32)
    stop[:200] = start[:200] + rng.normal(size=(200, 3)).astype(np.float32)  # and some far
    met = there.meet(start, stop)
    hits = there.surface.cast(torch.from_numpy(start), torch.from_numpy(stop - start))
    expected = (hits.distance <= 1.0).numpy()
    assert expected.sum() > 200
    assert np.setxor1d(met.which, expected.nonzero()[0]).size <= 1  # a path that ends on the surface to the last bit
    assert len(there.cells.clearance.near(start, stop)) < 0.25 * len(start)


def test_paths_end_on_the_surface():
    met = ground(FLOOR).meet(np.float32([[0.3, 0.2, 0.05]]), np.float32([[0.4, 0.2, -0.05]]))
    np.testing.assert_allclose(met.points, [[0.35, 0.2, 0.0]], atol=1e-6)
    np.testing.assert_allclose(met.normals, [[0, 0, 1]], atol=1e-6)


def test_nothing_lands_where_there_is_nothing():
    empty = Ground.of(SurfaceMesh.empty(), SurfaceResponse(), DOMAIN)
    assert len(empty.meet(np.zeros((5, 3), np.float32), np.ones((5, 3), np.float32)).which) == 0
    assert empty.open_above(np.zeros((5, 3)), np.ones((5, 3))).all()
    assert len(empty.rest(np.zeros((0, 3), np.float32), np.zeros(0)).positions) == 0


def test_flakes_lie_flat_with_a_little_room_below():
    response = SurfaceResponse(settle=0.004)
    there = ground(RAMP, response=response)
    points = np.float32([[1.2, 1.2, 1.51], [1.25, 1.1, 1.55]])
    rest = there.rest(points, np.float32([0.1, 0.7]))
    axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(torch.from_numpy(rest.quats)))[:, :, 2].numpy()
    normal = np.array([-math.sin(TILT), 0, math.cos(TILT)])
    np.testing.assert_allclose(axes, [normal, normal], atol=1e-5)
    np.testing.assert_allclose((rest.positions - [1.2, 1.2, 1.5]) @ normal, 0.004, atol=1e-5)
    assert np.linalg.norm(rest.quats, axis=1) == pytest.approx([1, 1], abs=1e-6)


def test_spin_turns_a_flake_about_the_normal():
    there = ground(RAMP)
    points = np.repeat(np.float32([[1.2, 1.2, 1.5]]), 2, 0)
    quats = torch.from_numpy(there.rest(points, np.float32([0.0, 0.25])).quats)
    first, second = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quats))
    assert float(roma.rotmat_geodesic_distance(first, second)) == pytest.approx(math.pi / 2, abs=1e-4)


@pytest.mark.parametrize(("degrees", "share"), [(0, 1.0), (50, 1.0), (65, 0.5), (80, 0.0), (90, 0.0), (170, 0.0)])
def test_steep_faces_hold_less(degrees, share):
    there = ground(FLOOR)
    angle = math.radians(degrees)
    normals = np.repeat([[math.sin(angle), 0.0, math.cos(angle)]], 4000, 0)
    draw = np.random.default_rng(0).uniform(size=4000)
    assert there.holds(normals, draw).mean() == pytest.approx(share, abs=0.03)


def test_nothing_spreads_over_the_edge_of_a_table():
    there = ground(FLOOR, TABLE)
    probe = there.response.probe
    inward = np.array([0.0, 0.2, 0.38, 0.46, 0.48, 0.495])
    points = np.column_stack([inward, 0 * inward, 0 * inward + 0.7]).astype(np.float32)
    extents = there.rest(points, np.zeros(len(points))).extents
    assert extents[0] == pytest.approx(probe)
    assert (extents <= np.maximum(0.5 - inward, 0.15 * probe) + 1e-6).all()
    assert (np.diff(extents) <= 0).all()


def test_what_is_under_the_table_is_not_open():
    there = ground(FLOOR, TABLE)
    points = np.array([[0, 0, 0.3], [0, 0, 1.0], [1.5, 0, 0.3], [0, 0, -0.2]])
    assert there.open_above(points, np.repeat([[0.0, 0, 1]], 4, 0)).tolist() == [False, True, True, False]
    assert there.open_above(points[:1], np.array([[3.0, 0, 1]])).tolist() == [True]  # wind blows under it
