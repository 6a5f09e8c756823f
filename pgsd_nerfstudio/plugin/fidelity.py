"""How near a render comes to a photograph, over the pixels that the photograph shows."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def fidelity(rgb: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]) -> dict[str, float]:
    """PSNR in dB and SSIM of a render against a photograph.

    Args:
        rgb: the render.
        truth: the photograph.
        known: the pixels that the photograph shows; the mean of SSIM is over those whose whole window it shows.

    Returns:
        "psnr" and "ssim"; the latter is NaN where no whole window is known.
    """
    # Imported here: it takes seconds, and every ns-* command loads this module.
    from torchmetrics.functional.image import structural_similarity_index_measure

    error = (rgb - truth).square().mean(-1)[known].mean()
    ours, theirs = (picture.permute(2, 0, 1)[None] for picture in (rgb, torch.where(known[..., None], truth, rgb)))
    _, similar = structural_similarity_index_measure(ours, theirs, data_range=1.0, return_full_image=True)  # type: ignore[misc]
    # Its window has 11 pixels; pixels nearer to an edge than half of that do not count, as in torchmetrics' own mean.
    unknown = torch.nn.functional.pad((~known).float()[None, None], (5, 5, 5, 5), value=1.0)
    whole = torch.nn.functional.max_pool2d(unknown, 11, stride=1)[0, 0] == 0
    return {"psnr": float(-10 * error.log10()), "ssim": float(similar[0].mean(0)[whole].mean())}
