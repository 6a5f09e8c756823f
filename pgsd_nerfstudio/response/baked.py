"""One moment of a weathered scene as a set of Gaussians that files hold."""

from __future__ import annotations

from dataclasses import replace

import torch

from pgsd_nerfstudio.response.answer import Shown
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0


def baked(shown: Shown | None, frozen: Gaussians) -> Gaussians:
    """The frozen scene at a moment as a set of Gaussians for files, without mirror and haze, which depend on the camera.

    Args:
        shown: the answer at the moment; None: no change.
        frozen: the frozen scene, with spherical harmonics.
    """
    if shown is None:
        return frozen
    frozen = shown.altered(frozen)
    constant = 0.5 + SH_C0 * frozen.colors[:, 0]
    hidden = torch.cat([shown.hidden.to(constant), constant.new_ones(len(frozen) - len(shown.hidden))])
    after = shown.lit(constant, torch.arange(len(frozen), device=frozen.device), None)
    dimmed = luminance(after.clamp_min(0)) / luminance(constant.clamp_min(0)).clamp_min(1e-3)
    left = dimmed.clamp(0, 1) * (1 - hidden)
    bands = [((after - 0.5) / SH_C0)[:, None], frozen.colors[:, 1:] * left[:, None, None]]
    return replace(frozen, colors=torch.cat(bands, dim=1))
