"""Colours under another light, and of wet surfaces; plain functions on linear RGB.

Wet: water in the pores scatters light forward, so that it goes deeper and comes back more rarely (Twomey, Bohren &
Mergenthaler, "Reflectance and albedo differences between wet and dry surfaces", 1986). An optically thick medium has the albedo
a = (1 - s)(1 - 0.139 s) / (1 + 1.17 s) with the similarity parameter s = sqrt((1 - w) / (1 - w g)) (van de Hulst, "Multiple
Light Scattering" 2, 1980); water leaves the single grain's albedo w as it is and raises its asymmetry g.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

GAMMA = 2.2  # of sRGB, near enough: scenes are lit by factors, not measured
WATER = 1.33  # index of refraction
DRY_ASYMMETRY, WET_ASYMMETRY = 0.80, 0.92
"""Of grains in air and in water. Twomey et al. take up to 0.97 for grains with water all around; surfaces soak less."""
LEAST_GREEN, MOST_GREEN = 0.05, 0.25  # excess of green of linear light, from grey stone with moss to leaves
SHELTERED = (0.42, 0.46, 0.55)  # linear light where no sky is seen, bluish, from all that is bright around
LUMINANCE = (0.2126, 0.7152, 0.0722)


def linear(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Light of sRGB values; below 0 there is none, above 1 it goes on."""
    return rgb.clamp_min(0.0) ** GAMMA


def encoded(light: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """sRGB values of light."""
    return light.clamp_min(0.0) ** (1 / GAMMA)


def luminance(light: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Of linear RGB (Rec. 709)."""
    return light @ torch.tensor(LUMINANCE).to(light)


def saturated(light: Float[Tensor, "n 3"], saturation: float) -> Float[Tensor, "n 3"]:
    """Colours moved from grey (below 1: towards it) at constant luminance."""
    grey = luminance(light)[:, None]
    return (grey + saturation * (light - grey)).clamp_min(0.0)


def wetted(light: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Diffuse light of soaked surfaces, from that of dry ones under white light of 1 (Twomey, Bohren & Mergenthaler 1986)."""
    squared = similarity(light.clamp(0.0, 1.0)).square()
    grain = (1 - squared) / (1 - DRY_ASYMMETRY * squared)
    return thick_albedo(((1 - grain) / (1 - WET_ASYMMETRY * grain)).sqrt())


def leafy(light: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """How much like a leaf a colour is, 0..1, by its excess of green (Woebbecke et al. 1995): wax keeps water out of leaves."""
    red, green, blue = light.unbind(1)
    excess = (2 * green - red - blue) / (red + green + blue).clamp_min(1e-4)
    return ((excess - LEAST_GREEN) / (MOST_GREEN - LEAST_GREEN)).clamp(0, 1)


def thick_albedo(s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Albedo of an optically thick medium by its similarity parameter 0..1 (van de Hulst 1980)."""
    return (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s)


def similarity(albedo: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The inverse of `thick_albedo`: the root within 0..1 of 0.139 s^2 - (1.139 + 1.17 a) s + (1 - a) = 0."""
    half = 1.139 + 1.17 * albedo
    return (half - (half**2 - 4 * 0.139 * (1 - albedo)).sqrt()) / (2 * 0.139)


def mirrored(cosine: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Share of unpolarised light that a film of water mirrors, by the cosine of the angle to its normal (Fresnel)."""
    outside = cosine.clamp(0, 1)
    inside = (1 - (1 - outside**2) / WATER**2).sqrt()
    across = (outside - WATER * inside) / (outside + WATER * inside)
    along = (inside - WATER * outside) / (inside + WATER * outside)
    return 0.5 * (across**2 + along**2)


def under_sky(sky: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """Light on matter that is white by itself, by the share of the overcast sky that it sees; 1 in the open."""
    open_share = sky.clamp(0, 1).sqrt()[:, None]  # a bright surrounding fills in
    return torch.lerp(torch.tensor(SHELTERED).to(sky), torch.ones(3).to(sky), open_share)
