"""A request stays within its limits, and the reader finds in a text what a person finds in it.

References: jsonschema for the fields of a request; for colours the names of CSS, the XKCD survey and CIE L*a*b* distances; for
mixtures the transfer function of sRGB (IEC 61966-2-1); for amounts and winds the order of the meteorologists' classes.
"""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb

from pgsd_nerfstudio.effects.reader import LIGHTS, read
from pgsd_nerfstudio.effects.request import LIMITS, SCHEMA, Request
from pgsd_nerfstudio.effects.vocabulary import KINDS, QUALITIES, TINTS, WINDS, colour, mixed, tinted
from pgsd_nerfstudio.storage import content_key

LEAST: dict[str, Any] = {"base": "snowfall", "prompt": "Snow in {scene}"}

RIGHT = [
    {},
    {"base": None},
    {"rgb": [0, 0.5, 1], "landed_rgb": None},
    {"size": 5, "amount": 0.1, "opacity": 2, "glitter": 1, "fall_speed": 0.2, "wind": 0, "tumbling": 5.0},
    {"accumulates": True},
    {"prompt": "{scene}"},
]
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"base": "snow"}, r'base must be one of snowfall, rainfall, fog, sandstorm or null, found "snow"'),
    ({"rgb": [128, 0, 128]}, r"rgb must be a list of 3, each a number in 0-1 or null, found 128 at place 1"),
    ({"rgb": [0.1, 0.2]}, r"rgb must be a list of 3.*, found too few"),
    ({"rgb": [0.1, 0.2, 0.3, 0.4]}, r"rgb must be a list of 3.*, found \[0.1, 0.2, 0.3, 0.4\]"),
    ({"landed_rgb": "purple"}, r'landed_rgb must be a list of 3.*, found "purple"'),
    ({"size": 9}, r"size must be a number in 0.2-5, found 9"),
    ({"size": 0}, r"size must be a number in 0.2-5, found 0"),
    ({"amount": "2"}, r'amount must be a number in 0.1-5, found "2"'),
    ({"wind": True}, r"wind must be a number in 0-3, found true"),
    ({"glitter": -0.1}, r"glitter must be a number in 0-1, found -0.1"),
    ({"accumulates": 1}, r"accumulates must be true or false or null, found 1"),
    ({"colour": [1, 0, 0]}, r"colour is no field of a request, found \[1, 0, 0\]; its fields are base, rgb, "),
    ({"prompt": "Snow in the garden"}, r"prompt must be one line .* with \{scene\} once"),
    ({"prompt": "{scene} {scene}"}, r"prompt must be one line"),
    ({"prompt": "Snow in {scene} {0}"}, r"prompt must be one line"),
    ({"prompt": "Snow\nin {scene}"}, r"prompt must be one line"),
    ({"prompt": "x" * 600 + "{scene}"}, r"prompt must be one line of at most 600 characters"),
]


@pytest.mark.parametrize("said", RIGHT)
def test_what_is_within_the_limits_is_taken_as_it_is(said):
    request = Request.from_json(json.dumps(LEAST | said))
    for name, value in said.items():
        found = getattr(request, name)
        assert (list(found) if isinstance(found, tuple) else found) == value
    assert Request.from_json(request.to_json()) == request


@pytest.mark.parametrize(("said", "sentence"), WRONG)
def test_what_is_not_is_refused_by_name_with_what_is_allowed_and_what_was_found(said, sentence):
    with pytest.raises(ValueError, match=sentence):
        Request.from_json(json.dumps(LEAST | said))


def test_the_schema_says_the_same_as_the_judge_of_json_schemas():
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    judge = jsonschema.Draft202012Validator(SCHEMA)
    for said in RIGHT:
        judge.validate(LEAST | said)
    for said, _ in WRONG:
        assert not judge.is_valid(LEAST | said), said
    assert all(field.get("description") for field in SCHEMA["properties"].values())


