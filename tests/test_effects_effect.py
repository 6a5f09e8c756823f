"""Effects are plain configuration that is known by name and refuses nonsense."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import pytest

from pgsd_nerfstudio.effects import EFFECTS, SNOWFALL, Emission, effect
from pgsd_nerfstudio.effects.options import EffectOptions


def test_effects_are_known_by_name():
    assert effect("snowfall") is SNOWFALL is EFFECTS["snowfall"]


@pytest.mark.parametrize(("short", "name"), [("snow", "snowfall"), ("rain", "rainfall"), ("sand", "sandstorm"), ("fog", "fog")])
def test_an_effect_is_understood_by_what_it_is_called(short, name):
    assert effect(short) is effect(name)
    assert EffectOptions(effect=short) == EffectOptions(effect=name)
    assert EffectOptions(effect=short).resolve()[0] == effect(name)


def test_an_unknown_effect_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"there is no effect 'hail'; known are: .*snowfall"):
        effect("hail")


def test_the_prompt_takes_the_description_of_the_scene():
    expected = "Fluffy snowflakes are falling in a garden, accumulating on surfaces. Photorealistic, high detail"
    assert SNOWFALL.prompt_for("a garden") == expected


@pytest.mark.parametrize("rate", [0.0, -1.0, 1000.0, float("nan")])
def test_impossible_rates_are_refused(rate):
    with pytest.raises(ValueError, match="mm/h"):
        Emission(intensity=rate)


def test_diameters_must_be_a_range():
    with pytest.raises(ValueError, match="smallest < largest"):
        Emission(intensity=1.0, smallest=0.01, largest=0.005)


def test_configuration_is_plain_and_frozen():
    def walk(value):
        assert is_dataclass(value) or value is None or isinstance(value, str | int | float | tuple), type(value)
        if is_dataclass(value):
            for each in fields(value):
                walk(getattr(value, each.name))

    walk(SNOWFALL)
    with pytest.raises(FrozenInstanceError):
        SNOWFALL.name = "x"  # type: ignore[misc]


def test_knobs_turn_one_number_and_leave_the_rest():
    plain, turned = effect("snowfall"), effect("snowfall", intensity=2.5, exposure=0.02)
    assert turned.emission.intensity == 2.5 and turned.appearance.exposure == 0.02
    assert replace(turned, emission=plain.emission, appearance=plain.appearance) == plain
    assert effect("snowfall") is plain
    with pytest.raises(ValueError, match=r"exposure must lie in 0-1 s, got 2"):
        effect("snowfall", exposure=2.0)
