"""Figures of score distillation where everything is known in closed form: the exact denoiser of Gaussian clips."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import get_args

import torch
from torch import Tensor

from pgsd_nerfstudio.guidance import (
    DistillationConfig,
    Omega,
    Role,
    TimestepSchedule,
    Variant,
    distill,
    regularization_scale,
)
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b

SHAPE = (1, 3, 4, 6, 8)
ALPHA_BAR = {20: "0.944", 500: "0.0953", 740: "0.0122", 980: "2.4e-5", 999: "0.0"}
STABLE_DIFFUSION_THRESHOLD = 200
SCALE = 7.0  # of the comparisons with explicit expressions
MODE, DEVIATION = 0.7, 0.3


def _belief(mean: float, sigma: float) -> Tensor:
    """What `_GaussianPrior` takes for a text's embedding: the clips that the text describes."""
    return torch.tensor([[[mean, sigma]]], dtype=torch.float64)


APART: dict[Role, Tensor] = {
    "text": _belief(0.4, 0.7),
    "negative": _belief(-0.2, 0.9),
    "empty": _belief(0.1, 1.1),
    "flaws": _belief(-0.5, 1.3),
    "target": _belief(0.5, 0.6),
    "source": _belief(-0.1, 0.8),
}
"""Texts that all mean something else, to compare formulas."""
NESTED: dict[Role, Tensor] = {
    "text": _belief(MODE, DEVIATION),
    "negative": _belief(MODE, 1.0),
    "empty": _belief(MODE, 0.8),
    "flaws": _belief(MODE, 1.2),
    "target": _belief(MODE, DEVIATION),
    "source": _belief(MODE, 0.8),
}
"""Texts that narrow down one and the same thing: what is wanted is the narrowest, so that every variant leads to its mode."""


class _GaussianPrior:
    """Exact denoiser of Gaussian clips, whose score is known in closed form; a text's embedding is their mean and deviation."""

    def __init__(self) -> None:
        self.alphas_cumprod = scheduler_2b().alphas_cumprod.double()

    def predict_v(self, noisy: Tensor, timestep: int, text_embeddings: Tensor) -> Tensor:
        ab = self.alphas_cumprod[timestep]
        eps, x0 = _posterior(noisy.double(), ab, text_embeddings)
        return ab.sqrt() * eps - (1 - ab).sqrt() * x0


def rows(quick: bool) -> list[Record]:
    """Laws with known answers."""
    return [
        Record.judged(
            "alpha_bar of CogVideoX-2B",
            _alpha_bar_error(),
            "of the last digit",
            "<= 0.5",
            source="published to two or three digits at t = 20, 500, 740, 980, 999",
        ),
        Record.judged(
            "timestep with the signal-to-noise ratio of Stable Diffusion's 200",
            _threshold(),
            "",
            f"== {DistillationConfig().nfsd_threshold}",
            source="NFSD's t*, nearest in log(alpha_bar / (1 - alpha_bar))",
        ),
        Record.judged(
            "v-form against the textbook gradient",
            _textbook_error(),
            "",
            "<= 1e-6",
            source="sds, nfsd, bridge with all omegas at t = 20 to 999; closed-form posterior in float64, relative L2",
        ),
        Record.judged(
            "largest gradient at pure noise, t = 999",
            _largest_at_pure_noise(),
            "root mean square",
            "<= 10.001",
            source="sds, nfsd, bridge with all omegas at their own scales; bounded by max_rms = 10, a NaN would be no figure",
        ),
        *(_mode_row(variant, 800 if quick else 2000) for variant in get_args(Variant)),
    ]


def _alpha_bar_error() -> float:
    """Worst deviation from the published values, in units of their last digit."""
    alphas = scheduler_2b().alphas_cumprod.double()
    worst = 0.0
    for timestep, text in ALPHA_BAR.items():
        digits, _, power = text.partition("e")
        unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
        worst = max(worst, abs(float(alphas[timestep]) - float(text)) / unit)
    return worst


def _threshold() -> int:
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    scheduler = DDPMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    there = scheduler.alphas_cumprod.double()[STABLE_DIFFUSION_THRESHOLD].logit()
    return int((scheduler_2b().alphas_cumprod.double().logit() - there).abs().argmin())


def _posterior(x_t: Tensor, alpha_bar: Tensor, belief: Tensor) -> tuple[Tensor, Tensor]:
    """Expected noise and expected latents, given the noisy ones and that clean ones are Gaussian."""
    mean, sigma = belief[:, 0].double().reshape(-1, 2, 1, 1, 1, 1).unbind(1)
    a, variance = alpha_bar.sqrt(), alpha_bar * sigma**2 + 1 - alpha_bar
    away = x_t - a * mean
    return (1 - alpha_bar).sqrt() * away / variance, mean + a * sigma**2 * away / variance