def test_every_fault_is_named_at_once():
    with pytest.raises(ValueError, match=r"size must .*; wind must .*; prompt must .*, found none; snow is no field") as caught:
        Request.from_json('{"base": "fog", "size": 9, "wind": 9, "snow": 1}')
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "purple", "[1]", '"fog"', '{"base": "fog", "prompt": "in {scene}"', "{'base': 'fog'}"])
def test_what_is_no_json_object_is_refused(text):
    with pytest.raises(ValueError, match=r"a request must be (one|a) JSON object, found"):
        Request.from_json(text)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e400"])
def test_numbers_that_are_none_are_refused(number):
    with pytest.raises(ValueError, match=r"glitter must be a number in 0-1, found"):
        Request.from_json(f'{{"base": "fog", "prompt": "in {{scene}}", "glitter": {number}}}')


def test_a_request_is_plain_frozen_and_cannot_leave_its_limits():
    request = Request(**LEAST)
    assert is_dataclass(request)
    with pytest.raises(FrozenInstanceError):
        request.size = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError):
        replace(request, size=6.0)
    assert content_key(request) == content_key(Request(**LEAST)) != content_key(replace(request, size=2.0))
    # Said nothing, nothing changes: factors are 1, the rest is the base's.
    assert {getattr(request, name) for name in LIMITS if name not in LIGHTS} == {1.0}
    assert {getattr(request, name) for name in LIGHTS} == {0.0}
    assert (request.rgb, request.landed_rgb, request.accumulates, request.dyed) == (None, None, None, False)


# What a person finds in a text.


@pytest.mark.parametrize(
    ("text", "base", "name", "more"),
    [
        ("purple snow", "snowfall", "purple", {}),
        ("glittering yellow sand", "sandstorm", "yellow", {"glitter": 0.7, "glow": 0.0, "twinkle": 0.0, "dyed": False}),
        ("rainbow snow", "snowfall", None, {"colourful": True, "dyed": False}),
        ("red confetti", "snowfall", "red", {"colourful": False, "dyed": True}),
        ("confetti", "snowfall", None, {"colourful": True}),
        ("glowing, blinking red confetti", "snowfall", "red", {"glitter": 0.0, "glow": 0.6, "twinkle": 1.5, "dyed": True}),
        ("light snow", "snowfall", None, {"amount": 0.4}),
        ("light blue snow", "snowfall", "lightblue", {}),
        ("Turquoise FOG", "fog", "turquoise", {}),
        ("snow-white ash", "snowfall", "white", {}),
        ("white smoke", "fog", "white", {}),
        ("ash grey snow", "snowfall", "grey", {"fall_speed": 1.0}),
        ("raining golden confetti", "snowfall", "gold", {}),
        ("snow in a light blue", "snowfall", "lightblue", {"amount": 1.0}),
        ("It is snowing slowly. The flakes are golden!", "snowfall", "gold", {"fall_speed": 0.5}),
    ],
)
def test_words_are_found(text, base, name, more):
    request = read(text).request
    assert request.base == base
    assert request.rgb == request.landed_rgb == (name and to_rgb(CSS4_COLORS[name]))
    assert {key: getattr(request, key) for key in more} == more


@pytest.mark.parametrize("text", ["ash", "petals", "confetti", "embers", "dust", "pollen", "leaves", "magic particles", "hail"])
def test_what_is_no_weather_moves_like_one(text):
    reading = read(text)
    assert reading.request.base and not reading.ignored
    assert reading.request != replace(read("snow").request, prompt=reading.request.prompt)


@pytest.mark.parametrize(
    ("text", "meant"), [("rain of ash", "ash"), ("snow and petals", "petals"), ("a sand storm", "sand"), ("rainy fog", "fog")]
)
def test_of_several_kinds_the_most_particular_is_meant(text, meant):
    names = ("base", "rgb", "size", "fall_speed", "tumbling")
    assert [getattr(read(text).request, name) for name in names] == [getattr(read(meant).request, name) for name in names]


def test_families_are_ordered_as_in_nature():
    requests = {word: read(word).request for word in ("pollen", "ash", "petals", "leaves", "snow", "embers")}
    fall = {word: request.fall_speed for word, request in requests.items()}
    assert fall["pollen"] < fall["ash"] < fall["petals"] < fall["leaves"]
    assert requests["pollen"].size < requests["snow"].size < requests["petals"].size < requests["leaves"].size
    assert requests["embers"].landed_rgb is not None and max(requests["embers"].landed_rgb) < 0.4  # burnt out


