"""Each knob of a weather obeys its law, is the same flag in three commands, and refuses what it cannot do in one sentence.

Judges: physics for water, extinction and moving air; the two protocols of language models through local servers; hexadecimal
colours by arithmetic.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro
from test_effects_language_model import GOOD, KEY, keys, needs_library, protocol, serving  # noqa: F401

from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.cli.preview import Preview
from pgsd_nerfstudio.cli.simulate import Simulate
from pgsd_nerfstudio.effects import EFFECTS, FOG, RAINFALL, SANDSTORM, SNOWFALL, Effect
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.application import applied
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.options import EffectOptions, colour_of, legible
from pgsd_nerfstudio.effects.reader import read
from pgsd_nerfstudio.effects.tint import in_matter, mixed_evenly
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.laws.populations import extinction, fall_speed, integral, number_density
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.weather.options import SceneOptions, SimulationOptions

NAMES = sorted(EFFECTS)
COMMANDS = (Preview, Simulate, RunOptions)


def turned(name: str = "snowfall", **knobs: Any) -> Effect:
    return EffectOptions(effect=name, **knobs).resolve()[0]


def said(**knobs: Any) -> str:
    return "\n".join(EffectOptions(**knobs).resolve()[1])


def changed(effect: Effect, base: Effect) -> set[str]:
    """Parts that differ, as part.field where both have the part."""
    found = set[str]()
    for part, (new, old) in ((f.name, (getattr(effect, f.name), getattr(base, f.name))) for f in fields(Effect)):
        if new == old:
            continue
        inner = {} if new is None or old is None or isinstance(new, str) else asdict(new)
        found |= {f"{part}.{name}" for name in inner if getattr(new, name) != getattr(old, name)} or {part}
    return found


# Laws.


@pytest.mark.parametrize("name", NAMES)
def test_knobs_that_nobody_turned_give_the_effect_itself(name):
    assert EffectOptions(effect=name).resolve() == (EFFECTS[name], legible(EFFECTS[name]))


@pytest.mark.parametrize("name", NAMES)
def test_twice_the_amount_is_twice_the_water_or_the_extinction(name):
    effect, base = turned(name, amount=2.0), EFFECTS[name]
    if base.emission.precipitates:
        diameter = np.geomspace(base.emission.smallest, base.emission.largest, 2048)
        flux = number_density(diameter, effect.emission, effect.material) * fall_speed(diameter, effect.material)
        rate = 3600 * integral(flux * effect.material.mass(diameter), diameter)  # kg/(m^2 h), which is mm/h
        assert rate == pytest.approx(2 * base.emission.intensity, rel=1e-6)
    else:
        assert effect.emission.intensity == base.emission.intensity / 2
        assert extinction(effect.emission) == pytest.approx(2 * extinction(base.emission))


def test_an_amount_is_of_the_intensity_that_is_given():
    assert turned(intensity=2.0, amount=3.0).emission.intensity == 6.0
    assert turned("fog", intensity=200.0, amount=4.0).emission.intensity == 50.0
    assert "would be 150 mm/h of water, but snowfall takes 0.01-100: 100 is used" in said(intensity=50.0, amount=3.0)


def test_particles_are_wider_by_the_size():
    assert turned(size=2.0).emission.largest == 2 * SNOWFALL.emission.largest
    drop = turned("rainfall", size=2.0)
    assert drop.emission == RAINFALL.emission  # a drop twice as wide would break up: its picture is
    wide, own = (each.appearance.active.scale_per_diameter for each in (drop, RAINFALL))
    assert wide == pytest.approx([2 * axis for axis in own])
    # Light as a petal: an enlarged flake has the mass of the flake that it is a copy of.
    wide_flake, flake = np.array([0.004]), np.array([0.002])
    assert turned(size=2.0).material.mass(wide_flake) == pytest.approx(SNOWFALL.material.mass(flake))


@pytest.mark.parametrize("name", NAMES)
def test_gusts_and_turbulence_keep_their_share_of_the_mean_wind(name):
    points = np.random.default_rng(0).uniform(1, 10, (40, 3))
    own, strong = (WindField.draw(each.wind, seed=0) for each in (EFFECTS[name], turned(name, wind=7.5)))
    assert np.linalg.norm(strong.mean) == pytest.approx(7.5)
    ratio = 7.5 / np.linalg.norm(own.mean)
    # At the first moment, before the wind has carried its pattern along.
    np.testing.assert_allclose(strong.velocity(points, 0.0), ratio * own.velocity(points, 0.0), rtol=1e-6, atol=1e-9)
    still = WindField.draw(turned(name, wind=0.0).wind, seed=0)
    assert abs(still.velocity(points, 3.0)).max() == 0 and turned(name, wind=0.0).wind.diffusivity == 0


def test_the_wind_blows_to_where_it_is_asked_to():
    mean = WindField.draw(turned(wind=4.0, wind_direction=120.0).wind, seed=0).mean
    np.testing.assert_allclose(mean, 4 * np.array([-0.5, math.sqrt(0.75)]), rtol=1e-12)
    assert changed(turned(wind_direction=-90), SNOWFALL) == {"wind.direction_degrees"}


def test_wind_after_words_of_still_air_has_turbulence_again():
    words = EffectOptions(weather="purple snow, no wind")
    assert words.resolve()[0].wind.speed == 0
    assert replace(words, wind=2 * SNOWFALL.wind.speed).resolve()[0].wind == turned(wind=2 * SNOWFALL.wind.speed).wind
    assert turned(wind=2 * SNOWFALL.wind.speed).wind.turbulence == pytest.approx(2 * SNOWFALL.wind.turbulence)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("text", ["purple", "Purple", "#800080", "#800080".upper()])
def test_a_colour_by_name_is_that_colour_in_hexadecimal(name, text):
    """It tints the effect's matter, as words do: lit matter is no colour of a display."""
    effect, own, purple = turned(name, color=text), EFFECTS[name], (128 / 255, 0, 128 / 255)
    for state, plain in (
        (effect.appearance.active, own.appearance.active),
        (effect.appearance.collided, own.appearance.collided),
    ):
        assert state.rgb == pytest.approx(in_matter(plain.rgb, purple, own.emission.kind))
    assert effect == turned(name, color="purple")
    hazy = replace(Haze(), rgb=(0.5, 0.5, 0.5))
    mixed = applied(read("purple snow").request, base=replace(SNOWFALL, haze=hazy)).haze
    tinted = in_matter(hazy.rgb, (128 / 255, 0, 128 / 255), "snowflakes")
    assert mixed is not None and mixed.rgb == pytest.approx(mixed_evenly(hazy.rgb, tinted, 0.35))


