"""Figures of the room guidance: its formulas against textbook ones and diffusers' pipeline, and what a training step costs."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pgsd_nerfstudio.cli.records import Record
from pgsd_nerfstudio.cli.timing import best
from pgsd_nerfstudio.guidance import DistillationConfig, PriorError, TimestepSchedule, VideoPrior, distill, distill_clip

SHAPE = (1, 3, 4, 6, 8)
ALPHA_BAR = {20: 0.944, 500: 0.0953, 740: 0.0122, 980: 2.4e-5, 999: 0.0}
TEXTS = ["Fluffy snowflakes are falling in a courtyard, accumulating on surfaces.", "static, no snow, blurry"]
PIPELINE = "noise prediction of the bundled prior against diffusers' pipeline"


class _GaussianPrior:
    """Exact denoiser of Gaussian data, whose score is known in closed form."""

    def __init__(self, mean: float, sigma: float) -> None:
        self.alphas_cumprod, self.mean, self.sigma = _scheduler().alphas_cumprod.double(), mean, sigma

    def predict_v(self, noisy: Tensor, timestep: int, text_embeddings: Tensor) -> Tensor:
        ab = self.alphas_cumprod[timestep]
        x = noisy.double().expand(text_embeddings.shape[0], *noisy.shape[1:])
        x0 = self.mean + ab.sqrt() * self.sigma**2 / (ab * self.sigma**2 + 1 - ab) * (x - ab.sqrt() * self.mean)
        return ab.sqrt() * (x - ab.sqrt() * x0) / (1 - ab).sqrt() - (1 - ab).sqrt() * x0


def verify(quick: bool) -> list[Record]:
    """Laws with known answers."""
    return [
        Record.judged(
            "alpha_bar of CogVideoX-2B", _alpha_bar_error(), "", "<= 0.02", source="relative, at t = 20, 500, 740, 980, 999"
        ),
        Record.judged(
            "v-form against the textbook gradient",
            _textbook_error(),
            "",
            "<= 1e-5",
            source="DreamFusion eq. 3 in float64, relative L2",
        ),
        Record.judged(
            "mode found by descent in a Gaussian prior",
            _mode_error(800 if quick else 2000),
            "standard deviations",
            "<= 0.35",
            source="distance to the data's mean; closed-form score, annealed timesteps",
        ),
        _pipeline_row(),
    ]


def bench(quick: bool) -> list[Record]:
    """Cost of a training step's guidance with the bundled prior."""
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
    found = _scheduler().alphas_cumprod
    return max(abs(float(found[t]) - truth) / (truth or 1.0) for t, truth in ALPHA_BAR.items())


def _textbook_error() -> float:
    """Worst of both omegas and four timesteps."""
    prior, text, worst = _GaussianPrior(0.4, 0.7), torch.zeros(1, 1, 1), 0.0
    latents = torch.randn(SHAPE, generator=torch.Generator().manual_seed(1))
    for timestep in (20, 300, 740, 980):
        ab = prior.alphas_cumprod[timestep]
        a, s = ab.sqrt(), (1 - ab).sqrt()
        eps = torch.randn(SHAPE, generator=torch.Generator().manual_seed(2)).double()
        x_t = a * latents.double() + s * eps
        x0_hat = a * x_t - s * prior.predict_v(x_t, timestep, text)
        eps_hat = (x_t - a * x0_hat) / s
        truths = {"sds": (1 - ab) * (eps_hat - eps), "paper_code": (1 - ab) * (latents - x0_hat)}
        for omega, truth in truths.items():
            config = DistillationConfig(guidance_scale=1.0, omega=omega, max_rms=math.inf)  # type: ignore[arg-type]
            rng = torch.Generator().manual_seed(2)
            found = distill(prior, latents, text, text, timestep, config=config, generator=rng).gradient
            worst = max(worst, float((found - truth).norm() / truth.norm()))
    return worst


def _mode_error(steps: int) -> float:
    prior, text, rng = _GaussianPrior(0.7, 0.3), torch.zeros(1, 1, 1), torch.Generator().manual_seed(2)
    latents, mean, config = torch.full(SHAPE, -3.0), torch.zeros(SHAPE), DistillationConfig(guidance_scale=1.0)
    for step in range(steps):
        timestep = TimestepSchedule().sample(step, steps, rng)
        latents = latents - 0.05 * distill(prior, latents, text, text, timestep, config=config, generator=rng).gradient.float()
        mean += latents * (step >= steps // 2) / (steps - steps // 2)
    return float((mean - 0.7).abs().max()) / 0.3


def _bundled() -> tuple[VideoPrior, Tensor, Tensor]:
    prior = VideoPrior.load("bundled", "cuda" if torch.cuda.is_available() else "cpu")
    text, negative = prior.encode_prompt(TEXTS).split(1)
    return prior, text, negative


def _pipeline_row() -> Record:
    """One denoising step of diffusers' own pipeline, its guided prediction caught where it meets the scheduler."""
    try:
        prior, text, negative = _bundled()
    except PriorError as error:
        return Record(PIPELINE, None, "", source=str(error))
    from diffusers.pipelines.cogvideo.pipeline_cogvideox import CogVideoXPipeline

    pipeline = CogVideoXPipeline.from_pretrained(prior.name, torch_dtype=prior.dtype, local_files_only=True).to(prior.device)
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
    pipeline(prompt=TEXTS[0], negative_prompt=TEXTS[1], latents=noisy, **size, **how)  # type: ignore[arg-type]
    worst = 0.0
    for truth, timestep in caught:
        v_negative, v_text = prior.predict_v(noisy, timestep, torch.cat([negative, text])).split(1)
        worst = max(worst, float((v_negative + 6.0 * (v_text - v_negative) - truth).norm() / truth.norm()))
    return Record.judged(PIPELINE, worst, "", "<= 1e-4", source="relative L2, guidance scale 6, two timesteps")


def _encode_and_back(prior: VideoPrior, clip: Tensor) -> Tensor:
    pixels = clip.clone().requires_grad_()
    return torch.autograd.grad(prior.encode(pixels).square().sum(), pixels)[0]


def _distill_clip(prior: VideoPrior, clip: Tensor, text: Tensor, negative: Tensor) -> Tensor:
    rng = torch.Generator().manual_seed(0)
    return distill_clip(prior, clip, text, negative, 500, config=DistillationConfig(), generator=rng).gradient
