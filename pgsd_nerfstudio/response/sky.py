"""The sky of a captured scene: which Gaussians show it, and how it looks under a weather.

Captures of the outdoors often end in a sphere of Gaussians that show the sky, at any distance. Weather does not lie on them,
and haze before them is that before the sky. Beyond five times the distance of the cameras from what they look at, and not far
below the horizon, what is bright and not green counts as sky.

Clouds give the sky of the weather: L = L0 (1 + b sin h) at the height h, b = 2 for the CIE's overcast sky (Moon & Spencer,
"Illumination from a non-uniform sky", 1942). Light from bright ground lifts the horizon; b is 1 here, between that and an even
sky (b = 0). At 15 degrees that is 15 % brighter than the CIE's, relative to the light on level ground.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import leafy, luminance
from pgsd_nerfstudio.scene.gaussians import Gaussians

BEYOND = 5.0  # least distance from the nearest camera in radii: distances from the cameras to what they look at
BELOW = math.sin(math.radians(-6.0))  # sine of the least height; lower down only what is very far is sky
VERY_FAR = 20.0  # radii
BRIGHT = (0.13, 0.21)  # linear luminance between which what is far counts more and more as sky
GRADIENT = 1.0  # b
EVEN = 2 / 3  # sine of the height at which the overcast sky is as bright as the even one
CEILING = 150.0  # m; precipitation and haze higher up look like the cloud above them
FARTHEST = 3000.0  # m


def sky_share(metric: Gaussians, centers: Float[Tensor, "c 3"], radius: float) -> Float[Tensor, " n"]:
    """Share of each Gaussian that is sky, 0..1.

    Args:
        metric: the frozen Gaussians in metres, with plain RGB.
        centers: of the cameras in metres.
        radius: distance of the cameras from what they look at, in metres.
    """
    apart, _ = KDTree(centers.numpy(force=True)).query(metric.means.numpy(force=True))
    apart = torch.from_numpy(apart).to(metric.means)
    away = metric.means - centers.mean(0)
    height = away[:, 2] / away.norm(dim=1).clamp_min(1e-6)
    far = (apart > BEYOND * radius) & ((height > BELOW) | (apart > VERY_FAR * radius))
    light = linear(metric.colors)
    low, high = BRIGHT
    bright = ((luminance(light) - low) / (high - low)).clamp(0, 1)
    return far * bright * (1 - leafy(light))


def overcast(height: Float[Tensor, " n"], sky: tuple[float, float, float]) -> Float[Tensor, "n 3"]:
    """Linear light of the overcast sky.

    Args:
        height: sine of the height above the horizon; below it the sky is as bright as at the horizon.
        sky: sRGB of an even sky that lights level ground as much.
    """
    gradient = (1 + GRADIENT * height.clamp_min(0.0)) / (1 + 2 * GRADIENT / 3)
    return gradient[:, None] * linear(torch.tensor(sky).to(height))


def reach(height: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Metres of weather before the sky, from the sine of the height above the horizon."""
    return CEILING / height.clamp_min(CEILING / FARTHEST)