def test_a_colour_for_what_is_no_weather_is_its_own():
    red = EffectOptions(weather="confetti", color="red").resolve()[0]
    assert red.appearance == EffectOptions(weather="red confetti").resolve()[0].appearance
    assert red.appearance.active.rgb == (1.0, 0.0, 0.0)


def test_short_hexadecimal_is_written_out_and_names_of_the_survey_are_known():
    assert colour_of("color", "#84c") == colour_of("color", "#8844cc") == pytest.approx((136 / 255, 68 / 255, 204 / 255))
    assert colour_of("color", "  dusty   rose ") == pytest.approx((192 / 255, 115 / 255, 122 / 255))  # XKCD: #c0737a


@pytest.mark.parametrize("name", NAMES)
def test_haze_is_made_denser_and_coloured_by_itself(name, monkeypatch):
    base = replace(EFFECTS[name], haze=Haze(amount=1.5, patchiness=0.5))
    monkeypatch.setitem(EFFECTS, name, base)
    effect = turned(name, haze=2.0, haze_color="#336699")
    assert changed(effect, base) == {"haze.amount", "haze.rgb"}
    assert effect.haze is not None and effect.haze.amount == 3.0 and effect.haze.rgb == pytest.approx((0.2, 0.4, 0.6))
    clear = turned(name, haze=0.0).haze
    assert clear is not None and clear.amount == 0.0
    both = turned(name, haze_color="#336699", color="red").haze
    assert both is not None and both.rgb == pytest.approx((0.2, 0.4, 0.6))


def test_where_there_is_no_haze_turning_it_is_said_to_do_nothing(monkeypatch):
    monkeypatch.setitem(EFFECTS, "snowfall", replace(SNOWFALL, haze=None))
    assert "change nothing: the air between the particles of snowfall is clear" in said(haze=2.0)
    assert "change nothing" in said(haze_color="red")
    assert said(haze=0.0) == ""


def test_a_weather_comes_within_its_onset_and_ends():
    effect = turned("rainfall", onset=4.0, ends=10.0)
    assert changed(effect, RAINFALL) <= {"timeline.onset", "timeline.ends"}
    assert [effect.timeline.share(t) for t in (0.0, 1.0, 4.0, 8.0)] == [0.0, 0.25, 1.0, 1.0]
    assert effect.timeline.fallen(60.0) == pytest.approx(2.0 + 6.0)
    assert not turned(onset=0.0).timeline.starts_clear


