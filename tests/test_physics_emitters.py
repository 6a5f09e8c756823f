"""What enters: the asked-for water, thinned counts, the spectrum of Gunn & Marshall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pgsd_nerfstudio.effects import SNOWFALL
from pgsd_nerfstudio.effects.snowfall import fall_speed, mass, melted_diameter, number_density
from pgsd_nerfstudio.physics.air.emitters import Sizes, feed, fill
from pgsd_nerfstudio.physics.clock import Domain

DOMAIN = Domain((-2.0, -3.0, 0.0), (2.0, 3.0, 5.0))


@pytest.mark.parametrize("rate", [0.5, 1.0, 1.5])
def test_gunn_and_marshall_bring_about_the_rate_they_are_named_by(rate):
    """Their spectrum, with the fall speeds and masses of Locatelli & Hobbs: the two fits must agree on the water."""
    diameter = np.geomspace(1e-4, 0.1, 20_000)
    masses = mass(diameter)
    melted = melted_diameter(masses)
    flux = number_density(melted, rate) * masses * fall_speed(diameter) * np.gradient(melted)
    assert flux.sum() * 3600 == pytest.approx(rate, rel=0.25)


def test_fall_speeds_are_those_of_locatelli_and_hobbs():
    np.testing.assert_allclose(fall_speed(np.array([0.001, 0.002, 0.005, 0.010])), [0.8, 0.894, 1.035, 1.156], rtol=1e-3)
    np.testing.assert_allclose(mass(np.array([0.001, 0.010])), [0.073e-6, 1.8337e-6], rtol=1e-4)


def test_a_drop_weighs_what_its_melted_diameter_says():
    assert melted_diameter(np.array([np.pi / 6 * 1e-6]))[0] == pytest.approx(1e-3)


@pytest.mark.parametrize("most", [200, 5_000, 10**9])
def test_the_water_through_the_top_is_what_was_asked_for(most):
    sizes = Sizes.of(SNOWFALL, DOMAIN.volume, most)
    rng, carry, water, seconds = np.random.default_rng(0), 0.0, 0.0, 8.0
    for _ in range(200):
        _, diameters, _, carry = feed(sizes, DOMAIN, carry, seconds / 200, rng)
        water += (sizes.represents(diameters) * mass(diameters)).sum()
    assert water / seconds / DOMAIN.area * 3600 == pytest.approx(SNOWFALL.emission.intensity, rel=0.03)


def test_the_number_in_the_air_is_bounded_and_otherwise_physical():
    few, all_of_them = Sizes.of(SNOWFALL, DOMAIN.volume, 1000), Sizes.of(SNOWFALL, DOMAIN.volume, 10**9)
    positions, diameters = fill(few, DOMAIN, np.random.default_rng(0))
    assert len(positions) == pytest.approx(1000, abs=2)
    assert few.represents(diameters).min() >= 1.0
    assert few.represents(diameters).sum() == pytest.approx(few.real_in_air * DOMAIN.volume, rel=0.03)
    assert all_of_them.represents(np.array([0.002, 0.01])) == pytest.approx([1.0, 1.0])
    assert all_of_them.in_air[-1] == pytest.approx(all_of_them.real_in_air, rel=1e-6)


def test_larger_flakes_are_preferred_by_the_importance():
    def median(importance: float) -> float:
        effect = replace(SNOWFALL, emission=replace(SNOWFALL.emission, importance=importance))
        return float(np.median(fill(Sizes.of(effect, 100.0, 2000), DOMAIN, np.random.default_rng(0))[1]))

    assert median(0.0) < median(1.0) < median(2.0)


def test_the_air_is_filled_evenly():
    positions, _ = fill(Sizes.of(SNOWFALL, DOMAIN.volume, 8000), DOMAIN, np.random.default_rng(0))
    counts = np.histogramdd(positions, bins=2, range=[(-2, 2), (-3, 3), (0, 5)])[0]
    assert counts.min() > 900
    assert counts.max() < 1100
