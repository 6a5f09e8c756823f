"""Fall speeds against published measurements and against laws that were made independently of ours."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pgsd_nerfstudio.physics.laws.fall_speeds import (
    AIR_DENSITY,
    AIR_VISCOSITY,
    QUARTZ_DENSITY,
    SPHERE_UP_TO,
    STANDARD_GRAVITY,
    STOKES_UP_TO,
    WATER_DENSITY,
    fog_fall_speed,
    rain_fall_speed,
    sand_fall_speed,
    snow_fall_speed,
)

GUNN_KINZER_1949 = {  # mm: cm/s, table 2
    0.3: 117, 0.4: 162, 0.5: 206, 0.6: 247, 0.7: 287, 0.8: 327, 0.9: 367, 1.0: 403, 1.2: 464, 1.4: 517, 1.6: 565, 1.8: 609,
    2.0: 649, 2.2: 690, 2.4: 727, 2.6: 757, 2.8: 782, 3.0: 806, 3.2: 826, 3.4: 844, 3.6: 860, 3.8: 872, 4.0: 883, 4.2: 892,
    4.4: 898, 4.6: 903, 4.8: 907, 5.0: 909, 5.2: 912, 5.4: 914, 5.6: 916, 5.8: 917,
}  # fmt: skip


@pytest.mark.parametrize(("mm", "cm_per_second"), GUNN_KINZER_1949.items())
def test_rain_falls_as_gunn_and_kinzer_measured(mm, cm_per_second):
    assert rain_fall_speed(np.array([1e-3 * mm]))[0] == pytest.approx(0.01 * cm_per_second, rel=0.03)


def test_rain_falls_as_atlas_srivastava_and_sekhon_fitted():
    millimetres = np.linspace(0.6, 5.8, 200)
    expected = 9.65 - 10.3 * np.exp(-0.6 * millimetres)
    np.testing.assert_allclose(rain_fall_speed(1e-3 * millimetres), expected, rtol=0.035)


def test_drizzle_falls_as_a_rigid_sphere():
    """Schiller & Naumann 1933, solved for the speed at which drag and weight agree."""
    for diameter in (30e-6, 60e-6, 100e-6, 150e-6, 200e-6, 300e-6):
        assert rain_fall_speed(np.array([diameter]))[0] == pytest.approx(sphere_speed(diameter), rel=0.03)


def sphere_speed(diameter: float) -> float:
    low, high = 0.0, 10.0
    for _ in range(80):
        speed = (low + high) / 2
        reynolds = AIR_DENSITY * speed * diameter / AIR_VISCOSITY
        drag = 24 / reynolds * (1 + 0.15 * reynolds**0.687) * math.pi / 8 * AIR_DENSITY * (diameter * speed) ** 2
        weight = math.pi / 6 * diameter**3 * (WATER_DENSITY - AIR_DENSITY) * STANDARD_GRAVITY
        low, high = (low, speed) if drag > weight else (speed, high)
    return low


@pytest.mark.parametrize("at", [STOKES_UP_TO, SPHERE_UP_TO])
def test_the_regimes_of_rain_meet(at):
    below, above = rain_fall_speed(at * np.array([1 - 1e-9, 1 + 1e-9]))
    assert above == pytest.approx(below, rel=2.5e-3)


def test_larger_drops_fall_faster_up_to_the_largest_that_were_measured():
    speeds = rain_fall_speed(np.geomspace(1e-6, 5.8e-3, 2000))
    assert (np.diff(speeds) > -0.0025 * speeds[1:]).all()  # the joints of the regimes
    assert (np.diff(rain_fall_speed(np.geomspace(1.08e-3, 5.8e-3, 500))) > 0).all()


def test_fog_of_20_micrometres_sinks_at_12_millimetres_per_second():
    assert fog_fall_speed(np.array([20e-6]))[0] == pytest.approx(0.012, rel=0.01)


@pytest.mark.parametrize(("micrometres", "factor"), [(1, 1.155), (5, 1.032), (10, 1.016), (20, 1.0), (50, 0.959), (100, 0.83)])
def test_fog_obeys_stokes_slips_when_small_and_lags_when_large(micrometres, factor):
    """Cunningham's factors: Hinds, Aerosol Technology (1999), table A11; lag: Oseen at 50 µm, Schiller & Naumann at 100 µm."""
    diameter = 1e-6 * micrometres
    stokes = (998.2 - 1.204) * 9.80665 * diameter**2 / (18 * 1.818e-5)
    assert fog_fall_speed(np.array([diameter]))[0] / stokes == pytest.approx(factor, rel=0.015)


@pytest.mark.parametrize("micrometres", [63, 100, 150, 200, 300, 500, 1000])
def test_sand_falls_as_soulsby_found(micrometres):
    """Soulsby, Dynamics of Marine Sands (1997), eq. 102: a law of the grain number D*, fitted to other measurements.

    The grain numbers of sand in air, 3-46, are those of grains of 0.1-1.9 mm in water, where it was fitted.
    """
    diameter, viscosity = 1e-6 * micrometres, AIR_VISCOSITY / AIR_DENSITY
    grain = diameter * (STANDARD_GRAVITY * (QUARTZ_DENSITY / AIR_DENSITY - 1) / viscosity**2) ** (1 / 3)
    expected = viscosity / diameter * (math.sqrt(10.36**2 + 1.049 * grain**3) - 10.36)
    assert sand_fall_speed(np.array([diameter]))[0] == pytest.approx(expected, rel=0.12)


def test_fine_dust_obeys_stokes_and_gravel_a_constant_drag():
    dust, gravel = 10e-6, 5e-3
    stokes = (2650 - 1.204) * 9.80665 * dust**2 / (18 * 1.818e-5)
    assert sand_fall_speed(np.array([dust]))[0] == pytest.approx(stokes, rel=0.02)
    heavy = math.sqrt(4 / 3 * (2650 / 1.204 - 1) * 9.80665 * gravel / 1.0)
    assert sand_fall_speed(np.array([gravel]))[0] == pytest.approx(heavy, rel=0.06)


def test_snow_falls_by_the_law_of_its_effect():
    np.testing.assert_allclose(snow_fall_speed(np.array([0.001, 0.002, 0.010])), [0.8, 0.894, 1.156], rtol=1e-3)


@pytest.mark.parametrize(
    ("speed", "wrong", "message"),
    [
        (rain_fall_speed, 8e-3, r"raindrop diameters must lie in 0\.001-7 mm, found 8 mm"),
        (fog_fall_speed, 300e-6, r"fog droplet diameters must lie in 0\.001-0\.2 mm, found 0\.3 mm"),
        (sand_fall_speed, 1e-6, r"sand grain diameters must lie in 0\.01-5 mm, found 0\.001 mm"),
        (snow_fall_speed, 0.0, r"snowflake diameters must lie in 1-12 mm, found 0 mm"),
        (rain_fall_speed, math.nan, "found nan mm"),
    ],
)
def test_what_no_law_was_made_for_is_refused(speed, wrong, message):
    with pytest.raises(ValueError, match=message):
        speed(np.array([2e-3 if speed is snow_fall_speed else 20e-6, wrong]))


def test_ends_of_the_range_survive_float32_and_nothing_gives_nothing():
    for speed, ends in ((rain_fall_speed, (1e-6, 7e-3)), (fog_fall_speed, (1e-6, 200e-6)), (sand_fall_speed, (10e-6, 5e-3))):
        assert np.isfinite(speed(np.array(ends, np.float32))).all()
        assert len(speed(np.zeros(0))) == 0
