"""The light of wet frozen Gaussians: water darkens their own light and mirrors the sky.

Under a level surface of water a diffuse ground is darker still: light that it sends up too flatly comes back to it (Angstrom,
"The albedo of various surfaces of ground", Geografiska Annaler 7, 1925; Lekner & Dorf, "Why some things are darker when wet",
Applied Optics 27, 1988).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import leafy, mirrored, wetted

WAXEN = 0.75  # share of a wet look that leaves do not take on
SMOOTH = 0.45  # light that wet level ground mirrors, relative to a level film of water
ENTERS, KEPT = 0.934, 0.477  # diffuse light that enters water (n = 1.333), and that its surface sends back to the ground


def wet_share(light: Float[Tensor, "m 3"], wet: Float[Tensor, " m"]) -> Float[Tensor, "m 1"]:
    """Share of a wet look that Gaussians of linear light take on, from the share of them that is wet."""
    return wet[:, None].to(light) * (1 - WAXEN * leafy(light)[:, None])


def darkened(light: Float[Tensor, "m 3"], share: Float[Tensor, "m 1"]) -> Float[Tensor, "m 3"]:
    """Linear light of Gaussians that have a share of a wet look, without what they mirror."""
    return torch.lerp(light, wetted(light), share)


def under_water(light: Float[Tensor, "m 3"], share: Float[Tensor, " m"]) -> Float[Tensor, "m 3"]:
    """Linear light of ground of which a share lies under standing water, without what the water mirrors (Angstrom 1925).

    Args:
        light: of the wet ground, under white light of 1.
        share: 0..1.
    """
    albedo = light.clamp(0.0, 1.0)
    return torch.lerp(light, ENTERS * (1 - KEPT) * albedo / (1 - KEPT * albedo), share[:, None].to(light))


def mirrored_sky(
    normals: Float[Tensor, "m 3"],
    level: Float[Tensor, " m"],
    seen: Float[Tensor, " m"],
    towards: Float[Tensor, "m 3"],
    sky: tuple[float, float, float],
) -> Float[Tensor, "m 3"]:
    """Linear light of the sky that wet Gaussians mirror.

    Args:
        normals: unit, in the metric frame.
        level: of each Gaussian, as Exposure.level.
        seen: share of the sky that each sees.
        towards: metric unit vectors to the camera.
        sky: sRGB of the sky.
    """
    cosine = (normals.to(towards) * towards).sum(1)
    smooth = SMOOTH * level.to(towards) ** 2
    return (smooth * mirrored(cosine) * (cosine > 0) * seen.to(towards))[:, None] * linear(torch.tensor(sky).to(towards))
