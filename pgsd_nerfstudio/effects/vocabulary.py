"""Words for weather and their meanings: kinds of particles, qualities, colours.

Colours have the names of CSS and, after these, of the XKCD survey (matplotlib has both). The strengths of "dark", "pale" and
the like were fitted to pairs of that survey ("pale blue" and "blue"). The other numbers are estimates relative to the effect's
own. For kinds that are no weather they follow the fall speed: a petal falls at about 0.8 m/s, ash at 0.5 m/s, pollen hardly.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb

from pgsd_nerfstudio.effects.request import Base, Rgb
from pgsd_nerfstudio.effects.srgb import light_of, srgb_of


def _spread(*rows: tuple[str, Any]) -> dict[str, Any]:
    return {word.strip(): meaning for words, meaning in rows for word in words.split(",")}


@dataclass(frozen=True)
class Kind:
    """A kind of particle with its base effect, its colours and its factors."""

    base: Base
    rgb: Rgb | None = None
    landed_rgb: Rgb | None = None
    factors: dict[str, float | bool] = field(default_factory=dict)
    rank: int = 2
    """If a text names several kinds, the highest rank is meant: 3 petals, ash; 2 snow, rain; 1 snowy, shower, particles; 0
    storm."""
    dyed: bool = False
    """Whether a named colour is the particles' own (red petals, black smoke); else it tints their matter (purple snow)."""


def _particle(rgb: Rgb | None = None, landed_rgb: Rgb | None = None, **factors: float | bool) -> Kind:
    return Kind("snowfall", rgb, landed_rgb, factors, rank=3, dyed=True)


ASH, SOOT, SMOKE = (0.42, 0.41, 0.4), (0.3, 0.29, 0.28), (0.45, 0.44, 0.43)
KINDS: dict[str, Kind] = _spread(
    ("snow, snowing, snows, snowfall, snowflake, flake", Kind("snowfall")),
    ("rain, raining, rains, rainfall, raindrop", Kind("rainfall")),
    ("sleet", Kind("rainfall", (0.85, 0.88, 0.92), factors={"opacity": 1.3, "fall_speed": 0.6})),
    # Stones of ice that lie white on the ground and fall as fast as a request allows.
    (
        "hail, hailstone, hailstorm",
        Kind("snowfall", factors={"amount": 0.8, "size": 1.5, "fall_speed": 3.0, "opacity": 1.5, "tumbling": 0.0}),
    ),
    ("fog, mist", Kind("fog")),
    ("haze", Kind("fog", factors={"amount": 0.3})),
    ("smoke", Kind("fog", SMOKE, factors={"amount": 2.0}, dyed=True)),
    ("smog", Kind("fog", (0.66, 0.61, 0.52), dyed=True)),
    ("steam, vapour, vapor", Kind("fog", (0.96, 0.96, 0.97), factors={"amount": 0.7})),
    ("sand, sandstorm, dust storm, duststorm, haboob", Kind("sandstorm")),
    ("dust", Kind("sandstorm", factors={"size": 0.5, "amount": 0.5, "wind": 0.4})),
    ("ash, ashes, ashfall, soot, cinder", _particle(ASH, size=0.8, fall_speed=0.5)),
    # Embers are smaller than that, but so bright that a lens spreads their light.
    (
        "ember, spark",
        _particle((1.0, 0.45, 0.1), SOOT, amount=0.15, fall_speed=0.3, tumbling=1.5, glow=1.0, twinkle=2.0, accumulates=False),
    ),
    (
        "petal, blossom, cherry blossom, cherry petal, rose petal",
        _particle((0.98, 0.74, 0.82), size=2.0, amount=0.4, fall_speed=0.8, tumbling=3.0),
    ),
    (
        "leaf, leaves, foliage, autumn leaf, autumn leaves, fall leaves",
        _particle((0.72, 0.4, 0.12), size=4.0, amount=0.2, fall_speed=1.3, tumbling=3.0),
    ),
    ("confetti", _particle(size=1.5, amount=0.6, opacity=1.2, tumbling=3.5, colourful=True, accumulates=False)),
    ("feather", _particle(size=4.0, amount=0.15, fall_speed=0.5, tumbling=2.5)),
    # Grains of pollen are far smaller; in sunlight their clumps shine like this.
    (
        "pollen",
        _particle(
            (1.0, 0.86, 0.25), size=0.7, amount=0.25, fall_speed=0.2, wind=0.5, opacity=1.3, glow=0.15, accumulates=False
        ),
    ),
    ("dandelion seed, dandelion, fluff", _particle(size=1.5, amount=0.2, fall_speed=0.4)),
    (
        "dust mote, mote",
        _particle((0.9, 0.86, 0.76), size=0.4, amount=0.4, fall_speed=0.2, wind=0.3, glow=0.15, accumulates=False),
    ),
    (
        "magic particle, magical particle, magic dust, fairy dust, pixie dust, stardust, star dust",
        _particle((0.8, 0.65, 1.0), amount=0.4, fall_speed=0.4, tumbling=2.0, glow=0.8, twinkle=1.0, accumulates=False),
    ),
    (
        "firefly",
        _particle(
            (0.85, 1.0, 0.35), amount=0.1, fall_speed=0.2, wind=0.3, tumbling=3.0, glow=1.0, twinkle=0.5, accumulates=False
        ),
    ),
    ("snowy, wintry, blizzard, snowstorm, whiteout, flurry", Kind("snowfall", rank=1)),
    ("rainy, drop, droplet, shower, drizzle, drizzling, downpour, cloudburst, monsoon, pouring", Kind("rainfall", rank=1)),
    ("thunderstorm, rainstorm, hurricane, typhoon", Kind("rainfall", rank=1)),
    ("foggy, misty, hazy, cloudy, cloud", Kind("fog", rank=1)),
    ("smoky", Kind("fog", SMOKE, factors={"amount": 2.0}, rank=1, dyed=True)),
    ("sandy, dusty, grain", Kind("sandstorm", rank=1)),
    ("ashy", Kind("snowfall", ASH, None, {"size": 0.8, "fall_speed": 0.5}, 1, True)),
    (
        "particle, speck, glitter, sparkle",
        Kind("snowfall", factors={"fall_speed": 0.6, "accumulates": False}, rank=1, dyed=True),
    ),
    (
        "star",
        Kind(
            "snowfall",
            factors={"amount": 0.4, "fall_speed": 0.6, "glow": 0.8, "twinkle": 2.0, "accumulates": False},
            rank=1,
            dyed=True,
        ),
    ),
    ("storm, tempest, squall", Kind("rainfall", rank=0)),
)
"""Kinds by their names in the singular. Some of rank 1 and 0 are qualities too: a blizzard of petals, a sand storm."""
NOMINAL: dict[Base, Rgb] = {
    "snowfall": (0.95, 0.97, 1.0),
    "rainfall": (0.75, 0.8, 0.86),
    "fog": (0.86, 0.88, 0.9),
    "sandstorm": (0.8, 0.63, 0.4),
}
"""Colours that "dark" or "pale" changes if the text names none."""

