"""Rays through solid ellipsoids against areas that are known."""

import math
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.laboratory.solid_coverage import Ellipsoids, solid_coverage, unit_sphere
from pgsd_nerfstudio.scene.cameras import Cameras

WIDTH, HEIGHT, FOCAL = 40, 30, 400.0


def camera() -> Cameras:
    K = torch.tensor([[[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]])
    return Cameras(torch.eye(4)[None], K, WIDTH, HEIGHT)


def one(axes: tuple[float, float, float], opacity: float = 1.0, quat=(1.0, 0, 0, 0), depth: float = 20.0) -> Ellipsoids:
    return Ellipsoids(
        torch.tensor([[0.0, 0, depth]]),
        torch.tensor([quat], dtype=torch.float32),
        torch.tensor([axes]),
        torch.tensor([opacity]),
        torch.zeros(1, 3),
    )


def share(area: float, depth: float = 20.0) -> float:
    """Of the picture that an area at a depth covers."""
    return area * (FOCAL / depth) ** 2 / (WIDTH * HEIGHT)


def test_the_meshes_cast_the_shadow_of_the_unit_ball_from_all_sides():
    vertices, faces = unit_sphere()
    a, b, c = (torch.from_numpy(vertices[faces[:, k]]) for k in range(3))
    normals = torch.linalg.cross(b - a, c - a)
    toward = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1
    )
    shadows = 0.25 * (normals @ toward.T).abs().sum(0)  # half of all, since both sides of a closed body are counted
    assert shadows.mean() == pytest.approx(math.pi, rel=0.01)
    assert shadows.min() > 0.97 * math.pi and shadows.max() < 1.03 * math.pi


@pytest.mark.parametrize(
    ("axes", "quat", "area"),
    [
        ((0.2, 0.2, 0.2), (1.0, 0, 0, 0), math.pi * 0.04),
        ((0.3, 0.2, 0.05), (1.0, 0, 0, 0), math.pi * 0.06),  # face on
        ((0.3, 0.2, 0.05), (math.sqrt(0.5), math.sqrt(0.5), 0, 0), math.pi * 0.015),  # turned about x: on edge
    ],
)
def test_an_ellipsoid_covers_its_shadow(axes, quat, area):
    found, error = solid_coverage(one(axes, quat=quat), camera(), 400, 1)
    assert error < 0.02 * found
    assert found == pytest.approx(share(area), rel=0.05)


def test_what_lace_takes_is_its_share_of_what_is_solid():
    solid, lace = (solid_coverage(one((0.2, 0.2, 0.2), opacity), camera(), 200, 1)[0] for opacity in (1.0, 0.3))
    assert lace == pytest.approx(0.3 * solid, rel=1e-6)


def test_motion_changes_where_a_body_covers_and_not_how_much():
    still = one((0.1, 0.1, 0.1))
    moving = replace(still, displacements=torch.tensor([[0.6, 0.2, 0.0]]))
    assert solid_coverage(moving, camera(), 800, 8)[0] == pytest.approx(solid_coverage(still, camera(), 800, 1)[0], rel=0.05)
