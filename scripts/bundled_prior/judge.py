"""What a trained prior is worth: pictures to look at, and whether guidance points from a wrong look to the curated one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from bundled_prior.denoiser import CURATED, WRONG, Denoiser, Latents
from bundled_prior.looks import CURATED_CAPTION, WRONG_CAPTION

TIMESTEPS = (20, 100, 200, 300, 400, 500, 600, 700, 800, 900, 980)


def write_sheet(path: Path, rows: list[Float[Tensor, "t 3 h w"]], every: int = 4, zoom: int = 2) -> None:
    """One clip a row, every fourth frame of it."""
    sheet = torch.cat([torch.cat(list(clip[::every]), dim=2) for clip in rows], dim=1).clamp(0, 1)
    image = Image.fromarray((255 * sheet).round().byte().permute(1, 2, 0).numpy())
    path.parent.mkdir(parents=True, exist_ok=True)
    image.resize((zoom * image.width, zoom * image.height), Image.Resampling.NEAREST).save(path)


@torch.no_grad()
def decode(vae: AutoencoderKLCogVideoX, latents: Float[Tensor, "b lt c lh lw"]) -> Float[Tensor, "b t 3 h w"]:
    restored = vae.decode(latents.transpose(1, 2) / vae.config.scaling_factor).sample
    return (restored.transpose(1, 2) / 2 + 0.5).clamp(0, 1)


@torch.no_grad()
def sample(
    model: Denoiser,
    scheduler: CogVideoXDDIMScheduler,
    captions: list[str],
    *,
    steps: int = 25,
    guidance: float = 4.0,
    seed: int = 0,
) -> Float[Tensor, "b lt c lh lw"]:
    """Latents of new clips, one per caption, all from the same noise; guided against the empty caption."""
    config = model.transformer.config
    shape = (1, 3, config.in_channels, config.sample_height, config.sample_width)
    latents = torch.randn(shape, generator=torch.Generator().manual_seed(seed)).repeat(len(captions), 1, 1, 1, 1)
    scheduler.set_timesteps(steps)
    for t in scheduler.timesteps:
        both = model(torch.cat([latents, latents]), t.expand(2 * len(captions)), [""] * len(captions) + captions)
        empty, told = both.chunk(2)
        latents = scheduler.step(empty + guidance * (told - empty), t, latents, return_dict=False)[0]
    return latents


@torch.no_grad()
def direction(
    model: Denoiser, data: Latents, alpha_bar: Tensor, indices: list[int], *, negative: str = WRONG_CAPTION, seed: int = 0
) -> dict[int, tuple[float, float]]:
    """Per timestep: share of families in which descending the guidance leads from wrong to curated, and its mean cosine.

    The guidance is that of large guidance scales, v(curated words) - v(negative words), at the noised wrong clip.
    """
    generator = torch.Generator().manual_seed(seed)
    found = {}
    for t in TIMESTEPS:
        a, s = float(alpha_bar[t]) ** 0.5, float(1 - alpha_bar[t]) ** 0.5
        wrong = data.values[indices, 0, WRONG].float()
        curated = data.values[indices, 0, CURATED].float()
        noisy = a * wrong + s * torch.randn(wrong.shape, generator=generator)
        scenes = [data.families[i].scene for i in indices]
        words = [CURATED_CAPTION.format(scene=x) for x in scenes] + [negative.format(scene=x) for x in scenes]
        told, against = model(torch.cat([noisy, noisy]), torch.full((2 * len(indices),), t), words).chunk(2)
        cosine = torch.nn.functional.cosine_similarity((told - against).flatten(1), (wrong - curated).flatten(1))
        found[t] = (float((cosine > 0).float().mean()), float(cosine.mean()))
    return found


def as_table(found: dict[int, tuple[float, float]]) -> str:
    return "  ".join(f"t={t}: {share:.0%} {cosine:+.2f}" for t, (share, cosine) in found.items())


def overall(found: dict[int, tuple[float, float]]) -> float:
    """Share of positives over all timesteps."""
    return float(np.mean([share for share, _ in found.values()]))