QUALITIES: dict[str, dict[str, float | bool]] = _spread(
    ("tiny, minuscule, microscopic, minute", {"size": 0.35}),
    ("small, little, fine, powdery, powder", {"size": 0.6}),
    ("big, large, coarse, chunky, fat, plump", {"size": 1.8}),
    ("huge, giant, gigantic, enormous, massive", {"size": 3.5}),
    ("fluffy", {"size": 1.5, "fall_speed": 0.8, "tumbling": 1.3}),
    ("sparse, few, scattered, occasional, a few", {"amount": 0.3}),
    ("thin", {"amount": 0.5}),
    ("light, a little, dusting", {"amount": 0.4}),
    ("faint", {"amount": 0.5, "opacity": 0.6}),
    ("moderate", {"amount": 1.0}),
    ("heavy, much, lots of, lot of, many, plenty of, deep", {"amount": 2.0}),
    ("dense, thick, abundant, intense", {"amount": 2.5}),
    ("torrential, extreme", {"amount": 4.0}),
    ("flurry", {"amount": 0.4}),
    ("drizzle, drizzling", {"amount": 0.2, "size": 0.4, "fall_speed": 0.5}),
    ("downpour, cloudburst, monsoon, pouring", {"amount": 4.0}),
    ("storm, tempest, squall", {"amount": 2.0, "wind": 2.5}),
    ("thunderstorm, rainstorm", {"amount": 3.0, "wind": 2.5}),
    ("blizzard, snowstorm, whiteout, hurricane, typhoon", {"amount": 4.0, "wind": 3.0}),
    ("strong, violent, fierce", {"amount": 1.8, "wind": 1.8}),
    ("raging, howling", {"amount": 2.0, "wind": 3.0}),
    ("windy, stormy, blowing, blustery, breezy", {"wind": 2.0}),
    ("gusty", {"wind": 2.2, "tumbling": 1.3}),
    ("calm, still, quiet, peaceful", {"wind": 0.3, "tumbling": 0.7}),
    ("windless", {"wind": 0.0}),
    ("gentle, soft, tender", {"fall_speed": 0.7, "wind": 0.5}),
    ("slow, lazy, dreamy", {"fall_speed": 0.5, "wind": 0.7}),
    ("fast, quick, rapid, swift, speeding", {"fall_speed": 1.8}),
    ("drifting", {"fall_speed": 0.6}),
    ("floating, hovering, weightless, suspended", {"fall_speed": 0.25}),
    ("driving, driven, horizontal, sideways", {"wind": 3.0}),
    ("swirling, whirling, eddying", {"wind": 1.5, "tumbling": 2.0}),
    ("tumbling, fluttering, spinning, twirling, dancing, swaying, wobbling", {"tumbling": 2.5}),
    ("glittering, glittery, glitter, sparkling, sparkly, sparkle, glinting", {"glitter": 0.7}),
    ("shimmering, shiny, iridescent, glossy", {"glitter": 0.4}),
    ("twinkling, blinking, pulsing, flickering", {"glow": 0.3, "twinkle": 1.5}),
    ("glowing, luminous, radiant, shining", {"glow": 0.6}),
    ("magic, magical, fairy, enchanted", {"glow": 0.6, "twinkle": 1.0, "fall_speed": 0.6}),
    ("rainbow, colourful, colorful, multicoloured, multicolored, motley", {"colourful": True}),
    ("transparent, translucent, glassy, ghostly, sheer, clear", {"opacity": 0.4}),
    ("opaque, solid", {"opacity": 1.6}),
    ("wet, sticky, slushy", {"size": 1.3, "fall_speed": 1.3, "accumulates": True}),
    ("accumulating, accumulate, accumulation, settling, settle, sticking, stick", {"accumulates": True}),
    ("gathering, gather, covering, cover, landing, land, piling, piling up, pile up, blanketing", {"accumulates": True}),
    ("melting, melt, vanishing, vanish, disappearing, disappear, evaporating, dissolving", {"accumulates": False}),
)
WINDS: dict[str, float] = _spread(("wind", 1.3), ("gust", 2.0), ("breeze", 0.8), ("draught, draft", 0.6), ("gale", 3.0))
"""Nouns for wind with their factors. Words before them describe the wind: a strong wind is more wind, not more snow."""

