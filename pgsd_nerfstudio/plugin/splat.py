"""Gaussians as the tensors of a splatfacto model, for the commands of nerfstudio that read those."""

from __future__ import annotations

import torch
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0

REST = 15  # coefficients of degree 1 to 3


def splat_tensors(frozen: Gaussians, weather: Gaussians) -> dict[str, Tensor]:
    """Both sets in one: log scales, opacity logits, colours as spherical harmonics of degree 3.

    Args:
        frozen: colours as spherical harmonics of any degree up to 3.
        weather: plain RGB; its harmonics above degree 0 are zero.
    """
    n = len(frozen)
    rest = torch.zeros(n + len(weather), REST, 3)
    stored = frozen.colors[:, 1 : 1 + REST].cpu()
    rest[:n, : stored.shape[1]] = stored
    opacities = torch.cat([frozen.opacities.cpu(), weather.opacities]).clamp(1e-6, 1 - 1e-6)
    return {
        "means": torch.cat([frozen.means.cpu(), weather.means]),
        "scales": torch.cat([frozen.scales.cpu(), weather.scales]).clamp_min(1e-12).log(),
        "quats": torch.nn.functional.normalize(torch.cat([frozen.quats.cpu(), weather.quats]), dim=1),
        "features_dc": torch.cat([frozen.colors[:, 0].cpu(), (weather.colors - 0.5) / SH_C0]),
        "features_rest": rest,
        "opacities": torch.logit(opacities)[:, None],
    }
