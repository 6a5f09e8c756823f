"""Figures of the room guidance: its formulas against textbook ones and diffusers' pipeline, and what a training step costs."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from pgsd_nerfstudio.guidance import (
    CogVideoXPrior,
    DistillationConfig,
    PriorError,
    VideoPrior,
    distill_clip,
    load_prior,
)
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import distillation as rows_distillation
from pgsd_nerfstudio.laboratory.rows import prior_costs as rows_prior_costs
from pgsd_nerfstudio.laboratory.timing import best
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b, tiny_models

TEXTS = ["Fluffy snowflakes are falling in a courtyard, accumulating on surfaces.", "static, no snow, blurry"]
PIPELINE = "noise prediction of {} against diffusers' pipeline"


def verify(quick: bool) -> list[Record]:
    """Laws with known answers."""
    random = _random_prior()
    return [
        *rows_distillation.rows(quick),
        Record.judged(
            "gradient on the clip against autograd",
            _autograd_error(random),
            "",
            "<= 1e-5",
            source="of (w (eps_hat - eps)).detach() * x0 / frames with a random CogVideoX, relative L2",
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
    exact_prior = load_prior("bundled", prior.device, torch.float64)
    exact = _distill_clip(exact_prior, clip, text, negative)
    error = float((_distill_clip(prior, clip, text, negative) - exact).norm() / exact.norm())
    where = f"clip of {frames} frames of {width}x{height} on {prior.device}"
    label = "gradient on the clip against float64, relative L2"
    return [
        Record(f"{name}, bundled prior", s, "s", error, label, source=where) for name, s in zip(names, seconds, strict=True)
    ]


def _bundled() -> tuple[VideoPrior, Tensor, Tensor]:
    prior = load_prior("bundled", "cuda" if torch.cuda.is_available() else "cpu")
    text, negative = prior.encode_prompt(TEXTS).split(1)
    return prior, text, negative


def _random_prior() -> CogVideoXPrior:
    """A prior that never was on disk and has no text encoder."""
    return CogVideoXPrior(Path("random"), *tiny_models(), scheduler_2b())


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
        (truth,) = torch.autograd.grad((((1 - ab) * (eps_hat - eps)).detach() * x0).sum() / frames, pixels)
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
        pipeline = CogVideoXPipeline(None, None, prior.vae, prior.transformer, scheduler_2b())  # type: ignore[arg-type]
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
