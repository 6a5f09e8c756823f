"""Figures of the room guidance: its formulas against textbook ones and diffusers' pipeline, and what a training step costs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from pgsd_nerfstudio.cli import rows_prior_costs
from pgsd_nerfstudio.cli.records import Record
from pgsd_nerfstudio.cli.timing import best
from pgsd_nerfstudio.guidance import (
    DistillationConfig,
    Omega,
    PriorError,
    Role,
    TimestepSchedule,
    Variant,
    VideoPrior,
    distill,
    distill_clip,
    regularization_scale,
)

SHAPE = (1, 3, 4, 6, 8)
ALPHA_BAR = {20: "0.944", 500: "0.0953", 740: "0.0122", 980: "2.4e-5", 999: "0.0"}
STABLE_DIFFUSION_THRESHOLD = 200
SCALE = 7.0  # of the comparisons with explicit expressions
TEXTS = ["Fluffy snowflakes are falling in a courtyard, accumulating on surfaces.", "static, no snow, blurry"]
PIPELINE = "noise prediction of {} against diffusers' pipeline"
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
        self.alphas_cumprod = _scheduler().alphas_cumprod.double()

    def predict_v(self, noisy: Tensor, timestep: int, text_embeddings: Tensor) -> Tensor:
        ab = self.alphas_cumprod[timestep]
        eps, x0 = _posterior(noisy.double(), ab, text_embeddings)
        return ab.sqrt() * eps - (1 - ab).sqrt() * x0


def verify(quick: bool) -> list[Record]:
    """Laws with known answers."""
    random = _random_prior()
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
        Record.judged(
            "gradient on the clip against autograd",
            _autograd_error(random),
            "",
            "<= 1e-5",
            source="of (w (eps_hat - eps)).detach() * x0 with a random CogVideoX, relative L2",
        ),
        _pipeline_row("a random CogVideoX", random, None),
        *([] if quick else [_bundled_pipeline_row()]),
    ]


def bench(quick: bool) -> list[Record]:
    """Cost of a training step's guidance with the bundled prior, and of one with CogVideoX-2B by count."""
    return [*_bundled_costs(), *rows_prior_costs.rows(quick)]


def _bundled_costs() -> list[Record]:
    names = ("VAE encoder, forward and backward", "guidance pair of the transformer", "distillation of one clip")
    try:
        prior, text, negative = _bundled()
    except PriorError as error:
        return [Record(f"{name}, bundled prior", None, "s", source=str(error)) for name in names]
    frames, height, width = prior.clip_shape
    clip = torch.rand(frames, 3, height, width, generator=torch.Generator().manual_seed(0))
    noisy = prior.encode(clip).detach()
    both = torch.cat([negative, text])
    seconds = (
        best(lambda: _encode_and_back(prior, clip), 2),
        best(lambda: prior.predict_v(noisy, 500, both), 2),
        best(lambda: _distill_clip(prior, clip, text, negative), 2),
    )
    exact_prior = VideoPrior.load("bundled", prior.device, torch.float64)
    exact = _distill_clip(exact_prior, clip, text, negative)
    error = float((_distill_clip(prior, clip, text, negative) - exact).norm() / exact.norm())
    where = f"clip of {frames} frames of {width}x{height} on {prior.device}"
    label = "gradient on the clip against float64, relative L2"
    return [
        Record(f"{name}, bundled prior", s, "s", error, label, source=where) for name, s in zip(names, seconds, strict=True)
    ]


def _scheduler():
    from diffusers.schedulers.scheduling_ddim_cogvideox import CogVideoXDDIMScheduler

    return CogVideoXDDIMScheduler(
        beta_schedule="scaled_linear",
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        snr_shift_scale=3.0,
        timestep_spacing="trailing",
    )


def _alpha_bar_error() -> float:
    """Worst deviation from the published values, in units of their last digit."""
    alphas = _scheduler().alphas_cumprod.double()
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
    return int((_scheduler().alphas_cumprod.double().logit() - there).abs().argmin())


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


def _bundled() -> tuple[VideoPrior, Tensor, Tensor]:
    prior = VideoPrior.load("bundled", "cuda" if torch.cuda.is_available() else "cpu")
    text, negative = prior.encode_prompt(TEXTS).split(1)
    return prior, text, negative


def _random_prior() -> VideoPrior:
    """A CogVideoX of a few thousand random parameters; it never was on disk and has no text encoder."""
    from diffusers.models.autoencoders.autoencoder_kl_cogvideox import AutoencoderKLCogVideoX
    from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel

    with torch.random.fork_rng():
        torch.manual_seed(0)
        transformer = CogVideoXTransformer3DModel(
            num_attention_heads=2,
            attention_head_dim=16,
            in_channels=4,
            out_channels=4,
            time_embed_dim=8,
            text_embed_dim=16,
            num_layers=2,
            sample_height=4,
            sample_width=6,
            sample_frames=9,
            max_text_seq_length=12,
        )
        vae = AutoencoderKLCogVideoX(
            block_out_channels=(8, 8, 8, 8),  # type: ignore[arg-type]
            latent_channels=4,
            layers_per_block=1,
            norm_num_groups=2,
            sample_height=32,
            sample_width=48,
        )
    for model in (transformer, vae):
        torch.nn.Module.eval(model).requires_grad_(False)
    return VideoPrior(Path("random"), transformer, vae, _scheduler())