def test_amounts_are_in_the_order_of_the_meteorologists():
    for words in (
        ("light snow", "moderate snow", "heavy snow", "blizzard"),
        ("drizzle", "light rain", "rain", "heavy rain", "downpour"),
        ("thin fog", "fog", "thick fog"),
    ):
        amounts = [read(text).request.amount for text in words]
        assert amounts == sorted(set(amounts)), words


def test_winds_are_in_beauforts_order():
    words = ("light breeze", "gentle breeze", "strong breeze", "strong wind", "gale")
    winds = [read(f"snow in a {wind}").request.wind for wind in words]
    assert winds == sorted(winds) and winds[0] < 0.5 and winds[-1] == LIMITS["wind"][1]
    assert read("snow in a strong wind").request.amount == 1.0  # more wind is not more snow
    assert read("snow, no wind").request.wind == read("windless snow").request.wind == 0.0


def test_degrees_strengthen_and_weaken():
    sizes = [read(f"{degree} big flakes").request.size for degree in ("slightly", "", "very")]
    assert 1 < sizes[0] < sizes[1] < sizes[2]
    glitters = [read(f"{degree} glittering snow").request.glitter for degree in ("slightly", "", "extremely")]
    assert 0 < glitters[0] < glitters[1] < glitters[2] < 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("magic particles without glitter", {"glitter": 0.0, "glow": 0.8}),
        ("magic particles, not glowing, not blinking", {"glow": 0.0, "twinkle": 0.0}),
        ("fairy snow with no glitter or wind", {"glitter": 0.0, "wind": 0.0}),
        ("snow that doesn't settle", {"accumulates": False}),
        ("snow that never melts", {"accumulates": True}),
        ("no strong wind, dense snow", {"wind": 0.0, "amount": 2.5}),
        ("ash, not snow", {"fall_speed": 0.5}),
        ("not snow but rain", {"base": "rainfall"}),
        ("snow, not heavy", {"amount": 1.0}),
        ("snow, not white", {"rgb": None}),
        ("confetti that is not tumbling", {"tumbling": 0.0}),
    ],
)
def test_what_is_denied_is_not_there(text, expected):
    request = read(text).request
    assert {key: getattr(request, key) for key in expected} == expected


def test_what_is_denied_is_not_told_to_the_video_model():
    """Such models draw what is named."""
    assert read("purple snow, no wind").request.prompt.startswith("Purple snow falling in {scene}, accumulating")
    assert "glitter" not in read("magic particles without any glitter").request.prompt
    assert "settle" not in read("snow that does not settle").request.prompt
    assert "accumulating" not in read("snow that does not settle").request.prompt


def test_built_in_weathers_are_told_as_the_paper_tells_them():
    sentences = [read(text).request.prompt for text in ("purple snow", "red rain", "green fog", "blue sand", "a snow storm")]
    assert sentences == [
        "Purple snow falling in {scene}, accumulating on surfaces. Photorealistic, high detail",
        "Red rain falling in {scene}, wetting the surfaces. Photorealistic, high detail",
        "Green fog moving across {scene}. Photorealistic, high detail",
        "Blue sand swirling through {scene}, accumulating on surfaces. Photorealistic, high detail",
        "A snow storm in {scene}, accumulating on surfaces. Photorealistic, high detail",
    ]


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("a red truck in purple snow", "red truck"),
        ("purple snow in a green garden", "green garden"),
        ("purple snow over red roofs and benches", "red roofs"),
        ("big houses and purple snow", "big houses"),
        ("purple snow under a blue sky", "blue"),
        ("purple snow in the dark", "dark"),
    ],
)
def test_what_is_said_of_something_else_is_not_said_of_the_weather(text, other):
    reading = read(text)
    assert reading.request.rgb == to_rgb(CSS4_COLORS["purple"]) and reading.request.size == 1.0
    assert other in reading.ignored


