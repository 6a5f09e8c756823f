"""What enters: the asked-for water, thinned counts, the spectrum of Gunn & Marshall."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import SNOWFALL, Wind
from pgsd_nerfstudio.effects.snowfall import fall_speed, mass, melted_diameter, number_density
from pgsd_nerfstudio.physics.air.emitters import CANDIDATES, Sizes, fill, outside
from pgsd_nerfstudio.physics.air.reach import FADE, kept, reaches, shown
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.scene.cameras import Cameras

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


EVERYWHERE = Sight.everything()


def camera(distance: float = 20.0) -> Sight:
    """The region of sight of a camera at the middle of one side that looks along y."""
    viewmat = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 2.0], [0, 1, 0, 3.0], [0, 0, 0, 1]])
    K = torch.tensor([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]])
    return Sight.of(
        DOMAIN, Cameras(viewmat[None], K[None], 640, 480), distance=distance, margin=0.0, slowest=0.9, fastest=1.4, wind=Wind()
    )


@pytest.mark.parametrize("most", [200, 5_000, 10**9])
def test_the_water_through_the_top_is_what_was_asked_for(most):
    """What is above the domain within a step's fall, and enters: the flux of each size is its number times its speed."""
    sizes = Sizes.of(SNOWFALL, DOMAIN, most, EVERYWHERE)
    rng, water, step, room = np.random.default_rng(0), 0.0, 0.04, np.array([[0, 0, 0], [0, 0, 0.06]])
    for _ in range(300):
        found = outside(sizes, DOMAIN, EVERYWHERE, room, rng)
        enters = found.positions[:, 2] - step * fall_speed(found.diameters) < DOMAIN.upper[2]
        diameters = found.diameters[enters]
        water += (sizes.represents(diameters, np.zeros(len(diameters))) * mass(diameters)).sum()
    rel = 0.03 if most > 200 else 0.06
    assert water / (300 * step) / DOMAIN.area * 3600 == pytest.approx(SNOWFALL.emission.intensity, rel=rel)


def test_the_air_around_the_domain_is_even_and_nothing_of_it_is_inside():
    sizes, room = Sizes.of(SNOWFALL, DOMAIN, 20_000, EVERYWHERE), np.array([[1.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    positions = outside(sizes, DOMAIN, EVERYWHERE, room, np.random.default_rng(0)).positions
    assert not ((positions > DOMAIN.lower) & (positions < DOMAIN.upper)).all(1).any()
    low, high = DOMAIN.lower - room[0], DOMAIN.upper + room[1]
    volume = np.prod(high - low) - DOMAIN.volume
    assert len(positions) == pytest.approx(20_000 * volume / DOMAIN.volume, rel=0.001)
    above = (positions[:, 2] > DOMAIN.upper[2]).sum() / (np.prod((high - low)[:2]) * 1.0)
    assert above == pytest.approx(20_000 / DOMAIN.volume, rel=0.05)


def test_the_number_in_the_air_is_bounded_and_otherwise_physical():
    few, all_of_them = (Sizes.of(SNOWFALL, DOMAIN, most, EVERYWHERE) for most in (1000, 10**9))
    found = fill(few, DOMAIN, EVERYWHERE, np.random.default_rng(0))
    stands_for = few.represents(found.diameters, np.zeros(len(found.diameters)))
    assert len(found.positions) == pytest.approx(1000, abs=2)
    assert stands_for.min() >= 1.0
    assert stands_for.sum() == pytest.approx(few.real_in_air * DOMAIN.volume, rel=0.03)
    assert all_of_them.represents(np.array([0.002, 0.01]), np.zeros(2)) == pytest.approx([1.0, 1.0])
    assert all_of_them.in_air()[-1] == pytest.approx(all_of_them.real_in_air, rel=1e-6)
    assert (found.reaches == 1e9).all()


@pytest.mark.parametrize("most", [3_000, 10**7])
def test_cameras_see_all_flakes_nearby_and_fewer_far_away(most):
    sight = camera()
    sizes = Sizes.of(SNOWFALL, DOMAIN, most, sight, 800.0)
    found = fill(sizes, DOMAIN, sight, np.random.default_rng(0))
    distances = sight.distances(found.positions)
    seen = (sight._look_up(sight.seen_distances, found.positions) <= found.reaches).sum()
    assert seen < 1.1 * most and len(found.positions) < 1.1 * max(CANDIDATES, 10 * most)
    assert (found.reaches >= distances).all()
    volume, edges = sight.cell.prod(), (0.4, 1.2, 2.5, 4.0, 7.0)
    for low, high in itertools.pairwise(edges):
        cells = ((sight.needed_distances >= low) & (sight.needed_distances < high)).sum()
        inside = (distances >= low) & (distances < high)
        real = sizes.real_in_air * cells * volume
        # All of them are stood for, near and far.
        if most > 10**6:  # with few, single ones have great weights
            assert sizes.represents(found.diameters, distances)[inside].sum() == pytest.approx(real, rel=0.06)
        if most > 10**6 and high * 1.15 < 800 * 0.0015:
            assert inside.sum() == pytest.approx(real, rel=0.02)


def test_particles_are_kept_as_their_reach_says():
    """P(reach > d) = (near / d)^3, also for those that are drawn at a distance."""
    rng, near = np.random.default_rng(0), np.full(200_000, 2.0)
    drawn = reaches(near, 0.0, rng.uniform(size=len(near)))
    far = reaches(near, 5.0, rng.uniform(size=len(near)))
    assert far.min() >= 5.0 - 1e-6
    for distance in (1.0, 2.5, 4.0, 8.0):
        assert (drawn > distance).mean() == pytest.approx(kept(np.array(2.0), distance), abs=0.003)
    assert (far > 8.0).mean() == pytest.approx((5 / 8) ** 3, abs=0.005)


def test_the_light_of_what_is_shown_is_that_of_the_fade():
    rng, near = np.random.default_rng(0), np.full(400_000, 2.0)
    drawn = reaches(near, 0.0, rng.uniform(size=len(near)))
    for distance in (1.0, 1.7, 1.9, 3.0, 6.0):
        faded = ((drawn / distance - 1) / FADE).clip(0, 1).mean()
        assert shown(np.array(2.0), np.array(distance)) == pytest.approx(faded, abs=0.004)


def test_larger_flakes_are_preferred_by_the_importance():
    def median(importance: float) -> float:
        effect = replace(SNOWFALL, emission=replace(SNOWFALL.emission, importance=importance))
        sizes = Sizes.of(effect, DOMAIN, 2000, EVERYWHERE)
        return float(np.median(fill(sizes, DOMAIN, EVERYWHERE, np.random.default_rng(0)).diameters))

    assert median(0.0) < median(1.0) < median(2.0)


def test_the_air_is_filled_evenly():
    sizes = Sizes.of(SNOWFALL, DOMAIN, 8000, EVERYWHERE)
    positions = fill(sizes, DOMAIN, EVERYWHERE, np.random.default_rng(0)).positions
    counts = np.histogramdd(positions, bins=2, range=[(-2, 2), (-3, 3), (0, 5)])[0]
    assert counts.min() > 900
    assert counts.max() < 1100
