"""The light of a cover of snow or sand on frozen Gaussians."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import luminance, received

MIDDLE = 0.18  # linear light of a middle grey
RELIEF = 0.22  # share of a thin cover's light that follows the light of the surface below
FILLED = 0.008  # m; thickness over which a cover fills the folds below it


def cover_light(
    under: Float[Tensor, "m 3"],
    thickness: Float[Tensor, " m"],
    sky: Float[Tensor, " m"],
    rgb: tuple[float, float, float],
) -> Float[Tensor, "m 3"]:
    """Linear light of the cover.

    Args:
        under: linear light of the Gaussians below it.
        thickness: of the cover in metres.
        sky: share of the sky that each Gaussian sees.
        rgb: sRGB of the cover in the open.
    """
    folds = RELIEF * torch.exp(-thickness / FILLED)[:, None].to(under)
    relief = 1 - folds + folds * (luminance(under)[:, None] / MIDDLE).clamp_max(1.5)
    return linear(torch.tensor(rgb).to(under)) * relief * received(sky.to(under))[:, None]