def _random_texts() -> tuple[Tensor, Tensor]:
    text, negative = torch.randn(2, 12, 16, generator=torch.Generator().manual_seed(3)).split(1)
    return text, negative


def _autograd_error(prior: VideoPrior) -> float:
    """The gradient of the explicit expression, with eps_hat made of x0_hat by the textbook's division, in float64."""
    text, negative = _random_texts()
    frames, height, width = prior.clip_shape
    clip = torch.rand(frames, 3, height, width, generator=torch.Generator().manual_seed(0))
    config, worst = DistillationConfig(max_rms=math.inf), 0.0
    for timestep in (100, 600):
        rng = torch.Generator().manual_seed(1)
        found = distill_clip(prior, clip, text, negative, timestep, config=config, generator=rng).gradient
        pixels, ab = clip.clone().requires_grad_(), prior.alphas_cumprod[timestep]
        x0, a, s = prior.encode(pixels), ab.sqrt(), (1 - ab).sqrt()
        eps = torch.randn(x0.shape, generator=torch.Generator().manual_seed(1)).double()
        x_t = a * x0.detach().double() + s * eps
        v = prior.predict_v(x_t.float(), timestep, torch.cat([negative, text])).double()
        e_negative, e_text = ((x_t - a * (a * x_t - s * v)) / s).split(1)
        eps_hat = e_negative + config.guidance_scale * (e_text - e_negative)
        (truth,) = torch.autograd.grad((((1 - ab) * (eps_hat - eps)).detach() * x0).sum(), pixels)
        worst = max(worst, float((found - truth).norm() / truth.norm()))
    return worst


def _bundled_pipeline_row() -> Record:
    try:
        prior, text, negative = _bundled()
    except PriorError as error:
        return Record(PIPELINE.format("the bundled prior"), None, "", source=str(error))
    return _pipeline_row("the bundled prior", prior, (text, negative))


def _pipeline_row(name: str, prior: VideoPrior, encoded: tuple[Tensor, Tensor] | None) -> Record:
    """One denoising step of diffusers' own pipeline, its guided prediction caught where it meets the scheduler.

    `encoded` are our embeddings of `TEXTS`, which the pipeline encodes by itself; without them both get random ones.
    """
    from diffusers.pipelines.cogvideo.pipeline_cogvideox import CogVideoXPipeline

    text, negative = encoded or _random_texts()
    if encoded:
        pipeline = CogVideoXPipeline.from_pretrained(prior.name, torch_dtype=prior.dtype, local_files_only=True).to(
            prior.device
        )
        told = {"prompt": TEXTS[0], "negative_prompt": TEXTS[1]}
    else:
        pipeline = CogVideoXPipeline(None, None, prior.vae, prior.transformer, _scheduler())  # type: ignore[arg-type]
        told = {"prompt_embeds": text, "negative_prompt_embeds": negative}
    pipeline.set_progress_bar_config(disable=True)
    caught: list[tuple[Tensor, int]] = []

    def step(v: Tensor, t: Tensor, latents: Tensor, **_: object) -> tuple[Tensor]:
        caught.append((v, int(t)))
        return (latents,)

    pipeline.scheduler.step = step
    frames, height, width = prior.clip_shape
    noisy = prior.encode(torch.rand(frames, 3, height, width, generator=torch.Generator().manual_seed(0)))
    length = prior.transformer.config.max_text_seq_length
    size = {"height": height, "width": width, "num_frames": frames}
    how = {"num_inference_steps": 2, "guidance_scale": 6.0, "output_type": "latent", "max_sequence_length": length}
    pipeline(latents=noisy, **told, **size, **how)  # type: ignore[arg-type]
    worst = 0.0
    for truth, timestep in caught:
        v_negative, v_text = prior.predict_v(noisy, timestep, torch.cat([negative, text])).split(1)
        worst = max(worst, float((v_negative + 6.0 * (v_text - v_negative) - truth).norm() / truth.norm()))
    return Record.judged(PIPELINE.format(name), worst, "", "<= 1e-4", source="relative L2, guidance scale 6, two timesteps")


def _encode_and_back(prior: VideoPrior, clip: Tensor) -> Tensor:
    pixels = clip.clone().requires_grad_()
    return torch.autograd.grad(prior.encode(pixels).square().sum(), pixels)[0]


def _distill_clip(prior: VideoPrior, clip: Tensor, text: Tensor, negative: Tensor) -> Tensor:
    rng = torch.Generator().manual_seed(0)
    return distill_clip(prior, clip, text, negative, 500, config=DistillationConfig(), generator=rng).gradient