def _textbook(variant: Variant, omega: Omega, timestep: int, latents: Tensor, alphas: Tensor) -> Tensor:
    """The gradient as the publications write it, in noise or, for paper_code, in latents; no v, all in float64."""
    ab, threshold = alphas[timestep], DistillationConfig().nfsd_threshold
    a, s = ab.sqrt(), (1 - ab).sqrt()
    x0, eps = latents.double(), torch.randn(SHAPE, generator=torch.Generator().manual_seed(2)).double()
    known = {role: _posterior(a * x0 + s * eps, ab, belief) for role, belief in APART.items()}
    # x0 falls where the noise rises: a difference of latents has the other sign.
    which, sign, truth = (1, -1.0, x0) if omega == "paper_code" else (0, 1.0, eps)
    e = {role: sign * posterior[which] for role, posterior in known.items()}
    wanted = SCALE * (e["text"] - e["empty"])
    if variant == "sds":
        found = e["negative"] + SCALE * (e["text"] - e["negative"]) - sign * truth
    elif variant == "bridge":
        found = SCALE * (e["target"] - e["source"])
    elif timestep >= threshold:
        found = wanted + e["empty"] - e["flaws"]
    else:
        found = wanted + (s / a if omega == "paper_code" else 1.0) * known["empty"][0]
    return {"sds": 1 - ab, "uniform": 1.0, "fantasia3d": a * (1 - ab), "paper_code": 1 - ab}[omega] * found


def _textbook_error() -> float:
    """Worst of all variants, omegas and seven timesteps."""
    prior, worst = _GaussianPrior(), 0.0
    latents = torch.randn(SHAPE, generator=torch.Generator().manual_seed(1))
    for variant in get_args(Variant):
        for omega in get_args(Omega):
            config = DistillationConfig(
                variant=variant,
                omega=omega,
                guidance_scale=SCALE,
                nfsd_scale=SCALE,
                bridge_scale=SCALE,
                max_rms=math.inf,
            )
            for timestep in (20, 89, 90, 300, 740, 980, 999):
                truth = _textbook(variant, omega, timestep, latents, prior.alphas_cumprod)
                found = _gradient(prior, latents, APART, timestep, config)
                worst = max(worst, float((found - truth).norm() / truth.norm().clamp_min(1e-12)))
    return worst


def _gradient(
    prior: _GaussianPrior, latents: Tensor, told: Mapping[Role, Tensor], timestep: int, config: DistillationConfig
) -> Tensor:
    rng = torch.Generator().manual_seed(2)
    return distill(prior, latents, told, None, timestep, config=config, generator=rng, progress=1.0).gradient


def _largest_at_pure_noise() -> float:
    prior, latents = _GaussianPrior(), torch.randn(SHAPE, generator=torch.Generator().manual_seed(1))
    configs = [DistillationConfig(variant=v, omega=o) for v in get_args(Variant) for o in get_args(Omega)]
    return max(float(_gradient(prior, latents, APART, 999, config).square().mean().sqrt()) for config in configs)


def _mode_row(variant: Variant, steps: int) -> Record:
    """Descent as in training: Adam, the paper's timesteps, and a motion prior that pulls by |L_SDS| toward somewhere else."""
    prior, rng = _GaussianPrior(), torch.Generator().manual_seed(2)
    config = DistillationConfig(variant=variant, guidance_scale=1.0)
    latents = torch.full(SHAPE, MODE - 12 * DEVIATION, requires_grad=True)
    simulated = torch.full(SHAPE, MODE + 2 * DEVIATION)
    optimizer, mean, counted = torch.optim.Adam([latents], lr=0.05), torch.zeros(SHAPE), steps // 4
    for step in range(steps):
        timestep, progress = TimestepSchedule().sample(step, steps, rng), step / steps
        found = distill(prior, latents, NESTED, None, timestep, config=config, generator=rng, frames=9, progress=progress)
        drift = (latents - simulated).norm(dim=2).mean()
        optimizer.zero_grad()
        weight = 0.01 * regularization_scale("adaptive", found.loss)
        ((found.gradient.float() * latents).sum() + weight * drift).backward()
        optimizer.step()
        if step >= steps - counted:
            mean += latents.detach() / counted
    away = (mean - MODE) / DEVIATION
    return Record.judged(
        f"mode found by {variant} in a Gaussian prior",
        float(away.mean().abs()),
        "standard deviations",
        "<= 0.2",
        error=float(away.abs().max()),
        error_unit="standard deviations, worst latent",
        source=f"mean of {mean.numel()} latents that began 12 deviations away, with adaptive regularization toward a motion 2 "
        f"deviations beyond; {steps} steps, the last quarter averaged",
    )
