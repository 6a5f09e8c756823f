"""Rings on water against the integral of Cauchy and Poisson, and the dispersion against an independent wave equation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, trapezoid
from scipy.special import j0

from pgsd_nerfstudio.physics.laws.water_waves import (
    DENSITY,
    GRAVITY,
    TENSION,
    VISCOSITY,
    Ring,
    crater_depth,
    elevation,
    frequency,
    group_speed,
    transform,
)


def test_the_slowest_wave_is_the_one_that_lamb_gives():
    """Lamb, section 267: the least phase speed on deep water is 23.2 cm/s, at a wave length of 1.72 cm."""
    k = np.geomspace(50, 5000, 20001)
    speed = frequency(k, 1.0) / k
    assert speed.min() == pytest.approx(0.232, rel=0.01)
    assert 2 * np.pi / k[speed.argmin()] == pytest.approx(0.0172, rel=0.01)


@pytest.mark.parametrize("depth", [0.003, 0.01, 1.0])
def test_the_group_speed_is_the_slope_of_the_dispersion(depth: float):
    k = np.geomspace(20, 3000, 50)
    step = 1e-4 * k
    numeric = (frequency(k + step, depth) - frequency(k - step, depth)) / (2 * step)
    assert group_speed(k, depth) == pytest.approx(numeric, rel=1e-6)


def test_a_ring_is_the_integral_of_cauchy_and_poisson():
    spread, depth = 0.004, 0.005
    radii = np.array([0.0, 0.01, 0.03, 0.08])
    for seconds in (0.0, 0.05, 0.3):

        def integrand(k: float, r: float, seconds: float = seconds) -> float:
            turning = np.cos(frequency(np.array([k]), depth)[0] * seconds) * np.exp(-2 * VISCOSITY * k**2 * seconds)
            return float(-(spread**4) * k**2 / 2 * np.exp(-((k * spread) ** 2) / 2) * j0(k * r) * turning * k)

        expected = [quad(integrand, 0, 8 / spread, args=(r,), limit=800, epsabs=1e-10)[0] for r in radii]
        assert elevation(radii, seconds, spread, depth) == pytest.approx(expected, abs=1e-5)
    first = -(1 - radii**2 / (2 * spread**2)) * np.exp(-(radii**2) / (2 * spread**2))
    assert elevation(radii, 0.0, spread, depth) == pytest.approx(first, abs=1e-5)


def test_the_table_of_slopes_is_the_slope_of_the_elevation():
    ring = Ring.of(0.004, 0.005, seconds=0.4, radius=0.2, dt=0.01, dr=0.001)
    radii, step = np.array([0.02, 0.05, 0.1]), 1e-6
    for index in (3, 10, 30):
        seconds = index * ring.dt
        rise = elevation(radii + step, seconds, 0.004, 0.005) - elevation(radii - step, seconds, 0.004, 0.005)
        assert ring.slopes[index, [20, 50, 100]] == pytest.approx(
            rise / (2 * step), abs=2e-4 * np.abs(ring.slopes[index]).max()
        )


def test_the_energy_of_a_crater_is_that_of_its_shape():
    r = np.linspace(0, 0.05, 20001)
    depth, s = crater_depth(np.array([4e-6]), np.array([0.004]))[0], 0.004
    shape = -depth * (1 - r**2 / (2 * s**2)) * np.exp(-(r**2) / (2 * s**2))
    per_ring = (DENSITY * GRAVITY * shape**2 + TENSION * np.gradient(shape, r) ** 2) / 2 * 2 * np.pi * r
    assert trapezoid(per_ring, r) == pytest.approx(4e-6, rel=1e-4)


def test_viscosity_takes_short_waves_first():
    k = np.array([200.0, 2000.0])
    left = np.exp(-2 * VISCOSITY * k**2 * 0.5)
    assert left[0] > 0.95 and left[1] < 0.05
    assert abs(transform(k, 0.004)).max() > 0
