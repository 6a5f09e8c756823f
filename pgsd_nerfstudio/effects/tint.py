"""Colours of matter: what a colour that somebody names does to snow, sand, drops and fog.

"Purple snow" is snow that is purple, as bright as snow nearly is, and no purple paint. A named colour gives the hue; of chroma
and lightness the matter has its say. Both are taken in OKLab, whose hue and lightness look even (Ottosson, "A perceptual color
space for image processing", 2020; the matrices are those of its section "Converting from linear sRGB to Oklab").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgsd_nerfstudio.effects.matter import Kind
from pgsd_nerfstudio.effects.request import Rgb
from pgsd_nerfstudio.effects.srgb import light_of, srgb_of

_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
_HUELESS = 0.02  # chroma below which a colour names no hue: half a step of 8 bits between channels gives less
_HUED = 0.06  # chroma from which it is all hue
_PURPLE, _LILAC = math.radians(328), math.radians(307)
"""Hue of the purple of CSS, and the mean of what people call light and pale purple, lilac and lavender (XKCD survey)."""
_LIGHT = 0.7  # lightness of the fuchsia of CSS, which has the hue of purple and is pink when it is paler


@dataclass(frozen=True)
class Matter:
    """How a kind of matter takes a colour."""

    lightness: float
    """Part of the way from the colour's lightness to its own, where the colour has a hue."""
    chroma: float
    """The greatest chroma that it takes on (OKLab: sRGB's blue has 0.31, its yellow 0.21)."""
    hue: float = 0.0
    """Part of the way to its own hue for the nearest hues, less for others, none for those over 120 degrees away."""


MATTER: dict[Kind, Matter] = {
    "snowflakes": Matter(lightness=0.78, chroma=0.10),
    "raindrops": Matter(lightness=0.75, chroma=0.10),
    "fog droplets": Matter(lightness=0.85, chroma=0.08),
    # Iron oxides colour sand from ochre to rust; green and purple sands (olivine, garnet) have no more chroma than these.
    "sand grains": Matter(lightness=0.85, chroma=0.11, hue=0.75),
}
"""Estimates, but for sand: the ochres and khakis of the XKCD survey have chroma 0.05-0.15 and hues of 70-107 degrees."""


def in_matter(own: Rgb, wanted: Rgb, kind: Kind) -> Rgb:
    """The colour of matter that is told to have a colour.

    The hue is the wanted one. A colour without a hue (black, grey, white) says nothing but a lightness: matter goes half of the
    way there. What sRGB cannot show loses chroma, not hue or lightness.

    Args:
        own: colour of the matter as it is, sRGB in 0..1.
        wanted: sRGB in 0..1.
        kind: of matter.
    """
    matter = MATTER[kind]
    lightness, chroma, hue = polar(own)
    target, colourful, towards = polar(wanted)
    hued = min(max((colourful - _HUELESS) / (_HUED - _HUELESS), 0.0), 1.0)
    kept = 0.5 + (matter.lightness - 0.5) * hued
    if hued:
        target += hued * (min(target, lightness) - target)  # a pigment takes light away
    towards = _paled(towards, target)
    away = math.remainder(hue - towards, math.tau)
    pull = matter.hue * max(0.0, 1.0 - abs(away) / math.radians(120)) if chroma > _HUELESS else 0.0
    return within_srgb(kept * lightness + (1 - kept) * target, min(colourful, matter.chroma), towards + pull * away)


def _paled(hue: float, lightness: float) -> float:
    """Hue in radians that a dark colour of a hue keeps its name with when it is light: purple is lilac then and not pink."""
    near = max(0.0, 1.0 - abs(math.remainder(hue - _PURPLE, math.tau)) / math.radians(20))
    dark = min(max((_LIGHT - lightness) / 0.2, 0.0), 1.0)
    return hue - near * dark * (_PURPLE - _LILAC)


def mixed_evenly(first: Rgb, second: Rgb, share: float) -> Rgb:
    """The colour at a share of the way from the first to the second, straight through OKLab; exactly the first at 0."""
    if share == 0:
        return first
    start, end = (oklab(rgb) for rgb in (first, second))
    lightness, green_red, blue_yellow = start + share * (end - start)
    return within_srgb(float(lightness), math.hypot(green_red, blue_yellow), math.atan2(blue_yellow, green_red))


def oklab(rgb: Rgb) -> np.ndarray:
    """[3] lightness 0..1, green to red, and blue to yellow of an sRGB colour in 0..1."""
    return _LAB @ np.cbrt(_CONES @ light_of(np.array(rgb)))


def polar(rgb: Rgb) -> tuple[float, float, float]:
    """Lightness 0..1, chroma, and hue in radians of an sRGB colour in 0..1."""
    lightness, green_red, blue_yellow = oklab(rgb).tolist()
    return lightness, math.hypot(green_red, blue_yellow), math.atan2(blue_yellow, green_red)


def within_srgb(lightness: float, chroma: float, hue: float) -> Rgb:
    """The sRGB colour in 0..1 of a lightness 0..1 and a hue in radians, with this chroma or the greatest one that there is."""
    low, high = 0.0, 1.0
    if not _shown(lightness, chroma, hue)[1]:
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if _shown(lightness, middle * chroma, hue)[1] else (low, middle)
        chroma *= low
    red, green, blue = np.clip(_shown(lightness, chroma, hue)[0], 0.0, 1.0).tolist()
    return red, green, blue


def _shown(lightness: float, chroma: float, hue: float) -> tuple[np.ndarray, bool]:
    """[3] the sRGB values of a colour, and whether they lie in 0..1."""
    lab = np.array([lightness, chroma * math.cos(hue), chroma * math.sin(hue)])
    light = np.linalg.solve(_CONES, np.linalg.solve(_LAB, lab) ** 3)
    rgb = srgb_of(light)
    return rgb, bool((rgb >= -1e-6).all() and (rgb <= 1 + 1e-6).all())
