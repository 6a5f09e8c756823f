"""Colours under another light and of wet surfaces, by functions of linear RGB.

Water in the pores of a surface scatters light forward, so that light goes deeper and less of it comes back (Twomey, Bohren &
Mergenthaler, "Reflectance and albedo differences between wet and dry surfaces", 1986). An optically thick medium has the albedo
a = (1 - s)(1 - 0.139 s) / (1 + 1.17 s) with the similarity parameter s = sqrt((1 - w) / (1 - w g)) (van de Hulst, "Multiple
Light Scattering" 2, 1980); water keeps the albedo w of a single grain and raises its asymmetry g.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

WATER = 1.33  # index of refraction
DRY_ASYMMETRY, WET_ASYMMETRY = 0.80, 0.92
"""Asymmetry of grains in air and in water. Twomey et al. take up to 0.97 for grains in water; surfaces soak up less."""
LEAST_GREEN, MOST_GREEN = 0.05, 0.25  # excess of green in linear light: that of grey stone with moss, and that of leaves
AROUND = 0.6  # mean albedo around a cover: most of it cover, some of it wood, walls and leaves
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue (Rec. 709)


def luminance(light: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Luminance of linear RGB (Rec. 709)."""
    return light @ torch.tensor(LUMINANCE).to(light)


def saturated(light: Float[Tensor, "n 3"], saturation: float) -> Float[Tensor, "n 3"]:
    """Linear RGB with its distance from grey multiplied by `saturation`, at the same luminance."""
    grey = luminance(light)[:, None]
    return (grey + saturation * (light - grey)).clamp_min(0.0)


def wetted(light: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Diffuse light of soaked surfaces from that of dry ones, under white light of 1 (Twomey, Bohren & Mergenthaler 1986)."""
    squared = similarity(light.clamp(0.0, 1.0)).square()
    grain = (1 - squared) / (1 - DRY_ASYMMETRY * squared)
    return thick_albedo(((1 - grain) / (1 - WET_ASYMMETRY * grain)).sqrt())


def leafy(light: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Likeness of linear RGB to leaves, 0..1, by the excess of green (Woebbecke et al. 1995). Wax keeps water out of leaves."""
    red, green, blue = light.unbind(1)
    excess = (2 * green - red - blue) / (red + green + blue).clamp_min(1e-4)
    return ((excess - LEAST_GREEN) / (MOST_GREEN - LEAST_GREEN)).clamp(0, 1)


def thick_albedo(s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Albedo of an optically thick medium from its similarity parameter `s` in 0..1 (van de Hulst 1980)."""
    return (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s)


def similarity(albedo: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Similarity parameter from the albedo, the inverse of `thick_albedo`.

    It is the root within 0..1 of 0.139 s^2 - (1.139 + 1.17 a) s + (1 - a) = 0.
    """
    half = 1.139 + 1.17 * albedo
    return (half - (half**2 - 4 * 0.139 * (1 - albedo)).sqrt()) / (2 * 0.139)


def mirrored(cosine: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Share of unpolarised light that a film of water mirrors, from the cosine of the angle to its normal (Fresnel)."""
    outside = cosine.clamp(0, 1)
    inside = (1 - (1 - outside**2) / WATER**2).sqrt()
    across = (outside - WATER * inside) / (outside + WATER * inside)
    along = (inside - WATER * outside) / (inside + WATER * outside)
    return 0.5 * (across**2 + along**2)


def received(sky: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Light that reaches a surface, relative to that of the open sky, from the share of an even sky that it sees.

    Surroundings of the mean albedo b that see the same share s lend light again and again: s / (1 - b (1 - s)).
    """
    return sky / (1 - AROUND * (1 - sky))
