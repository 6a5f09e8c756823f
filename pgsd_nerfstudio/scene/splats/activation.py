"""Raw variables of a trained splat, checked and activated.

Trainers store the variables of their optimizer (log scales, opacity logits); `Gaussians` holds the activated values.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError


def activated(path: Path, raw: Mapping[str, Tensor]) -> Gaussians:
    """Check the raw fields and activate them; they come in the order of `Gaussians`, with the colours in two parts."""
    means, quats, log_scales, logits, dc, rest = raw.values()
    if means.shape[0] == 0:
        raise SceneError(f"{path} is an empty scene: it holds 0 Gaussians")
    for name, values in raw.items():
        if bad := int((~torch.isfinite(values)).sum()):
            raise SceneError(f"{path}: {bad} values of its {name} are NaN or infinite; clean or retrain the splat")
    if zero := int((quats.norm(dim=1) == 0).sum()):
        raise SceneError(f"{path}: {zero} of its rotations are quaternions of length 0; clean or retrain the splat")
    gaussians = Gaussians(
        means,
        torch.nn.functional.normalize(quats, dim=1),
        log_scales.exp(),
        logits.sigmoid(),
        torch.cat([dc, rest], dim=1).contiguous(),
    )
    try:
        gaussians.check_finite()
    except ValueError as error:
        raise SceneError(f"{path}: {error} once activated (log scales reach {float(log_scales.max()):.3g})") from error
    return gaussians
