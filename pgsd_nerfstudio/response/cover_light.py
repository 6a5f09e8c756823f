"""The light of a cover of snow or sand on frozen Gaussians."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import luminance, under_sky

MIDDLE = 0.18  # linear light of a middle grey
RELIEF = 0.22  # share of a cover's light that follows the light of the surface below, whose folds are not filled at once


def cover_light(under: Float[Tensor, "m 3"], rgb: tuple[float, float, float], sky: Float[Tensor, " m"]) -> Float[Tensor, "m 3"]:
    """Linear light of the cover.

    Args:
        under: linear light of the Gaussians below it.
        rgb: sRGB of the cover in the open.
        sky: share of the sky that each Gaussian sees.
    """
    relief = 1 - RELIEF + RELIEF * (luminance(under)[:, None] / MIDDLE).clamp_max(1.5)
    return linear(torch.tensor(rgb).to(under)) * relief * under_sky(sky.to(under))