def test_what_was_not_used_is_said():
    reading = read("purpel snow with unicorns, and rain")
    assert reading.ignored == ("purpel (purple?)", "unicorns", "rain (one kind at a time)")
    assert str(reading) == "understood snow = snowfall. Ignored: purpel (purple?), unicorns, rain (one kind at a time)"


def test_what_is_beyond_a_limit_is_bounded_and_said():
    reading = read("huge massive snow")
    assert reading.request.size == LIMITS["size"][1] == 5
    assert reading.understood[-1] == "size 12 is beyond the limit: 5"


@pytest.mark.parametrize("text", ["purple", "windy", "cats and dogs", "no snow", "lila Schnee", "{}", "🦄", "a"])
def test_a_text_without_weather_is_refused_with_examples(text):
    with pytest.raises(
        ValueError, match=r"names nothing that could be in the air; .* such as: purple snow, .* magic particles"
    ) as caught:
        read(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "  \n", "snow " * 81])
def test_a_text_of_no_or_too_many_characters_is_refused(text):
    with pytest.raises(ValueError, match=r"must have 1-400 characters, found \d+"):
        read(text)


def test_every_known_word_can_be_read_and_stays_within_the_limits():
    words = {*KINDS, *QUALITIES, *WINDS, *TINTS}
    for word in words:
        for text in (f"{word} snow", f"very {word} {word} {word} snow, {word}", f"no {word}, snow", f"{{{word}}} snow\n"):
            try:
                request = read(text).request
            except ValueError as error:
                assert "names nothing" in str(error), text
                continue
            assert Request.from_json(request.to_json()) == request, text


# Colours.


def lab(rgb) -> np.ndarray:
    """CIE 1976 L*a*b* of an sRGB colour, D65."""
    c = np.asarray(rgb, float)
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear / [0.9505, 1, 1.089]
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_every_name_of_css_is_that_colour():
    for name, code in CSS4_COLORS.items():
        if name != "snow":  # which is weather
            assert colour(name) == to_rgb(code), name


TESTED = ("light", "dark", "pale", "deep", "bright", "dull", "soft", "faded", "dusty", "dirty", "muted", "neon")


@pytest.mark.parametrize("tint", TESTED)
def test_tints_come_nearer_to_what_people_call_so_than_the_colour_itself(tint):
    survey = {name.removeprefix("xkcd:"): to_rgb(code) for name, code in XKCD_COLORS.items()}
    named = [name for name in survey if name.startswith(f"{tint} ") and name.removeprefix(f"{tint} ") in survey]
    pairs = [(survey[name.removeprefix(f"{tint} ")], survey[name]) for name in named]
    before = np.mean([np.linalg.norm(lab(plain) - lab(called)) for plain, called in pairs])
    after = np.mean([np.linalg.norm(lab(tinted(plain, tint)) - lab(called)) for plain, called in pairs])
    assert len(pairs) >= 4 and after < 0.75 * before


def test_very_and_slightly_move_a_tint():
    red = to_rgb("red")
    lightness = [lab(tinted(red, "dark", degree))[0] for degree in (0.0, 0.5, 1.0, 1.6)]
    assert lightness == sorted(lightness, reverse=True) and tinted(red, "dark", 0.0) == red


def test_a_tint_without_a_colour_is_of_the_weathers_own():
    for tint, sign in (("dark", -1), ("pale", 1)):
        rgb, plain = read(f"{tint} sand").request.rgb, (0.8, 0.63, 0.4)
        assert rgb is not None and sign * (lab(rgb)[0] - lab(plain)[0]) > 5
    assert read("bright purple snow").request.rgb != read("purple snow").request.rgb


def test_two_colours_mix_as_their_light_does():
    # Half the light of white is the grey of code value 188 in sRGB.
    assert mixed([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]) == pytest.approx((188 / 255,) * 3, abs=1 / 510)
    assert mixed([(0.2, 0.4, 0.02)]) == pytest.approx((0.2, 0.4, 0.02))
    assert read("red and blue confetti").request.rgb == pytest.approx((188 / 255, 0, 188 / 255), abs=1 / 510)
