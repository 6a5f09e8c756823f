"""Text-to-video models of the Wan 2.1 family as a video prior.

Wan Team, "Wan: Open and Advanced Large-Scale Video Generative Models" (2025): a rectified flow (Liu et al. 2022). With
y = (1 - sigma) x0 + sigma eps the model predicts u = eps - x0 at timestep 1000 sigma. Distillation asks about
x_t = a x0 + s eps and wants v = a eps - s x0. With n = sqrt((1 - sigma)^2 + sigma^2)

    a = (1 - sigma) / n        s = sigma / n        y = n x_t

and, from x0 = y - sigma u and eps = y + (1 - sigma) u,

    v = (a - s) y + (a (1 - sigma) + s sigma) u = (1 - 2 sigma) x_t + n u

so that pure noise, a = 0, is no trouble. The shift of a sampling schedule says which sigmas are visited, not what a timestep
means: nothing here depends on it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.folder import Family, PriorError, read_config
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder
from pgsd_nerfstudio.guidance.video_prior import Sizes, VideoPrior
from pgsd_nerfstudio.guidance.wan_parts import WanPromptEncoder, read_transformer, recompute_blocks

NATIVE = (81, 480, 832)
"""Frames, height and width that the 1.3B was published for; no configuration says it."""
TEXT_LENGTH = 512
"""Tokens per text, as in training and in diffusers' pipeline; no configuration says it either."""


def alpha_bar(sigma: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Share of signal power at noise levels sigma of a rectified flow, 0..1: ((1 - sigma) / n)^2."""
    return (1 - sigma) ** 2 / ((1 - sigma) ** 2 + sigma**2)


def v_from_flow(flow: Float[Tensor, " b *s"], noisy: Float[Tensor, " #b *s"], sigma: float) -> Float[Tensor, " b *s"]:
    """v = (1 - 2 sigma) x_t + n u, of the flow u that was predicted at y = n x_t, with `noisy` = x_t."""
    return (1 - 2 * sigma) * noisy + math.hypot(1 - sigma, sigma) * flow


class WanPrior(VideoPrior):
    """A frozen Wan text-to-video model. Its noise schedule is the timestep of pure noise, sigma = 1. Example:

    >>> prior = WanPrior.load("Wan-AI/Wan2.1-T2V-1.3B-Diffusers", "cuda", frames=9)     # doctest: +SKIP
    """

    family = Family(
        "Wan",
        {"transformer": "WanTransformer3DModel", "vae": "AutoencoderKLWan"},
        channels="z_dim",
        prediction="flow_prediction",
        example="Wan-AI/Wan2.1-T2V-1.3B-Diffusers",
        assumed="flow_prediction",
    )
    prompt_encoder = WanPromptEncoder

    @classmethod
    def find(cls, place: str | Path) -> Path:
        """The folder of a Wan model with one transformer, judged before any weight is read.

        Raises:
            PriorError: there is no such folder or model, or it is not a complete Wan text-to-video model with one transformer.
        """
        folder = super().find(place)
        if (folder / "transformer_2").is_dir():
            raise PriorError(
                f"{folder} shares the noise levels between two transformers, as Wan 2.2 does, where one is expected; "
                f"use a Wan 2.1 model such as {cls.family.example}"
            )
        return folder

    def through(self, tiny: TinyEncoder) -> VideoPrior:
        """Refuse: the tiny encoder gives latents of CogVideoX. Wan's have the same shapes, so that no size would tell.

        Raises:
            PriorError: always.
        """
        raise PriorError(
            f"the tiny VAE taecvx gives latents of CogVideoX, but {self.name} is a Wan model; leave the tiny VAE out"
        )

    @torch.no_grad()
    def predict_v(
        self,
        noisy: Float[Tensor, "#b lt c lh lw"],
        timestep: int,
        text_embeddings: Float[Tensor, "b l d"],
    ) -> Float[Tensor, "b lt c lh lw"]:
        batch, sigma = text_embeddings.shape[0], timestep / len(self.alphas_cumprod)
        noisy = noisy.to(self.device, torch.float32)
        flow = self.transformer(
            hidden_states=(math.hypot(1 - sigma, sigma) * noisy).to(self.dtype).transpose(1, 2).expand(batch, -1, -1, -1, -1),
            timestep=torch.full((batch,), timestep, device=self.device, dtype=torch.long),
            encoder_hidden_states=text_embeddings.to(self.device, self.dtype),
            return_dict=False,
        )[0]
        return v_from_flow(flow.transpose(1, 2).float(), noisy, sigma)

    @staticmethod
    def _half_dtype(folder: Path) -> torch.dtype:
        return torch.bfloat16

    @staticmethod
    def _read(folder: Path, dtype: torch.dtype) -> tuple[Any, Any, Any]:
        from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

        transformer = read_transformer(folder / "transformer", dtype)
        how = {"low_cpu_mem_usage": False, "local_files_only": True}
        wide = torch.promote_types(dtype, torch.float32)
        vae = AutoencoderKLWan.from_pretrained(folder / "vae", torch_dtype=wide, **how)
        return transformer, vae, read_config(folder, "scheduler").get("num_train_timesteps", 1000)

    @staticmethod
    def _recompute(vae: Any) -> None:
        recompute_blocks(vae)

    @staticmethod
    def _alphas_cumprod(schedule: Any) -> Float[Tensor, " steps"]:
        # sigma = t / steps by definition, so that 999 is not quite pure noise (a = 0.001): Wan's own table of sigmas has just
        # these, 0 .. 0.999. diffusers' UniPC starts at sigma = 1 - 1e-6 and tells the transformer 999, rounded down.
        return alpha_bar(torch.arange(schedule, dtype=torch.float64) / schedule)

    def _read_sizes(self) -> Sizes:
        config = self.vae.config
        return Sizes(
            pixels_per_latent=int(config.scale_factor_spatial),
            frames_per_latent=int(config.scale_factor_temporal),
            patch=self.transformer.config.patch_size[1:],
            clip_shape=NATIVE,
            text_length=TEXT_LENGTH,
        )

    def _scaled(self, hidden: Float[Tensor, "1 c lt lh lw"]) -> Float[Tensor, "1 lt c lh lw"]:
        """Wan's latents are less the mean of each channel and divided by its spread over Wan's data."""
        mean, spread = self._channels(hidden)
        return ((hidden - mean) / spread).transpose(1, 2).float()

    def _unscaled(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "1 c lt lh lw"]:
        hidden = latents.to(self.device, self.vae.dtype).transpose(1, 2)
        mean, spread = self._channels(hidden)
        return hidden * spread + mean

    def _channels(self, like: Tensor) -> tuple[Float[Tensor, "c 1 1 1"], Float[Tensor, "c 1 1 1"]]:
        config = self.vae.config
        mean, spread = (like.new_tensor(values)[:, None, None, None] for values in (config.latents_mean, config.latents_std))
        return mean, spread
