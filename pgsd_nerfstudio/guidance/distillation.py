"""Score distillation on latents: which way a clip should change for the video prior to find it likelier.

Poole et al., "DreamFusion" (2022), eq. 3, for a model that predicts v = a eps - s x0 (Salimans & Ho 2022), with
a = sqrt(alpha_bar), s = sqrt(1 - alpha_bar) and x_t = a x0 + s eps. Then

    eps_hat - eps = a (v_hat - v)        x0 - x0_hat = s (v_hat - v)

so nothing is ever divided by a, which is 0 at the last timestep of CogVideoX.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.prior import VideoPrior


@dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """How the prediction of the video prior becomes a gradient."""

    guidance_scale: float = 100.0
    """Classifier-free guidance s in v_neg + s (v_text - v_neg); 100 as in the paper. (Its code adds s (v_text - v_neg) to
    v_text instead: the same with s + 1.)"""
    omega: Literal["sds", "paper_code"] = "sds"
    """Weight of a timestep: sds (1 - alpha_bar)(eps_hat - eps), as in DreamFusion, which fades toward pure noise; paper_code
    (1 - alpha_bar)(x0 - x0_hat), 0.24 times that at t = 20, 9 times at 740, 202 times at 980."""
    max_rms: float = 10.0
    """Bound of the gradient's root mean square over the latents; a larger one is scaled down. Latents are of size 1."""

    def __post_init__(self) -> None:
        if not self.max_rms > 0:
            raise ValueError(f"max_rms must be positive, got {self.max_rms:g}")


class Denoiser(Protocol):
    """What distillation needs of a video prior."""

    alphas_cumprod: Float[Tensor, "steps"]

    def predict_v(self, noisy: Tensor, timestep: int, text_embeddings: Tensor) -> Tensor: ...


class Distilled(NamedTuple):
    """One evaluation of the video prior."""

    gradient: Float[Tensor, "1 lt c lh lw"]
    """Of the loss with respect to the latents."""
    loss: float
    """|L_SDS| = 1/2 sum(gradient^2) / frames of the clip, as in the paper's code: what SDS-adaptive weights are scaled by.
    A magnitude, not a loss to differentiate: as in DreamFusion there is no true loss behind the gradient."""
    timestep: int


class DistilledClip(NamedTuple):
    """The same, carried back through the VAE to the pixels."""

    gradient: Float[Tensor, "t 3 h w"]
    """Of the loss with respect to the clip."""
    loss: float
    timestep: int


def distill(
    prior: Denoiser,
    latents: Float[Tensor, "1 lt c lh lw"],
    text: Float[Tensor, "1 l d"],
    negative: Float[Tensor, "1 l d"],
    timestep: int,
    *,
    config: DistillationConfig,
    generator: torch.Generator,
    frames: int = 1,
) -> Distilled:
    """Vanilla SDS on latents.

    Args:
        prior: the video diffusion model.
        latents: scaled latents of the clip; no gradient passes through here.
        text: embedding of what is wanted.
        negative: embedding of what is not.
        timestep: noise level, 0 .. steps - 1.
        config: weights and bounds.
        generator: source of the noise, on the CPU so that every device draws the same.
        frames: length of the clip, the F in |L_SDS|.

    Raises:
        FloatingPointError: the prior's prediction is not finite; the message names the timestep. The caller may skip the step.
    """
    latents = latents.detach().float()
    alpha_bar = float(prior.alphas_cumprod[timestep])
    a, s = alpha_bar**0.5, (1.0 - alpha_bar) ** 0.5
    noise = torch.randn(latents.shape, generator=generator).to(latents)
    both = prior.predict_v(a * latents + s * noise, timestep, torch.cat([negative, text]))
    v_negative, v_text = both[:1], both[1:]
    v_hat = v_negative + config.guidance_scale * (v_text - v_negative)
    surprise = v_hat - (a * noise - s * latents)
    bad = int((~torch.isfinite(surprise)).sum())
    if bad:
        raise FloatingPointError(f"the video prior's prediction at timestep {timestep} has {bad} NaN or infinite values")
    gradient = s * s * (a if config.omega == "sds" else s) * surprise
    rms = float(gradient.double().square().mean().sqrt())
    if rms > config.max_rms:
        gradient = gradient * (config.max_rms / rms)
    return Distilled(gradient, 0.5 * float(gradient.double().square().sum()) / frames, timestep)


def distill_clip(
    prior: VideoPrior,
    clip: Float[Tensor, "t 3 h w"],
    text: Float[Tensor, "1 l d"],
    negative: Float[Tensor, "1 l d"],
    timestep: int,
    *,
    config: DistillationConfig,
    generator: torch.Generator,
) -> DistilledClip:
    """SDS for a rendered clip in 0..1, with one pass through the VAE's encoder and back.

    The clip's own graph is not touched: the caller carries `gradient` on, frame by frame if memory is short.

    Raises:
        FloatingPointError: a prediction or the encoder's gradient is not finite; the message names the timestep.
    """
    pixels = clip.detach().requires_grad_()
    latents = prior.encode(pixels)
    on_latents = distill(prior, latents, text, negative, timestep, config=config, generator=generator, frames=clip.shape[0])
    # Half precision holds neither huge nor tiny gradients: carry it back at size 1. The way back is linear.
    size = on_latents.gradient.abs().max().clamp_min(torch.finfo(torch.float32).tiny)
    (gradient,) = torch.autograd.grad(latents, pixels, on_latents.gradient / size)
    gradient = gradient.to(clip) * size.to(clip)
    bad = int((~torch.isfinite(gradient)).sum())
    if bad:
        raise FloatingPointError(f"the VAE's gradient at timestep {timestep} has {bad} NaN or infinite values")
    return DistilledClip(gradient, on_latents.loss, timestep)
