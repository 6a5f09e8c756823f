"""Training of the VAE's decoder against its fixed encoder, on half frames first, then on whole ones.

Only pictures need it: score distillation never decodes. Flakes of one to three pixels are a small part of a frame but all of
the matter, so errors count more where a clip differs from the same clip without weather.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence

import torch
from diffusers import AutoencoderKLCogVideoX
from jaxtyping import Float
from torch import Tensor, nn

from bundled_prior.components import LOG_VARIANCE, latents
from bundled_prior.optimizer import Muon


def calm(vae: AutoencoderKLCogVideoX) -> None:
    """Every residual branch of the decoder starts at zero; what is learned first is the way straight through."""
    for block in [*vae.decoder.mid_block.resnets, *(r for up in vae.decoder.up_blocks for r in up.resnets)]:
        nn.init.zeros_(block.conv2.conv.weight)
        nn.init.zeros_(block.conv2.conv.bias)


def loss_of(
    vae: AutoencoderKLCogVideoX,
    clip: Float[Tensor, "b t 3 h w"],
    still: Float[Tensor, "b t 3 h w"],
    generator: torch.Generator,
) -> tuple[Tensor, "float"]:
    """Weighted error of the restored clip, and its PSNR in dB."""
    with torch.no_grad():
        code = latents(vae, clip)
        code = code + math.exp(0.5 * LOG_VARIANCE) * torch.randn(code.shape, generator=generator)
    restored, target = vae.decode(code).sample, 2 * clip.transpose(1, 2) - 1
    weight = 1 + 4 * (clip - still).abs().amax(dim=2)[:, None].clamp(max=0.5)
    error = ((restored - target).abs() * weight).mean()
    # Edges: sharp flakes, not only the right mean brightness.
    edges = sum((torch.diff(restored, dim=d) - torch.diff(target, dim=d)).abs().mean() for d in (3, 4))
    mse = float((0.5 * (restored.detach() - target)).square().mean())
    return error + 0.5 * edges, -10 * math.log10(mse)


def train_decoder(
    vae: AutoencoderKLCogVideoX,
    shards: Sequence[Tensor],  # each [families, kinds, t, 3, h, w], uint8, the first kind without weather
    *,
    minutes: float,
    rate: float,
    seed: int,
    report: Callable[[int, float, dict[str, float]], None],
    max_steps: int = 10**9,
    start: float = 0.0,
) -> None:
    """Trains for `minutes` of wall-clock time (or `max_steps`) with a rate that falls to zero along a cosine.

    `report(step, done, figures)` is called every 25 steps; `start` is the share of the time that is already over.
    """
    rng = random.Random(seed + int(1e6 * start))
    generator = torch.Generator().manual_seed(rng.getrandbits(40))
    vae.requires_grad_(False)
    vae.decoder.requires_grad_(True)
    optimizer = Muon(vae.decoder.parameters(), lr=rate)
    began, step, done, sums = time.monotonic(), 0, start, {"loss": 0.0, "psnr": 0.0}
    while done < 1:
        done = max(start + (time.monotonic() - began) / (60 * minutes), step / max_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 30) * max(0.02, 0.5 + 0.5 * math.cos(math.pi * min(1.0, done)))
        half = done < 0.7
        clips, stills = [], []
        for _ in range(2 if half else 1):
            shard = rng.choice(shards)
            family = shard[rng.randrange(len(shard))]
            chosen = family[[rng.randrange(len(family)), 0]].float() / 255
            if half:
                left = 4 * rng.randrange(chosen.shape[-1] // 8 + 1)
                chosen = chosen[..., left : left + chosen.shape[-1] // 2]
            chosen = chosen.flip(-1) if rng.random() < 0.5 else chosen
            clips.append(chosen[0])
            stills.append(chosen[1])
        loss, psnr = loss_of(vae, torch.stack(clips), torch.stack(stills), generator)
        if not torch.isfinite(loss):
            raise FloatingPointError(f"the loss of the decoder is {float(loss)} at step {step}; lower the rate")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(vae.decoder.parameters(), 1.0)
        optimizer.step()
        step += 1
        sums["loss"] += float(loss.detach())
        sums["psnr"] += psnr
        if step % 25 == 0:
            report(step, done, {name: value / 25 for name, value in sums.items()})
            sums = {"loss": 0.0, "psnr": 0.0}
