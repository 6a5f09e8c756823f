"""The air: no divergence, the asked-for strength, calm at the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.air.wind import WindField


@pytest.mark.parametrize("heights", [(0.05, 0.6), (0.6, 3.0), (3.0, 20.0)])
def test_the_wind_has_no_divergence(heights):
    field = WindField.draw(Wind(), 1)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-5, 5, (300, 2)), rng.uniform(*heights, 300)])
    h, slopes = 1e-4, np.zeros((3, 3, 300))
    for axis in range(3):
        shift = h * np.eye(3)[axis]
        slopes[axis] = ((field.velocity(points + shift, 2.0) - field.velocity(points - shift, 2.0)) / (2 * h)).T
    divergence = sum(slopes[axis, axis] for axis in range(3))
    typical = np.sqrt((slopes**2).sum((0, 1)).mean())
    assert np.abs(divergence).max() < 1e-6 * typical


def test_turbulence_has_the_asked_for_strength_in_each_direction():
    wind = Wind(turbulence=0.25, gustiness=0.0)
    field = WindField.draw(wind, 2)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-50, 50, (20_000, 2)), rng.uniform(50, 80, 20_000)])
    turbulence = field.velocity(points, 0.0)
    turbulence[:, :2] -= field.mean * np.log1p(points[:, 2:] / wind.roughness) / math.log1p(2.0 / wind.roughness)
    rms = np.sqrt((turbulence**2).mean(0))
    assert np.sqrt((rms**2).mean()) == pytest.approx(0.25, rel=0.03)
    assert (np.abs(rms / 0.25 - 1) < 0.35).all()


def test_the_ground_slows_the_wind_by_the_logarithmic_law():
    field = WindField.draw(Wind(turbulence=0.0, gustiness=0.0, speed=2.0, roughness=0.03, reference_height=2.0), 0)
    heights = np.array([0.0, 0.5, 2.0, 4.0])
    speed = np.linalg.norm(field.velocity(np.column_stack([heights, heights, heights]), 7.0), axis=1)
    np.testing.assert_allclose(speed, 2.0 * np.log((heights + 0.03) / 0.03) / math.log(2.03 / 0.03), rtol=1e-12)


def test_air_stands_still_on_the_ground():
    points = np.column_stack([np.random.default_rng(0).uniform(-5, 5, (50, 2)), np.zeros(50)])
    assert np.abs(WindField.draw(Wind(), 0).velocity(points, 1.0)).max() < 1e-12


def test_gusts_vary_by_the_asked_for_share():
    field = WindField.draw(Wind(speed=3.0, gustiness=0.3, gust_seconds=4.0), 5)
    along = np.array([field.at_reference(t) for t in np.arange(0, 4000, 0.5)]) @ field.mean / 3.0
    assert along.mean() == pytest.approx(3.0, rel=0.02)
    assert along.std() == pytest.approx(0.9, rel=0.1)


def test_the_seed_decides_the_wind():
    point = np.array([[1.0, 2.0, 3.0]])
    first, again, other = (WindField.draw(Wind(), seed).velocity(point, 1.0) for seed in (4, 4, 5))
    assert (first == again).all()
    assert np.abs(first - other).max() > 1e-3


def test_eddies_are_carried_by_the_mean_wind():
    wind = Wind(gustiness=0.0, turbulence=0.2)
    field = WindField.draw(wind, 0)
    field = WindField(**{**vars(field), "drifts": 0 * field.drifts})
    points = np.random.default_rng(0).uniform(1, 3, (20, 3))
    later = points + 2.5 * np.append(field.mean, 0.0)
    np.testing.assert_allclose(field.velocity(later, 2.5), field.velocity(points, 0.0), atol=1e-12)


def test_a_wind_without_turbulence_needs_no_modes():
    field = WindField.draw(Wind(turbulence=0.0, modes=0), 0)
    assert np.isfinite(field.velocity(np.ones((3, 3)), 0.0)).all()
