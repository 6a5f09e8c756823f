"""The one door to a video prior: which class opens a folder or a model of the hub."""

from __future__ import annotations

from pathlib import Path

import torch

from pgsd_nerfstudio.guidance.cogvideox import CogVideoXPrior
from pgsd_nerfstudio.guidance.folder import find_folder, is_of
from pgsd_nerfstudio.guidance.video_prior import VideoPrior
from pgsd_nerfstudio.guidance.wan import WanPrior


def load_prior(
    place: str | Path,
    device: str | torch.device = "cpu",
    dtype: torch.dtype | None = None,
    *,
    frames: int | None = None,
    checkpointing: bool | None = None,
) -> VideoPrior:
    """Load a video prior of any family for inference; no weight ever gets a gradient.

    Args:
        place: "bundled", a diffusers folder of CogVideoX or Wan, or a hub id such as "THUDM/CogVideoX-2b".
        device: where the model computes.
        dtype: number format, see `VideoPrior.load`.
        frames: clip length, 4k + 1; None means the model's own.
        checkpointing: recompute the VAE encoder's activations in the backward pass instead of keeping them; None means on CUDA.

    Raises:
        PriorError: there is no such folder or model, or it is not a complete text-to-video model of either family.
        ValueError: clips of this model cannot have so many frames.
    """
    folder = find_folder(place)
    # A folder of neither family is judged as one of CogVideoX, which says what it lacks.
    kind = WanPrior if is_of(folder, WanPrior.family) else CogVideoXPrior
    return kind.load(folder, device, dtype, frames=frames, checkpointing=checkpointing)
