"""Size distributions: closed forms of others, drawn samples against them, and the water that rain brings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pgsd_nerfstudio.physics.laws.fall_speeds import fog_fall_speed, sand_fall_speed
from pgsd_nerfstudio.physics.laws.size_distributions import (
    Exponential,
    LogNormal,
    advection_fog,
    blown_sand,
    coarse_sand,
    desert_dust,
    extinction,
    marshall_palmer,
    mass,
    radiation_fog,
    rain_rate,
    visibility,
    with_rain_rate,
)

MARSHALL_PALMER = marshall_palmer(5.0)
FOG = advection_fog()
ALL = [MARSHALL_PALMER, FOG, radiation_fog(), blown_sand(0.01), coarse_sand(0.01), *desert_dust(1e-3)]


@pytest.mark.parametrize("rate", [0.5, 2.0, 10.0, 25.0])
def test_marshall_palmer_has_the_water_and_the_reflectivity_it_is_known_for(rate):
    """M = 0.089 R^0.84 g/m^3 and Z = 296 R^1.47 mm^6/m^3 follow from the unbounded distribution."""
    drops = marshall_palmer(rate, smallest=0.0, largest=math.inf)
    assert 1e3 * mass(drops, 1000.0) == pytest.approx(0.089 * rate**0.84, rel=0.01)
    assert 1e18 * drops.moment(6) == pytest.approx(296 * rate**1.47, rel=0.01)
    assert drops.density(np.array([0.0]))[0] == pytest.approx(8e6)  # 8000 per m^3 and mm


@pytest.mark.parametrize("rate", [0.1, 1.0, 5.0, 25.0, 100.0, 200.0])
def test_marshall_palmer_brings_about_the_rate_it_is_named_by(rate):
    assert 0.94 * rate < rain_rate(marshall_palmer(rate)) < 1.19 * rate


def test_the_flux_is_the_moments_of_atlas_fall_speeds():
    """With v = a - b exp(-c D), the flux of an unbounded exponential is a sum of two third moments in closed form."""
    drops = marshall_palmer(5.0, smallest=0.0, largest=math.inf)
    slower = replace(drops, slope=drops.slope + 600.0)
    expected = 3.6e6 * math.pi / 6 * (9.65 * drops.moment(3) - 10.3 * slower.moment(3))
    assert rain_rate(drops, lambda d: 9.65 - 10.3 * np.exp(-600 * d)) == pytest.approx(expected, rel=2e-4)  # D up to 7 mm


@pytest.mark.parametrize("rate", [0.5, 5.0, 50.0])
def test_rescaled_rain_brings_exactly_the_rate(rate):
    drops = with_rain_rate(marshall_palmer(rate), rate)
    assert rain_rate(drops) == pytest.approx(rate, rel=1e-12)
    assert drops.slope == marshall_palmer(rate).slope
    with_speed = with_rain_rate(drops, 2.0, lambda d: 1.0 + 0 * d)
    assert 3.6e6 * math.pi / 6 * with_speed.moment(3) == pytest.approx(2.0, rel=1e-5)


def test_sampled_rain_brings_exactly_the_rate_too():
    drops, rng = with_rain_rate(MARSHALL_PALMER, 5.0), np.random.default_rng(0)
    from pgsd_nerfstudio.physics.laws.fall_speeds import rain_fall_speed

    diameter = drops.sample(400_000, rng)
    water = drops.moment(0) * np.mean(np.pi / 6 * diameter**3 * rain_fall_speed(diameter))
    assert 3.6e6 * water == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize("which", range(len(ALL)))
@pytest.mark.parametrize("order", [0, 1, 2, 3, 6])
def test_moments_are_the_integrals_of_the_density(which, order):
    some = ALL[which]
    diameter = np.geomspace(max(some.smallest, 1e-10), min(some.largest, 1e-2), 200_001)
    integrand = diameter**order * some.density(diameter)
    assert some.moment(order) == pytest.approx(np.sum((integrand[1:] + integrand[:-1]) / 2 * np.diff(diameter)), rel=1e-5)


@pytest.mark.parametrize("which", range(len(ALL)))
def test_samples_follow_the_density(which):
    some = ALL[which]
    drawn = some.sample(20_000, np.random.default_rng(which))
    assert drawn.min() >= some.smallest and drawn.max() <= some.largest
    part = [
        replace(some, largest=float(end)).moment(0) / some.moment(0) for end in np.quantile(drawn, np.linspace(0.02, 0.98, 49))
    ]
    assert np.abs(part - np.linspace(0.02, 0.98, 49)).max() < 1.63 / math.sqrt(20_000)  # Kolmogorov, 1 %


def test_log_normals_are_those_of_scipy():
    some = LogNormal(number=7.0, median=3e-4, spread=1.7)
    other = stats.lognorm(s=math.log(1.7), scale=3e-4)
    diameter = np.array([1e-4, 3e-4, 2e-3])
    np.testing.assert_allclose(some.density(diameter), 7.0 * other.pdf(diameter), rtol=1e-12)
    assert some.moment(3) == pytest.approx(7.0 * other.moment(3), rel=1e-9)


def test_the_seed_decides_the_sample():
    first, again, other = (FOG.sample(5, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).all()


@pytest.mark.parametrize(("fog", "count", "power", "slope"), [(advection_fog, 20e6, 3, 0.3e6), (radiation_fog, 200e6, 6, 3e6)])
def test_fog_dims_light_and_holds_water_as_the_gamma_models_do(fog, count, power, slope):
    """The gamma distributions of Shettle & Fenn, of which the log-normal shares extinction, effective radius and variance."""
    radius = stats.gamma(power + 1, scale=1 / slope)
    some = fog()
    assert extinction(some) == pytest.approx(2 * math.pi * count * radius.moment(2), rel=0.01)
    assert mass(some, 1000.0) == pytest.approx(4 / 3 * math.pi * 1000 * count * radius.moment(3), rel=0.01)
    assert some.moment(4) / some.moment(2) == pytest.approx(4 * radius.moment(4) / radius.moment(2), rel=0.02)


def test_visibility_in_fog_is_that_of_koschmieder():
    assert visibility(FOG) == pytest.approx(2.9957 / extinction(FOG), rel=1e-4)
    assert visibility(FOG, 0.02) == pytest.approx(3.912 / extinction(FOG), rel=1e-4)
    assert visibility(FOG, 0.02) == pytest.approx(140, rel=0.01)
    assert visibility(radiation_fog(), 0.02) == pytest.approx(500, rel=0.01)


@pytest.mark.parametrize(("sand", "median"), [(blown_sand, 158e-6), (coarse_sand, 707e-6)])
def test_half_of_the_mass_of_sand_is_in_grains_below_its_median(sand, median):
    some = replace(sand(0.02), smallest=0.0, largest=math.inf)
    assert mass(some, 2650.0) == pytest.approx(0.02, rel=1e-9)
    assert replace(some, largest=median).moment(3) == pytest.approx(some.moment(3) / 2, rel=1e-9)
    assert replace(some, largest=2 * median).moment(3) == pytest.approx(0.8413 * some.moment(3), rel=1e-3)


def test_dust_is_mostly_of_its_second_mode():
    modes = desert_dust(1e-3)
    shares = np.array([mass(mode, 2650.0) for mode in modes]) / 1e-3
    np.testing.assert_allclose(shares, [0.036, 0.957, 0.007], rtol=1e-9)


def test_every_drawn_size_has_a_fall_speed():
    rng = np.random.default_rng(0)
    for some, speed in ((FOG, fog_fall_speed), (radiation_fog(), fog_fall_speed), (blown_sand(1), sand_fall_speed)):
        assert np.isfinite(speed(some.sample(10_000, rng))).all()
    assert np.isfinite(sand_fall_speed(coarse_sand(1).sample(10_000, rng))).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: marshall_palmer(0.0), r"must lie in 0\.1-200 mm/h, got 0"),
        (lambda: marshall_palmer(math.nan), "got nan"),
        (lambda: Exponential(intercept=1.0, slope=0.0), "must be positive, got 1 /m"),
        (lambda: LogNormal(number=1.0, median=1e-3, spread=1.0), "spread above 1, got 1 /m"),
        (lambda: marshall_palmer(1.0, smallest=2e-3, largest=1e-3), r"got 0\.002 and 0\.001 m"),
    ],
)
def test_bad_distributions_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
