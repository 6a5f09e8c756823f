"""Matter that is told to have a colour takes its hue and stays what it is.

References: the colours of Ottosson (2020) in his table of test values, the `colour` of sRGB's primaries in OKLab as CSS Color 4
prints them, and what the people of the XKCD survey call ochre, khaki, desert and lemon.
"""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb

from pgsd_nerfstudio.effects import EFFECTS, SANDSTORM, SNOWFALL
from pgsd_nerfstudio.effects.application import applied
from pgsd_nerfstudio.effects.reader import read
from pgsd_nerfstudio.effects.tint import MATTER, in_matter, mixed_evenly, polar, within_srgb

WORDS = ("purple", "red", "orange", "gold", "green", "teal", "blue", "pink", "navy", "maroon")


def degrees_apart(first: float, second: float) -> float:
    return abs(math.degrees(math.remainder(first - second, math.tau)))


@pytest.mark.parametrize(
    ("name", "lightness", "chroma", "hue"),
    # CSS Color Module Level 4: oklch() of the primaries.
    [
        ("red", 0.6280, 0.2577, 29.23),
        ("lime", 0.8664, 0.2948, 142.50),
        ("blue", 0.4520, 0.3132, 264.05),
        ("white", 1.0, 0.0, None),
    ],
)
def test_primaries_have_the_coordinates_of_css(name, lightness, chroma, hue):
    found = polar(to_rgb(CSS4_COLORS[name]))
    assert found[:2] == pytest.approx((lightness, chroma), abs=1e-4)
    assert hue is None or math.degrees(found[2]) % 360 == pytest.approx(hue, abs=0.02)


@pytest.mark.parametrize("name", ["purple", "khaki", "white", "black", "seashell", "blue"])
def test_a_colour_of_srgb_comes_back(name):
    assert within_srgb(*polar(to_rgb(name))) == pytest.approx(to_rgb(name), abs=2e-3)


def test_what_srgb_cannot_show_loses_chroma_alone():
    lightness, chroma, hue = polar(within_srgb(0.9, 0.3, 1.0))
    assert lightness == pytest.approx(0.9, abs=2e-3) and hue == pytest.approx(1.0, abs=0.02) and 0.03 < chroma < 0.3


@pytest.mark.parametrize("word", WORDS)
def test_coloured_snow_has_the_hue_and_nearly_the_brightness_of_snow(word):
    own, wanted = polar(SNOWFALL.appearance.active.rgb), polar(to_rgb(word))
    found = polar(applied(read(f"{word} snow").request).appearance.active.rgb)
    assert word == "purple" or degrees_apart(found[2], wanted[2]) < 3
    assert 0.74 < (found[0] - wanted[0]) / (own[0] - wanted[0]) < 0.86
    assert found[1] > 0.02  # a colour is seen: white snow has 0.012


def test_purple_snow_is_lilac_and_pink_snow_is_pink():
    """The hues of what people call pale purple and pink (XKCD survey); the purple of CSS lies half way between."""

    def hue(name: str) -> float:
        return polar(to_rgb(XKCD_COLORS[f"xkcd:{name}"]))[2]

    lilac = [hue(name) for name in ("light purple", "pale purple", "lilac", "lavender")]
    found = {
        word: polar(applied(read(f"{word} snow").request).appearance.active.rgb)[2] for word in ("purple", "fuchsia", "pink")
    }
    assert max(degrees_apart(found["purple"], each) for each in lilac) < 5
    assert degrees_apart(found["fuchsia"], polar(to_rgb("fuchsia"))[2]) < 3
    assert degrees_apart(found["purple"], hue("pink")) > 40


@pytest.mark.parametrize("word", ["yellow", "gold", "orange"])
def test_yellow_sand_is_ochre(word):
    called = {name: polar(to_rgb(XKCD_COLORS[f"xkcd:{name}"])) for name in ("ochre", "desert", "lemon")}
    looks, own = applied(read(f"{word} sand").request).appearance, SANDSTORM.appearance
    for state, plain in ((looks.active, own.active), (looks.collided, own.collided)):
        lightness, chroma, hue = polar(state.rgb)
        assert 65 < math.degrees(hue) < 100  # lemon has 110
        assert 0.06 < chroma < 0.8 * called["lemon"][1]
        assert lightness < polar(plain.rgb)[0] + 1e-3  # a pigment takes light away
    # What lies is as light as what people call ochre and desert, not as lemon.
    assert called["ochre"][0] - 0.05 < lightness < called["lemon"][0] - 0.15
    assert hue < called["lemon"][2] - 0.7 * (called["lemon"][2] - called["desert"][2])


@pytest.mark.parametrize("word", ["purple", "blue", "red"])
def test_sand_far_from_its_own_hue_keeps_nearly_the_wanted_one(word):
    found = in_matter(SANDSTORM.appearance.active.rgb, to_rgb(word), "sand grains")
    assert degrees_apart(polar(found)[2], polar(to_rgb(word))[2]) < 25


@pytest.mark.parametrize("word", WORDS)
def test_fog_and_the_air_stay_pale(word):
    for base in EFFECTS.values():
        effect = applied(read(f"{word} {base.name}").request)
        assert effect.haze and effect.ambience and base.haze and base.ambience
        for rgb, own in ((effect.haze.rgb, base.haze.rgb), (effect.ambience.sky, base.ambience.sky)):
            assert polar(rgb)[0] > 0.85 * polar(own)[0] and polar(rgb)[1] < MATTER[effect.emission.kind].chroma


def test_a_colour_without_hue_goes_half_of_the_way():
    own = polar(SNOWFALL.appearance.active.rgb)[0]
    for word in ("black", "grey", "white"):
        rgb = applied(read(f"{word} snow").request).appearance.active.rgb
        assert polar(rgb)[0] == pytest.approx(0.5 * (own + polar(to_rgb(word))[0]), abs=1e-3) and polar(rgb)[1] < 1e-3


def test_the_way_from_no_hue_to_a_hue_has_no_step():
    greys = [in_matter((0.95, 0.97, 1.0), (0.5, 0.5 - 0.2 * k / 200, 0.5), "snowflakes") for k in range(200)]
    assert max(abs(a - b) for first, second in pairwise(greys) for a, b in zip(first, second, strict=True)) < 0.02


def test_what_is_no_weather_has_the_colour_that_is_named():
    for text, name in (
        ("red petals", "red"),
        ("black smoke", "black"),
        ("blue confetti", "blue"),
        ("green particles", "green"),
    ):
        assert applied(read(text).request).appearance.active.rgb == to_rgb(name)
    purple_hail = applied(read("purple hail").request).appearance.active.rgb
    assert polar(purple_hail)[0] > 0.75 and degrees_apart(polar(purple_hail)[2], polar(to_rgb("purple"))[2]) < 25


@pytest.mark.parametrize("effect", EFFECTS.values())
def test_without_a_colour_no_bit_changes(effect):
    plain = applied(read(effect.name).request)
    assert (plain.appearance, plain.haze, plain.ambience) == (effect.appearance, effect.haze, effect.ambience)


def test_colours_mix_evenly():
    white, purple = (1.0, 1.0, 1.0), to_rgb("purple")
    assert mixed_evenly(white, purple, 0.0) == white
    assert mixed_evenly(white, purple, 1.0) == pytest.approx(purple, abs=1e-5)
    assert polar(mixed_evenly(white, purple, 0.5))[0] == pytest.approx(0.5 * (1 + polar(purple)[0]), abs=1e-4)
