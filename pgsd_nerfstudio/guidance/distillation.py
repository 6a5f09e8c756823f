"""Score distillation on latents: which way a clip should change for the video prior to find it likelier.

Poole et al., "DreamFusion" (2022), eq. 3, for a model that predicts v = a eps - s x0 (Salimans & Ho 2022), with
a = sqrt(alpha_bar), s = sqrt(1 - alpha_bar) and x_t = a x0 + s eps. Then

    eps_hat - eps = a (v_hat - v)        x0 - x0_hat = s (v_hat - v)

so nothing is ever divided by a, which is 0 at the last timestep of CogVideoX. The two other kinds that the paper compares, NFSD
and Bridge-SDS, are in `variants`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.variants import (
    ASKED,
    Embeddings,
    Omega,
    Rule,
    Variant,
    direction,
    noised,
    require_roles,
    rule_at,
)
from pgsd_nerfstudio.guidance.video_prior import VideoPrior


@dataclass(frozen=True, kw_only=True)
class DistillationConfig:
    """How the predictions of the video prior become a gradient."""

    variant: Variant = "sds"
    """Kind of score distillation: sds as in the paper; nfsd leaves the noise out of the gradient, against over-smoothing
    (Katzir et al. 2023); bridge does as sds first, then leads from the flawed look this leaves to a clean one, against
    oversaturation (McAllister et al. 2024). The paper's supplement finds both a little better; nfsd asks the prior about three
    texts a step, the others about two."""
    guidance_scale: float = 100.0
    """Classifier-free guidance s in v_neg + s (v_text - v_neg), of sds and of bridge's first stage; 100 as in the paper. (Its
    code adds s (v_text - v_neg) to v_text instead: the same with s + 1.)"""
    omega: Omega = "sds"
    """Weight of a timestep, which the paper leaves open: sds (1 - alpha_bar)(eps_hat - eps), as in DreamFusion, which fades
    toward pure noise; uniform 1 (eps_hat - eps); fantasia3d sqrt(alpha_bar)(1 - alpha_bar)(eps_hat - eps), as in Fantasia3D,
    which fades at both ends; paper_code (1 - alpha_bar)(x0 - x0_hat), as the paper's code has it: 0.24 times that of sds at
    t = 20, 9 times at 740, 202 times at 980."""
    nfsd_scale: float = 7.5
    """Guidance s of nfsd in s (eps_text - eps_0); 7.5, the usual scale for sampling, as in its paper: without the noise a
    hundred is not needed."""
    nfsd_threshold: int = 90
    """Timestep t* below which nfsd trusts the prior's prediction for the empty text to be all there is to correct; 90 is where
    CogVideoX-2B has the signal-to-noise ratio of Stable Diffusion at 200, the value of its paper."""
    bridge_scale: float = 30.0
    """Scale s of bridge's second stage in s (eps_target - eps_source); 30 as in its paper's code."""
    bridge_start: float = 0.5
    """Share of the training steps, 0-1, after which bridge's second stage begins; half of them, as in its paper's code. Below
    that, stage two starts from what does not yet resemble what is wanted."""
    max_rms: float = 10.0
    """Bound of the gradient's root mean square over the latents; a larger one is scaled down. Latents are of size 1."""

    def __post_init__(self) -> None:
        if not self.max_rms > 0:
            raise ValueError(f"max_rms must be positive, got {self.max_rms:g}")
        for name in ("guidance_scale", "nfsd_scale", "bridge_scale"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if self.nfsd_threshold < 0:
            raise ValueError(f"nfsd_threshold is a timestep and must not be negative, got {self.nfsd_threshold}")
        if not 0.0 <= self.bridge_start <= 1.0:
            raise ValueError(f"bridge_start is a share of the training steps in 0-1, got {self.bridge_start:g}")

    def scale_of(self, rule: Rule) -> float:
        """Guidance scale of a step that follows this rule."""
        return {"sds": self.guidance_scale, "bridge": self.bridge_scale}.get(rule, self.nfsd_scale)


@runtime_checkable
class Denoiser(Protocol):
    """What distillation needs of a video prior."""

    alphas_cumprod: Float[Tensor, " steps"]

    def predict_v(self, noisy: Tensor, timestep: int, text_embeddings: Tensor) -> Tensor: ...


class Distilled(NamedTuple):
    """One evaluation of the video prior."""

    gradient: Float[Tensor, "1 lt c lh lw"]
    """Of the loss with respect to the latents: omega (eps_hat - eps) / frames of the clip."""
    loss: float
    """|L_SDS| = 1/2 sum((omega (eps_hat - eps))^2) / frames of the clip, as in the paper's code: what SDS-adaptive weights are
    scaled by. With its target held fixed it has the gradient above, so that both are weighed against the other losses alike. A
    magnitude, not a loss to lower: as in DreamFusion there is no true loss behind the gradient."""
    timestep: int


class DistilledClip(NamedTuple):
    """One evaluation of the video prior, with its gradient carried back through the VAE to the pixels."""

    gradient: Float[Tensor, "t 3 h w"]
    """Of the loss with respect to the clip."""
    loss: float
    timestep: int


def distill(
    prior: Denoiser,
    latents: Float[Tensor, "1 lt c lh lw"],
    text: Float[Tensor, "1 l d"] | Embeddings,
    negative: Float[Tensor, "1 l d"] | None,
    timestep: int,
    *,
    config: DistillationConfig,
    generator: torch.Generator,
    frames: int = 1,
    progress: float | None = None,
) -> Distilled:
    """Ask the prior how latents should change.

    Args:
        prior: the video diffusion model.
        latents: scaled latents of the clip; no gradient passes through here.
        text: embedding of what is wanted; or all embeddings that `roles_of(config.variant)` names, by role, and no `negative`.
        negative: embedding of what is not; None where `text` holds all of them.
        timestep: noise level, 0 .. steps - 1.
        config: kind, weights and bounds.
        generator: source of the noise, on the CPU so that every device draws the same.
        frames: length of the clip, the F in |L_SDS|.
        progress: share of the training that is done, step / steps; only bridge needs it.

    Raises:
        FloatingPointError: the prior's prediction is not finite; the message names the timestep. The caller may skip the step.
        ValueError: embeddings are missing that the variant needs, or bridge was not told its progress.
    """
    embeddings = _by_role(text, negative)
    require_roles(config.variant, embeddings)
    rule = rule_at(config.variant, timestep, config.nfsd_threshold, progress, config.bridge_start)
    state = noised(latents.detach().float(), float(prior.alphas_cumprod[timestep]), generator)
    roles = ASKED[rule]
    predicted = prior.predict_v(state.noisy, timestep, torch.cat([embeddings[role] for role in roles]))
    # A scale of 100 leaves the range of float16 (65504) where predictions differ by more than 655.
    predicted = predicted.to(torch.promote_types(predicted.dtype, torch.float32))
    v = dict(zip(roles, predicted.split(1), strict=True))
    gradient = direction(rule, v, state, config.scale_of(rule), config.omega)
    bad = int((~torch.isfinite(gradient)).sum())
    if bad:
        raise FloatingPointError(f"the video prior's prediction at timestep {timestep} has {bad} NaN or infinite values")
    rms = float(gradient.double().square().mean().sqrt())
    if rms > config.max_rms:
        gradient = gradient * (config.max_rms / rms)
    return Distilled(gradient / frames, 0.5 * float(gradient.double().square().sum()) / frames, timestep)


def distill_clip(
    prior: VideoPrior,
    clip: Float[Tensor, "t 3 h w"],
    text: Float[Tensor, "1 l d"] | Embeddings,
    negative: Float[Tensor, "1 l d"] | None,
    timestep: int,
    *,
    config: DistillationConfig,
    generator: torch.Generator,
    progress: float | None = None,
) -> DistilledClip:
    """Ask the prior how a rendered clip should change, with one pass through the VAE's encoder and back.

    Args:
        prior: the video diffusion model.
        clip: frames in 0..1. Their own graph is not touched: the caller carries `gradient` on, frame by frame if memory is
            short.
        text: as `distill` takes it.
        negative: as `distill` takes it.
        timestep: noise level, 0 .. steps - 1.
        config: kind, weights and bounds.
        generator: source of the noise, on the CPU.
        progress: share of the training that is done; only bridge needs it.

    Raises:
        FloatingPointError: a prediction or the encoder's gradient is not finite; the message names the timestep.
        ValueError: as `distill`.
    """
    pixels = clip.detach().requires_grad_()
    latents = prior.encode(pixels)
    on_latents = distill(
        prior,
        latents,
        text,
        negative,
        timestep,
        config=config,
        generator=generator,
        frames=clip.shape[0],
        progress=progress,
    )
    # Half precision holds neither huge nor tiny gradients: carry it back at size 1. The way back is linear.
    size = on_latents.gradient.abs().max().clamp_min(torch.finfo(torch.float32).tiny)
    (gradient,) = torch.autograd.grad(latents, pixels, on_latents.gradient / size)
    gradient = gradient.to(clip) * size.to(clip)
    bad = int((~torch.isfinite(gradient)).sum())
    if bad:
        raise FloatingPointError(f"the VAE's gradient at timestep {timestep} has {bad} NaN or infinite values")
    return DistilledClip(gradient, on_latents.loss, timestep)


def _by_role(text: Tensor | Embeddings, negative: Tensor | None) -> Embeddings:
    if isinstance(text, Mapping):
        if negative is not None:
            raise ValueError("embeddings come by role or as text and negative, found both; give None for the negative one")
        return text
    return {"text": text} if negative is None else {"text": text, "negative": negative}
