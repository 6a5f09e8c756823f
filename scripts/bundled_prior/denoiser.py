"""Training of transformer and text encoder on latents of families of clips.

Besides the usual denoising, some samples are told another look than the one they show: the noised clip of one look comes with
the caption of another of the same family, and the target is the clip of the caption. At low noise the picture already says
how the flakes look, so without such samples nothing would teach the model to believe the words, and score distillation,
which asks for a look that the clip does not have, would hear nothing.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from diffusers import CogVideoXTransformer3DModel
from jaxtyping import Float, Int
from torch import Tensor, distributed, nn
from transformers import PreTrainedTokenizerFast, T5EncoderModel

from bundled_prior.families import KINDS, Family
from bundled_prior.looks import flaws
from bundled_prior.nets import WORDS
from bundled_prior.optimizer import Muon

CLEAR, CURATED, WRONG, ANY = range(len(KINDS))
THIRDS = ("low", "middle", "high")
DROPOUT = 0.1
"""Share of captions left empty, for guidance against the empty prompt."""
FLAWED = 0.25
"""Share of the clips in other looks than the curated one whose caption only says that they are flawed."""
RETOLD = {CLEAR: 0.0, CURATED: 0.2, WRONG: 0.45, ANY: 0.6}
"""Share of the clips of each kind that are told the look of another clip of their family, mostly the curated one: that is what
distillation asks for, at looks that lie between a wrong one and the curated."""


@dataclass(frozen=True)
class Latents:
    """Families as the denoiser sees them."""

    families: list[Family]
    values: Float[Tensor, "n mirrored kinds lt c lh lw"]
    """Scaled latents, half precision to save memory; index 1 of the second axis is the mirrored clip."""


class Denoiser(nn.Module):
    """Text encoder and transformer as one module, as they are trained."""

    def __init__(
        self, transformer: CogVideoXTransformer3DModel, text_encoder: T5EncoderModel, tokenizer: PreTrainedTokenizerFast
    ):
        super().__init__()
        self.transformer, self.text_encoder, self.tokenizer = transformer, text_encoder, tokenizer

    def tokens(self, captions: list[str]) -> Int[Tensor, "b words"]:
        return self.tokenizer(captions, padding="max_length", max_length=WORDS, truncation=True, return_tensors="pt").input_ids

    def forward(self, noisy: Float[Tensor, "b lt c lh lw"], timestep: Int[Tensor, " b"], captions: list[str]) -> Tensor:
        """The predicted v."""
        embedding = self.text_encoder(self.tokens(captions).to(noisy.device)).last_hidden_state
        return self.transformer(noisy, embedding, timestep, return_dict=False)[0]


@dataclass(frozen=True)
class Batch:
    noisy: Float[Tensor, "b lt c lh lw"]
    timestep: Int[Tensor, " b"]
    captions: list[str]
    target: Float[Tensor, "b lt c lh lw"]
    weight: Float[Tensor, " b"]


def draw_batch(data: Latents, chosen: Sequence[int], alpha_bar: Float[Tensor, " steps"], rng: random.Random) -> Batch:
    """Three clips of each chosen family under the same noise: curated, wrong, and either of the others.

    Timesteps are spread evenly over the families of a batch.
    """
    clean, shown, captions, steps, noises, retold = [], [], [], [], [], []
    generator = torch.Generator().manual_seed(rng.getrandbits(40))
    offset = rng.random()
    for place, index in enumerate(chosen):
        family, clips = data.families[index], data.values[index][rng.randrange(2)].float()
        step = int(len(alpha_bar) * ((place + offset) / len(chosen) % 1))
        noise = torch.randn(clips.shape[1:], generator=generator)
        kinds = [CURATED, WRONG, rng.choice((CLEAR, ANY, ANY, ANY, ANY))]
        for kind in kinds:
            told = _told(rng, kind) if rng.random() < RETOLD[kind] else kind
            captions.append(_words(rng, family, kind, told))
            shown.append(clips[kind])
            clean.append(clips[told])
            retold.append(told != kind)
            steps.append(step)
            noises.append(noise)
    a = alpha_bar[steps].sqrt()[:, None, None, None, None]
    s = (1 - alpha_bar[steps]).sqrt()[:, None, None, None, None]
    x, noise = torch.stack(clean), torch.stack(noises)
    noisy = a * torch.stack(shown) + s * noise
    # v whose x0 = a x_t - s v is the clean clip; for a sample that shows what it is told this is a noise - s x0.
    target = torch.where(
        torch.tensor(retold)[:, None, None, None, None], (a * noisy - x) / s.clamp_min(0.05), a * noise - s * x
    )
    weight = torch.where(torch.tensor(retold), (s**2).flatten(), torch.ones(len(steps)))
    return Batch(noisy, torch.tensor(steps), captions, target, weight)


def _told(rng: random.Random, kind: int) -> int:
    others = [k for k in (CURATED, CURATED, WRONG, ANY) if k != kind]
    return rng.choice(others)


def _words(rng: random.Random, family: Family, kind: int, told: int) -> str:
    if told == kind:
        if rng.random() < DROPOUT:
            return ""
        if kind in (WRONG, ANY) and not family.looks[kind].curated and rng.random() < FLAWED:
            return flaws(rng)
    return family.caption(rng, told)


def train_denoiser(
    model: Denoiser,
    data: Latents,
    alpha_bar: Float[Tensor, " steps"],
    *,
    minutes: float,
    rate: float,
    seed: int,
    report: Callable[[int, float, dict[str, float]], None],
    families_per_batch: int = 4,
    max_steps: int = 10**9,
    start: float = 0.0,
) -> int:
    """Trains until `minutes` of wall-clock time (or `max_steps`) are over; the rate is constant, then falls to zero.

    `start` is the share of the time that an interrupted training has already had. Under torch.distributed every worker draws
    batches of its own, and all take the same step along the mean gradient; they must begin with the same weights.
    Returns the number of steps.
    """
    rank = distributed.get_rank() if distributed.is_initialized() else 0
    rng = random.Random(f"{seed} {start} {rank}")
    optimizer = Muon(model.parameters(), adam=[model.text_encoder.shared.weight, model.transformer.proj_out.weight], lr=rate)
    began, step, done, sums = time.monotonic(), 0, start, {}
    order: list[int] = []
    families_per_batch = min(families_per_batch, len(data.families))
    model.train()
    while done < 1:
        done = max(start + (time.monotonic() - began) / (60 * minutes), step / max_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 50) * max(0.01, min(1.0, 2 * (1 - done)))
        if len(order) < families_per_batch:
            order = rng.sample(range(len(data.families)), len(data.families))
        batch = draw_batch(data, [order.pop() for _ in range(families_per_batch)], alpha_bar, rng)
        predicted = model(batch.noisy, batch.timestep, batch.captions)
        errors = (predicted - batch.target).square().flatten(1).mean(dim=1)
        loss = (batch.weight * errors).mean()
        if not torch.isfinite(loss):
            raise FloatingPointError(f"the loss of the denoiser is {float(loss)} at step {step}; lower the rate")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        done = _average(model, done)
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        step += 1
        sums["loss"] = sums.get("loss", 0.0) + float(loss.detach())
        for error, t in zip((batch.weight * errors).tolist(), batch.timestep.tolist(), strict=True):
            name = THIRDS[min(2, t * 3 // len(alpha_bar))]
            sums[name] = sums.get(name, 0.0) + math.log(max(error, 1e-9))
            sums[f"{name} count"] = sums.get(f"{name} count", 0.0) + 1
        if step % 25 == 0:
            # The thirds of the timesteps tell more than their mean: each learns something else, in its own time.
            thirds = {name: math.exp(sums[name] / sums[f"{name} count"]) for name in THIRDS if name in sums}
            report(step, done, {"loss": sums["loss"] / 25, **thirds})
            sums = {}
    model.eval()
    return step


def _average(model: nn.Module, done: float) -> float:
    """Mean of the workers' gradients, put in place, and the latest of their clocks, so that all end together."""
    if not distributed.is_initialized():
        return done
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    flat = torch.cat([g.flatten() for g in gradients])
    distributed.all_reduce(flat)
    flat /= distributed.get_world_size()
    for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))
    clock = torch.tensor([done], dtype=torch.float64)
    distributed.all_reduce(clock, op=distributed.ReduceOp.MAX)
    return float(clock)