# Target of each tint, and the part of the way to it.
TINTS: dict[str, tuple[str, float]] = _spread(
    ("light", ("white", 0.3)),
    ("pale, whitish", ("white", 0.45)),
    ("soft, pastel, faded", ("white", 0.4)),
    ("dark, dirty", ("black", 0.3)),
    ("deep", ("black", 0.35)),
    ("bright", ("vivid", 0.45)),
    ("vivid, neon, electric, intense, saturated", ("vivid", 0.9)),
    ("dull, muted, drab, dusty", ("grey", 0.5)),
)
DEGREES: dict[str, float] = _spread(
    ("very, really, extremely, super, incredibly, ultra, so, extra", 1.6),
    ("slightly, somewhat, fairly, rather, a bit", 0.5),
)
SHADES = {"snow white": "white", "jet black": "black", "pitch black": "black", "silvery": "silver", "golden": "gold"}
# Names of the survey that in a sentence mean a place more often than a colour, or that are rude.
SCENERY = _spread(
    ("sky, sea, ocean, grass, forest, fern, moss, desert, earth, stone, mud, clay, dirt, swamp, brick, cement, steel", None),
    ("leather, denim, seaweed, lichen, marine, royal, barney, adobe, spruce, pine, bruise, poo, poop, shit, puke", None),
    ("vomit, snot, booger, bile, diarrhea", None),
)


def colour(name: str) -> Rgb | None:
    """The colour of a name, sRGB in 0..1, by CSS, else by the XKCD survey; None if the name is no colour here."""
    last = name.rpartition(" ")[2]
    name = SHADES.get(name, name)
    joined = name.replace(" ", "")
    # Before a kind of particle these words describe the kind: "white smoke", "dark sand".
    if (last in KINDS and last != name) or name in KINDS or name.startswith(("heavy ", "strong ")):
        return None
    if joined in CSS4_COLORS:
        return to_rgb(CSS4_COLORS[joined])
    if name in SCENERY or name in TINTS or f"xkcd:{name}" not in XKCD_COLORS:
        return None
    return to_rgb(XKCD_COLORS[f"xkcd:{name}"])


def tinted(rgb: Rgb, tint: str, degree: float = 1.0) -> Rgb:
    """The "dark", "pale" ... variant of a colour.

    Args:
        rgb: sRGB in 0..1.
        tint: a word of TINTS.
        degree: strength of the change; above 1 for "very", below 1 for "slightly".
    """
    target, share = TINTS[tint]
    share = 1 - (1 - share) ** degree
    if target == "vivid":
        hue, saturation, _ = colorsys.rgb_to_hsv(*rgb)
        # Grey has no hue, so it only gets lighter.
        towards = colorsys.hsv_to_rgb(hue, 1.0 if saturation > 0.05 else saturation, 1.0)
    else:
        luma = 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]
        towards = ({"white": 1.0, "black": 0.0, "grey": luma}[target],) * 3
    red, green, blue = (c + share * (t - c) for c, t in zip(rgb, towards, strict=True))
    return red, green, blue


def mixed(colours: Sequence[Rgb]) -> Rgb:
    """The colour of a mixture of particles seen from afar: the mean of their linear light (IEC 61966-2-1 for sRGB)."""
    if len(colours) == 1:
        return colours[0]
    red, green, blue = np.minimum(srgb_of(light_of(np.array(colours)).mean(0)), 1.0).tolist()
    return red, green, blue


ENDINGS = {"ies": ("y",), "es": ("",), "s": ("",), "ily": ("y",), "ly": ("", "le"), "ish": ("", "e")}


def forms(word: str) -> Iterator[str]:
    """The word itself, and the words that it may be a plural, an adverb or a shade of."""
    yield word
    for ending, others in ENDINGS.items():
        if word.endswith(ending) and len(word) > len(ending) + 2:
            yield from (word.removesuffix(ending) + other for other in others)
