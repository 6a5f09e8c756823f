"""Free flight: the exact step, its order in changing wind, and the kernel against its plain form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.air.airborne import _COSINE, _SINE, Flutter, advance, air_velocity
from pgsd_nerfstudio.physics.air.deflection import Deflection
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import GRAVITY
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

WIND = WindField.draw(Wind(), 3)
TOLERANCE = {np.float32: 2e-5, np.float64: 1e-12}


def particles(count: int, dtype: type) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    position = rng.uniform([-3, -3, 1], [3, 3, 7], (count, 3))
    return position.astype(dtype), rng.normal(size=(count, 3)).astype(dtype), rng.uniform(0.6, 1.4, count).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("step", [0.01, 0.04, 1.0])
def test_fall_in_still_air_is_the_analytic_one(dtype, step):
    position, velocity, speed = particles(50, dtype)
    x0, v0 = position.astype(np.float64), velocity.astype(np.float64)
    steps = 4
    for k in range(steps):
        advance(position, velocity, speed, Flutter.none(50, dtype), WIND.still(), k * step, step)
    t, tau = steps * step, speed.astype(np.float64)[:, None] / GRAVITY
    settled = np.stack([0 * speed, 0 * speed, -speed], 1).astype(np.float64)
    decay = np.exp(-t / tau)
    assert np.abs(velocity - (settled + (v0 - settled) * decay)).max() < TOLERANCE[dtype]
    assert np.abs(position - (x0 + settled * t + (v0 - settled) * tau * (1 - decay))).max() < TOLERANCE[dtype]


def test_two_half_steps_equal_one_step_in_still_air():
    one, velocity, speed = particles(20, np.float64)
    two, velocity_two = one.copy(), velocity.copy()
    advance(one, velocity, speed, Flutter.none(20, np.float64), WIND.still(), 0.0, 0.08)
    for k in range(2):
        advance(two, velocity_two, speed, Flutter.none(20, np.float64), WIND.still(), k * 0.04, 0.04)
    np.testing.assert_allclose(two, one, atol=1e-13)
    np.testing.assert_allclose(velocity_two, velocity, atol=1e-13)


def test_a_flake_without_wind_reaches_terminal_speed():
    position, velocity, speed = particles(20, np.float32)
    for k in range(50):
        advance(position, velocity, speed, Flutter.none(20), WIND.still(), k * 0.04, 0.04)
    np.testing.assert_allclose(velocity, np.stack([0 * speed, 0 * speed, -speed], 1), atol=1e-6)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 3e-7), (np.float32, 3e-5)])
def test_the_kernel_feels_the_wind_of_the_plain_form(dtype, tolerance):
    """A weightless particle takes on the wind at the middle of the step."""
    position, _, _ = particles(200, dtype)
    position[:50, 2] -= 4  # some near and below the ground
    velocity, at = np.zeros_like(position), position.astype(np.float64)
    advance(position, velocity, np.full(200, 1e-9, dtype), Flutter.none(200, dtype), WIND, 1.5, 0.04)
    np.testing.assert_allclose(velocity, WIND.velocity(at, 1.52), atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 3e-7), (np.float32, 3e-5)])
def test_air_that_newcomers_meet_is_that_of_the_plain_form(dtype, tolerance):
    position, _, _ = particles(200, dtype)
    position[:50, 2] -= 4  # some near and below the ground
    at = position.copy()
    np.testing.assert_allclose(air_velocity(position, WIND, 1.5), WIND.velocity(at.astype(np.float64), 1.5), atol=tolerance)
    np.testing.assert_array_equal(position, at)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 3e-7), (np.float32, 3e-5)])
def test_the_kernel_feels_obstacles_as_the_plain_form_does(dtype, tolerance):
    """Two walls at right angles; particles beside them, in the ground, and where the difference fades out and beyond."""
    corners = [[0.4, -2, -0.5], [0.4, 2, -0.5], [0.4, 0, 2.2], [-2, 1.3, -0.5], [2, 1.3, -0.5], [0, 1.3, 1.8]]
    walls = SurfaceMesh(torch.tensor(corners), torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32))
    deflection = Deflection.of(walls, Domain((-2.5, -2.5, -0.3), (2.5, 2.5, 3.0)), Wind())
    wind = WindField.draw(Wind(), 3, deflection)
    position = np.random.default_rng(6).uniform([-4, -4, -0.6], [4, 4, 5], (2000, 3)).astype(dtype)
    velocity, at = np.zeros_like(position), position.astype(np.float64)
    advance(position, velocity, np.full(2000, 1e-9, dtype), Flutter.none(2000, dtype), wind, 1.5, 0.04)
    plain = wind.velocity(at, 1.52)
    np.testing.assert_allclose(velocity, plain, atol=tolerance)
    changed = np.linalg.norm(plain - WIND.velocity(at, 1.52), axis=1)
    assert (changed > 0.05).sum() > 200 and (changed < 1e-12).sum() > 200


def test_a_particle_that_is_nowhere_harms_nothing():
    corners = torch.tensor([[0.4, -2, -0.5], [0.4, 2, -0.5], [0.4, 0, 2.2]])
    deflection = Deflection.of(
        SurfaceMesh(corners, torch.tensor([[0, 1, 2]], dtype=torch.int32)), Domain((-2, -2, 0), (2, 2, 3)), Wind()
    )
    position, velocity, speed = particles(6, np.float64)
    position[:4] = [[np.nan] * 3, [np.inf] * 3, [-np.inf] * 3, [1e30, -1e30, 1e30]]
    wind = WindField.draw(Wind(turbulence=0.0), 3, deflection)
    assert np.isfinite(wind.velocity(position[3:], 0.0)).all()
    assert np.isnan(wind.velocity(position[:1], 0.0)).all()
    advance(position, velocity, speed, Flutter.none(6, np.float64), wind, 0.0, 0.04)
    assert np.isnan(position[0]).all() and np.isfinite(position[3:]).all()


def test_flutter_is_a_sideways_circle_of_the_given_speed():
    position, velocity, speed = particles(8, np.float64)
    flutter = Flutter(np.full(8, 0.2), np.full(8, 1.5), np.linspace(0, 1, 8))
    track = []
    for k in range(400):
        advance(position, velocity, speed, flutter, WIND.still(), k * 0.01, 0.01)
        track.append(velocity.copy())
    sideways = np.linalg.norm(np.array(track)[200:, :, :2], axis=2)
    lag = 1 / np.sqrt(1 + (2 * math.pi * 1.5 * speed / GRAVITY) ** 2)  # of a first-order follower
    np.testing.assert_allclose(sideways, 0.2 * np.broadcast_to(lag, sideways.shape), rtol=0.01)
    np.testing.assert_allclose(np.array(track)[200:, :, 2], np.broadcast_to(-speed, sideways.shape), atol=1e-6)


def test_the_step_is_second_order_in_changing_wind():
    def end(step: float) -> np.ndarray:
        position, velocity, speed = particles(100, np.float64)
        velocity[:] = WIND.velocity(position, 0.0) - np.stack([0 * speed, 0 * speed, speed], 1)
        for k in range(round(0.64 / step)):
            advance(position, velocity, speed, Flutter.none(100, np.float64), WIND, k * step, step)
        return position

    truth = end(0.000625)
    errors = [float(np.abs(end(step) - truth).mean()) for step in (0.04, 0.02, 0.01)]
    assert errors[0] < 5e-4  # half a millimetre after 0.64 s
    assert errors[0] / errors[1] > 3.2
    assert errors[1] / errors[2] > 3.2


def test_the_polynomials_are_sine_and_cosine():
    r = np.linspace(-0.5, 0.5, 10_001)
    assert np.abs(r * np.polyval(_SINE[::-1], r * r) - np.sin(math.pi * r)).max() < 4e-9
    assert np.abs(np.polyval(_COSINE[::-1], r * r) - np.cos(math.pi * r)).max() < 3e-10