@pytest.mark.parametrize("name", NAMES)
def test_without_accumulation_nothing_gathers_or_wets(name):
    surface = turned(name, accumulation=False).surface
    assert surface.landing in ("vanishes", "glides") and not surface.accumulates
    assert (surface.landing == "glides") == (name == "fog")
    assert turned("rainfall", accumulation=False).surface.splash == RAINFALL.surface.splash  # drops still splash
    assert turned("snowfall", accumulation=False).appearance.collided.opacity == 0.0


def test_words_for_what_vanishes_raise_no_cover_even_if_they_do_not_stay():
    slides = replace(RAINFALL, surface=replace(RAINFALL.surface, accumulates=True))
    assert applied(read("rain that melts away, vanishing").request, base=slides).surface.accumulates is False


def test_the_time_lapse_of_a_cover_can_be_set_where_there_is_one():
    assert turned("sandstorm", accumulation_speedup=7.0).surface == replace(SANDSTORM.surface, accumulation_speedup=7.0)
    assert said(effect="sandstorm", accumulation_speedup=7.0, legibility=1.0) == ""
    assert turned("rainfall", accumulation_speedup=7.0).surface == replace(RAINFALL.surface, accumulation_speedup=7.0)
    for knobs in ({"effect": "rainfall", "puddles": False}, {"accumulation": False}):
        assert "--accumulation-speedup 7 changes nothing" in said(accumulation_speedup=7.0, **knobs)


@pytest.mark.parametrize("name", ["puddles", "ripples", "mirror", "drips"])
def test_what_rain_leaves_can_be_switched_off(name):
    assert turned("rainfall", **{name: False}).surface == replace(RAINFALL.surface, **{name: False})


@pytest.mark.parametrize("name", NAMES)
def test_light_and_exposure_are_knobs_of_their_own(name, monkeypatch):
    monkeypatch.setitem(EFFECTS, name, replace(EFFECTS[name], ambience=Ambience(clouds=0.5)))
    assert turned(name, ambience=False) == replace(EFFECTS[name], ambience=None)
    assert turned(name).ambience == Ambience(clouds=0.5)
    assert changed(turned(name, exposure=0.03), EFFECTS[name]) == {"appearance.exposure"}


def test_factors_of_words_and_knobs_multiply_and_what_is_given_in_a_unit_wins():
    words = EffectOptions(weather="heavy big rain")
    request = read("heavy big rain").request
    effect = replace(words, amount=1.5, size=1.2).resolve()[0]
    assert effect.emission.intensity == pytest.approx(RAINFALL.emission.intensity * request.amount * 1.5)
    own, wide = (each.appearance.active.scale_per_diameter[0] for each in (RAINFALL, effect))
    assert wide == pytest.approx(own * request.size * 1.2)
    effect, remarks = replace(words, intensity=3.0).resolve()
    assert effect.emission.intensity == 3.0
    assert "--intensity 3 takes the place of amount 2" in remarks
    assert effect.prompt == request.prompt
    # The visibility that is given, in as many parcels as if no word had been said.
    assert EffectOptions(weather="dense fog", intensity=FOG.emission.intensity).resolve()[0].emission == FOG.emission


def test_the_prompt_stays_that_of_effect_or_words():
    assert turned("fog", color="green", amount=2.0).prompt == FOG.prompt
    assert EffectOptions(weather="purple snow", color="green").resolve()[0].prompt == read("purple snow").request.prompt


# What is refused.

REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"intensity": -2}, "intensity must lie in 0.01-100 mm/h of water, got -2; heavy snow is about 3"),
    ({"intensity": 1e-9}, "intensity must lie in 0.01-100 mm/h of water, got 1e-09"),
    ({"intensity": 1e9}, "intensity must lie in 0.01-100 mm/h of water, got 1e+09"),
    ({"intensity": math.nan}, "intensity must lie in 0.01-100 mm/h of water, got nan"),
    ({"effect": "fog", "intensity": 0}, "intensity must lie in 5-10000 m of visibility, got 0"),
    ({"effect": "hail"}, "there is no effect 'hail'; known are: fog, rainfall, sandstorm, snowfall"),
    ({"amount": 0}, "--amount must lie in 0.1-5, got 0"),
    ({"amount": math.inf}, "--amount must lie in 0.1-5, got inf"),
    ({"size": 6}, "--size must lie in 0.2-5, got 6"),
    ({"size": 0.1}, "--size must lie in 0.2-5, got 0.1"),
    ({"size": math.nan}, "--size must lie in 0.2-5, got nan"),
    ({"wind": -1}, "--wind must lie in 0-40 m/s, got -1"),
    ({"wind": math.inf}, "--wind must lie in 0-40 m/s, got inf"),
    ({"wind_direction": 1e6}, "--wind-direction must lie in -360-360 degrees, got 1e+06"),
    ({"haze": -0.1}, "--haze must lie in 0-20, got -0.1"),
    ({"onset": -1}, "an onset must be a number of seconds, not negative, got -1"),
    ({"onset": math.inf}, "an onset must be a number of seconds, not negative, got inf"),
    ({"onset": 5, "ends": 2}, "a weather cannot end at 2 s, before it has come at 5 s"),
    ({"accumulation_speedup": 0}, "--accumulation-speedup must lie in 0.001-100000, got 0"),
    ({"exposure": 3}, "exposure must lie in 0-1 s, got 3; a film camera has about 0.02"),
    ({"color": "purpel"}, "--color must be a colour such as #8040c0 or purple, got 'purpel'; was 'purple' meant?"),
    ({"color": "#12345"}, "--color must be a colour such as #8040c0 or purple, got '#12345'"),
    ({"haze_color": ""}, "--haze-color must be a colour such as #8040c0 or purple, got ''"),
    (
        {"weather": "snow", "effect": "fog"},
        "--weather stands in place of --effect, got both 'snow' and fog: leave out one",
    ),
    ({"weather": "the meaning of life"}, "'the meaning of life' names nothing that could be in the air; say what falls"),
    ({"weather": ""}, "a text for the weather must have 1-400 characters, found 0"),
    ({"llm": "openai:x"}, "--llm openai:x needs words to ask about: add --weather"),
    ({"weather": "snow", "llm_url": "http://x"}, "--llm-url http://x needs the name of a model there: add --llm PROVIDER:NAME"),
    ({"weather": "snow", "llm": "gpt"}, "a language model must be named PROVIDER:NAME such as"),
    ({"weather": "snow", "llm": "openai:x", "llm_url": "ftp://x"}, "must begin with http:// or https:// and a host"),
]


@pytest.mark.parametrize(("knobs", "sentence"), REFUSED)
def test_what_cannot_be_used_is_refused_in_one_sentence(knobs, sentence):
    with pytest.raises(ValueError) as refused:
        EffectOptions(**knobs).resolve()
    assert sentence in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("command", ["preview", "simulate"])
