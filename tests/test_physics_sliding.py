"""One particle on a slope: Coulomb's law, rest, and the edge over which it flies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.bodies import GRAVITY, Bodies
from pgsd_nerfstudio.physics.ground.sliding import LIFT, slide
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

STEP = 0.04


def cells(surface: SurfaceMesh) -> TriangleCells:
    lower, upper = surface.bounds.numpy()
    return TriangleCells.of(surface, lower - 1, upper + 1)


def slope(degrees: float) -> SurfaceMesh:
    """Falls with x, from -2 to 2 m; free beyond."""
    corners = 2 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners[:, 2] = -math.tan(math.radians(degrees)) * corners[:, 0]
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def body(speed: float = 100.0, x: float = -1.0, degrees: float = 0.0, v: float = 0.0) -> Bodies:
    """On the slope, moving down it at v; `speed` is terminal."""
    angle = math.radians(degrees)
    one = Bodies.join([Bodies.none()])
    values = {name: np.zeros((1, *value.shape[1:]), value.dtype) for name, value in vars(one).items()}
    values["positions"][0] = [x + LIFT * math.sin(angle), 0.1, -math.tan(angle) * x + LIFT * math.cos(angle)]
    values["velocities"][0] = [v * math.cos(angle), 0, -v * math.sin(angle)]
    values["speeds"][0] = speed
    return Bodies(**values)


@pytest.mark.parametrize(("degrees", "friction"), [(30.0, 0.0), (30.0, 0.3), (50.0, 0.5), (80.0, 0.3)])
def test_a_slider_accelerates_as_coulomb_says(degrees, friction):
    bodies, surface, angle = body(degrees=degrees), cells(slope(degrees)), math.radians(degrees)
    frames = 8
    for _ in range(frames):
        bodies = slide(bodies, surface, friction, STEP).bodies
    expected = (math.sin(angle) - friction * math.cos(angle)) * GRAVITY * frames * STEP
    assert np.linalg.norm(bodies.velocities) == pytest.approx(expected, rel=1e-3)
    way = np.linalg.norm(bodies.positions - body(degrees=degrees).positions)
    assert way == pytest.approx(0.5 * expected * frames * STEP, rel=0.1)
    off = bodies.positions[0, 2] + math.tan(angle) * bodies.positions[0, 0]
    assert off * math.cos(angle) == pytest.approx(LIFT, abs=1e-4)


def test_friction_above_the_slope_stops_it_and_it_rests():
    bodies, surface = body(degrees=20.0, v=1.0), cells(slope(20.0))
    angle = math.radians(20)
    for _ in range(30):
        moved = slide(bodies, surface, 0.6, STEP)
        bodies = moved.bodies
        if moved.rests.any():
            break
    assert moved.rests.all()
    stop = 1.0 / (2 * GRAVITY * (0.6 * math.cos(angle) - math.sin(angle)))
    assert np.linalg.norm(bodies.positions - body(degrees=20.0).positions) == pytest.approx(stop, rel=0.15)


def test_it_is_never_faster_than_it_would_fall():
    bodies, surface = body(speed=0.8, degrees=70.0, x=-1.8), cells(slope(70.0))
    for _ in range(40):
        bodies = slide(bodies, surface, 0.1, STEP).bodies
        assert np.linalg.norm(bodies.velocities) <= 0.8 + 1e-6


@pytest.mark.parametrize("speed", [0.3, 2.0])
def test_beyond_an_edge_it_flies_with_its_velocity(speed):
    bodies, surface = body(speed=speed, degrees=45.0, x=1.97, v=speed), cells(slope(45.0))  # no faster than that
    for _ in range(10):
        moved = slide(bodies, surface, 0.0, STEP)
        bodies = moved.bodies
        if moved.flies.any():
            break
    assert moved.flies.all() and not moved.rests.any()
    assert 2.0 < moved.bodies.positions[0, 0] < 2.15
    direction = moved.bodies.velocities[0] / np.linalg.norm(moved.bodies.velocities[0])
    np.testing.assert_allclose(direction, [math.sqrt(0.5), 0, -math.sqrt(0.5)], atol=0.02)


def test_along_a_wall_it_falls_freely_up_to_its_terminal_speed():
    corners = torch.tensor([[0.0, -1, -5], [0, 1, -5], [0, 1, 5], [0, -1, 5]])
    wall = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    bodies = replace(body(), positions=np.array([[0.001, 0.0, 3.0]], np.float32))
    for _ in range(5):
        bodies = slide(bodies, cells(wall), 0.5, STEP).bodies
    assert bodies.velocities[0, 2] == pytest.approx(-GRAVITY * 5 * STEP, rel=1e-3)


@pytest.mark.parametrize("v", [0.5, 2.0, 6.0])
def test_a_slider_stops_at_a_wall_and_is_never_inside_of_it(v):
    """A chute that ends at a house: within a step its way would lead deep into the wall."""
    chute, wall = slope(45.0), 2 * torch.tensor([[0.25, -1.0, -2], [0.25, 1, -2], [0.25, 1, 2], [0.25, -1, 2]])
    behind = wall + torch.tensor([0.2, 0.0, 0.0])
    house = SurfaceMesh(
        torch.cat([chute.vertices, wall, behind]),
        torch.tensor([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6], [8, 9, 10], [8, 10, 11]], dtype=torch.int32),
    )
    bodies, farthest = body(degrees=45.0, x=0.45, v=v), 0.0
    for _ in range(20):
        bodies = slide(bodies, cells(house), 0.2, STEP).bodies
        farthest = max(farthest, float(bodies.positions[0, 0]))
    assert 0.4 < farthest < 0.5
