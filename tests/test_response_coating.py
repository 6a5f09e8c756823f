"""Cover and water over time against closed forms and an integrator of ordinary differential equations."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.integrate import quad, solve_ivp

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.ground.wetness import Wetting
from pgsd_nerfstudio.response.coating import Coating, falling_mass, rained
from pgsd_nerfstudio.response.exposure import Exposure

N = 4000


def exposed(normal: tuple[float, float, float], catches: float = 1.0, loose: bool = False) -> Exposure:
    ones = torch.ones(N)
    return Exposure(torch.tensor(normal).expand(N, 3), torch.full((N,), loose), catches * ones, ones, ones)


def layers(what: Effect, normal: tuple[float, float, float] = (0.0, 0.0, 1.0), **kwargs) -> Coating:
    places = 5 * torch.rand(N, 3, generator=torch.Generator().manual_seed(0))
    return Coating.of(what, exposed(normal, **kwargs), places)


def test_open_ground_gets_the_precipitation_of_the_time_lapse():
    snow = effect("snowfall")
    # 1.5 mm/h of water for 10 s, 800 times faster, ten times as thick as water
    expected = 1.5e-3 / 3600 * 10 * 800 * 10
    assert layers(snow).thickness(10.0).mean() == pytest.approx(expected, rel=0.04)


def test_a_cover_never_shrinks_and_hides_more_and_more():
    lying = layers(effect("snowfall"))
    shares = torch.stack([lying.hidden(t) for t in torch.linspace(0, 12, 30).tolist()])
    assert (shares.diff(dim=0) >= 0).all() and shares[0].max() == 0 and shares[-1].mean() > 0.8 and shares.max() <= 1


def test_what_looks_down_stays_bare_and_walls_keep_a_film():
    snow = effect("snowfall")
    assert layers(snow, (0.0, 0.0, -1.0), catches=1.0).thickness(10.0).max() == 0
    steep = math.radians(65.0)
    wall = layers(snow, (math.sin(steep), 0.0, math.cos(steep))).thickness(1000.0)
    assert wall.max() == pytest.approx(snow.surface.film, rel=1e-5) and wall.min() > 0


def test_leaves_are_never_hidden_altogether():
    assert layers(effect("snowfall"), loose=True).hidden(1e6).max() < 0.75


def test_nothing_gathers_where_the_weather_does_not_accumulate():
    snow = effect("snowfall")
    bare = replace(snow, surface=replace(snow.surface, accumulates=False))
    assert layers(bare).hidden(10.0).max() == 0
    assert layers(effect("fog")).hidden(10.0).max() == 0 and layers(effect("fog")).wet(10.0).max() == 0
    assert layers(effect("rainfall")).hidden(10.0).max() == 0 and layers(snow).wet(10.0).max() == 0


@pytest.mark.parametrize("timeline", [Timeline(), Timeline(onset=4.0), Timeline(onset=2.0, ends=9.0), Timeline(ends=0.5)])
def test_water_follows_its_balance(timeline: Timeline):
    rain, tau = replace(effect("rainfall"), timeline=timeline), Wetting().drying_seconds
    for seconds in (0.0, 3.0, 30.0, 100.0):
        found = solve_ivp(
            lambda t, w: [(timeline.share(t) if t <= timeline.ends else 0.0) - w[0] / tau],
            (0.0, seconds), [0.0], max_step=0.05, rtol=1e-8,
        )  # fmt: skip
        assert rained(rain, seconds) == pytest.approx(found.y[0, -1], rel=0.01, abs=1e-3)


def test_what_is_wet_dries_after_the_rain():
    rain = replace(effect("rainfall"), timeline=Timeline(ends=20.0))
    lying = layers(rain)
    assert lying.wet(20.0).mean() > 0.5
    assert lying.wet(20.0 + 6 * Wetting().drying_seconds).mean() < 0.05
    water = lying.water(20.0).mean()
    assert water == pytest.approx(rained(rain, 20.0) * falling_mass(rain), rel=0.04)


@pytest.mark.parametrize("timeline", [Timeline(), Timeline(onset=3.0), Timeline(onset=3.0, ends=5.0)])
def test_fallen_is_the_integral_of_the_share(timeline: Timeline):
    for seconds in (0.0, 1.0, 3.0, 4.0, 11.0):
        rate = quad(lambda t: timeline.share(t), 0, min(seconds, timeline.ends))[0]
        assert timeline.fallen(seconds) == pytest.approx(rate, abs=1e-6)


def test_a_timeline_that_ends_before_its_onset_is_refused():
    with pytest.raises(ValueError, match="cannot end at 2 s"):
        Timeline(onset=3.0, ends=2.0)
    with pytest.raises(ValueError, match="onset"):
        Timeline(onset=-1.0)


def test_sand_comes_down_as_its_grains_do():
    sand = effect("sandstorm")
    denser = replace(sand, emission=replace(sand.emission, intensity=sand.emission.intensity / 2))
    assert falling_mass(denser) == pytest.approx(2 * falling_mass(sand), rel=1e-6)