def test_a_command_refuses_before_anything_is_written(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run([command, "--load-scene", "demo", "--color", "purpel"]) == 1
    assert capsys.readouterr().err.startswith("pgsd: --color must be a colour")
    assert list(tmp_path.iterdir()) == []


# Three commands, one set of flags.


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_holds_the_same_records(command):
    """So there is one text of --help, one default and one check of each option."""
    own = {field.name: field for field in fields(command)}
    for name, record in (("scene", SceneOptions), ("weather", EffectOptions), ("simulation", SimulationOptions)):
        assert own[name].default_factory is record, name
        redeclared = {field.name for field in fields(record)} & set(own) - {"scene", "weather", "simulation"}
        assert redeclared == set()


FLAGS = (
    "--weather", "glittering green snow", "--intensity", "2.5", "--exposure", "0.01", "--amount", "1.5", "--size", "0.5",
    "--wind", "3", "--wind-direction", "-45", "--color", "#204060", "--haze-color", "lavender", "--haze", "0.5", "--onset", "1",
    "--ends", "9", "--visibility", "koschmieder", "--accumulation", "False", "--ambience", "False",
    "--accumulation-speedup", "20", "--puddles", "False", "--ripples", "False", "--mirror", "False", "--drips", "False",
    "--legibility", "4",
)  # fmt: skip


def test_the_same_flags_mean_the_same_effect_in_all_commands():
    effects = []
    for command in COMMANDS:
        parsed = tyro.cli(command, args=["--load-scene", "demo", *FLAGS])
        assert {flag.lstrip("-").replace("-", "_") for flag in FLAGS[::2]} <= {field.name for field in fields(EffectOptions)}
        effects.append(parsed.weather.resolve())
    assert effects[0] == effects[1] == effects[2]
    effect = effects[0][0]
    assert (effect.emission.intensity, effect.wind.direction_degrees, effect.ambience) == (3.75, -45.0, None)


def test_flags_that_are_tried_here_are_all_there_are():
    assert {field.name for field in fields(EffectOptions)} - {flag.lstrip("-").replace("-", "_") for flag in FLAGS[::2]} == {
        "effect",
        "llm",
        "llm_url",
    }


# A language model.


@needs_library
def test_a_language_model_is_asked_once_and_said_to_have_been(protocol, tmp_path):  # noqa: F811
    with serving(protocol, json.dumps(GOOD)) as server:
        knobs = EffectOptions(weather="purple snow", llm=server.model, llm_url=server.url, size=2.0)
        effect, remarks = knobs.resolve(tmp_path)
        assert knobs.resolve(tmp_path) == (effect, remarks)
        assert len(server.asked) == 1
    assert remarks == [f"{server.model} was asked what 'purple snow' means: snowfall, rgb (0.50, 0.00, 0.50), glitter 0.3"]
    tinted = in_matter(SNOWFALL.appearance.collided.rgb, (0.5, 0.0, 0.5), "snowflakes")
    assert effect.appearance.collided.rgb == tinted and effect.prompt == GOOD["prompt"]
    assert effect.emission.largest == 2 * SNOWFALL.emission.largest
    (kept,) = tmp_path.iterdir()
    assert kept.name.startswith("request-") and json.loads(kept.read_text("utf-8"))["prompt"] == "purple snow"


@needs_library
@pytest.mark.parametrize("turn", ["I cannot do that.", json.dumps(GOOD | {"size": 50}), 401, 500, b"hello"])
def test_where_a_model_gives_no_usable_answer_the_reader_does_and_says_why(turn, tmp_path):
    with serving("openai", turn) as server:
        knobs = EffectOptions(weather="purple snow", llm=server.model, llm_url=server.url)
        effect, (remark, *_) = knobs.resolve(tmp_path)
        count = len(server.asked)
        assert knobs.resolve(tmp_path)[0] == effect and len(server.asked) == count  # not asked in vain over and over
    assert effect == EffectOptions(weather="purple snow").resolve()[0]
    assert ". The built-in reader answers instead: understood snow = snowfall; purple = colour" in remark
    assert KEY not in remark and "\n" not in remark
    assert list(tmp_path.iterdir()) == []


@needs_library
def test_without_network_or_key_the_run_goes_on(protocol, tmp_path, monkeypatch):  # noqa: F811
    with serving(protocol) as server:
        pass
    knobs = EffectOptions(weather="purple snow", llm=server.model, llm_url=server.url)
    assert "cannot be reached" in knobs.resolve(tmp_path)[1][0]
    monkeypatch.delenv(f"{protocol.upper()}_API_KEY")
    remark = replace(knobs, weather="green snow").resolve(tmp_path)[1][0]
    assert "needs a key in the environment" in remark and "The built-in reader answers instead" in remark


def test_without_the_library_the_run_goes_on_too(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "any_llm", None)
    remark = EffectOptions(weather="purple snow", llm="openai:x").resolve(tmp_path)[1][0]
    assert "pip install 'pgsd-nerfstudio[llm]'. The built-in reader answers instead: understood snow" in remark


def test_words_that_nobody_understands_are_refused_with_both_reasons(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "any_llm", None)
    with pytest.raises(ValueError, match=r"pip install .*\. The built-in reader was asked instead: 'bliss' names nothing"):
        EffectOptions(weather="bliss", llm="openai:x").resolve(tmp_path)


@needs_library
def test_a_preview_keeps_the_answer_in_the_cache_where_training_finds_it(yard, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "cache"))
    with serving("openai", json.dumps(GOOD)) as server:
        words = ["--load-scene", yard[0], "--data", yard[1], "--output", tmp_path / "v.mp4", "--views", 0, 99]
        words += ["--weather", "purple snow", "--llm", server.model, "--llm-url", server.url]
        assert run(["preview", *map(str, words)]) == 1  # for want of view 99
        told = capsys.readouterr().err.splitlines()
        assert told[0] == "asking openai:test-model what 'purple snow' means"
        assert told[1].startswith("openai:test-model was asked what 'purple snow' means: snowfall, rgb")
        words = EffectOptions(weather="purple snow", llm=server.model, llm_url=server.url)
        asked = len(server.asked)
        assert words.resolve()[0].prompt == GOOD["prompt"] and len(server.asked) == asked
    assert [path.name[:8] for path in (tmp_path / "cache" / "requests").iterdir()] == ["request-"]
