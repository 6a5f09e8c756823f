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

from pgsd_nerfstudio.guidance.folder import PriorError, read_config
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder
from pgsd_nerfstudio.guidance.video_prior import SMALL, VideoPrior, freeze, usable
from pgsd_nerfstudio.guidance.wan_parts import WanPromptEncoder, find_wan, read_transformer, recompute_blocks

NATIVE = (81, 480, 832)
"""Frames, height and width that the 1.3B was published for; no configuration says it."""
TEXT_LENGTH = 512
"""Tokens per text, as in training and in diffusers' pipeline; no configuration says it either."""


def alpha_bar(sigma: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Share of signal power at noise levels sigma of a rectified flow, 0..1: ((1 - sigma) / n)^2."""
    return (1 - sigma) ** 2 / ((1 - sigma) ** 2 + sigma**2)


def v_from_flow(flow: Float[Tensor, " b *s"], noisy: Float[Tensor, " 1|b *s"], sigma: float) -> Float[Tensor, " b *s"]:
    """v = (1 - 2 sigma) x_t + n u, of the flow u that was predicted at y = n x_t, with `noisy` = x_t."""
    return (1 - 2 * sigma) * noisy + math.hypot(1 - sigma, sigma) * flow


class WanPrior(VideoPrior):
    """A frozen Wan text-to-video model; what it takes and gives is what `VideoPrior` does. Example:

    >>> prior = WanPrior.load("Wan-AI/Wan2.1-T2V-1.3B-Diffusers", "cuda", frames=9)     # doctest: +SKIP
    """

    def __init__(self, folder: Path, transformer: Any, vae: Any, frames: int | None = None, steps: int = 1000) -> None:
        """From diffusers components; `load` is the usual way. `steps` is the timestep of pure noise, sigma = 1."""
        # Nothing of VideoPrior's own set-up applies: it reads CogVideoX' configuration.
        self.name = str(folder)
        self.transformer, self.vae = transformer, vae
        self.device, self.dtype = transformer.device, transformer.dtype
        # sigma = t / steps by definition, so that 999 is not quite pure noise (a = 0.001): Wan's own table of sigmas has just
        # these, 0 .. 0.999. diffusers' UniPC starts at sigma = 1 - 1e-6 and tells the transformer 999, rounded down.
        self.alphas_cumprod = alpha_bar(torch.arange(steps, dtype=torch.float64) / steps)
        self._space, self._time = int(vae.config.scale_factor_spatial), int(vae.config.scale_factor_temporal)
        self.clip_shape = (frames or NATIVE[0], *NATIVE[1:])
        self._check_frames(self.clip_shape[0])
        self.text_encoder = WanPromptEncoder(folder, TEXT_LENGTH, self.device, self.dtype)

    @staticmethod
    def load(
        place: str | Path,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | None = None,
        *,
        frames: int | None = None,
        checkpointing: bool | None = None,
    ) -> WanPrior:
        """Load a Wan model for inference; no weight ever gets a gradient.

        Args:
            place: a diffusers Wan folder, or a hub id such as "Wan-AI/Wan2.1-T2V-1.3B-Diffusers".
            device: where it computes.
            dtype: number format of the transformer; None means float32 on a CPU and for small models, bfloat16 on CUDA. The VAE
                never computes in less than float32, as its authors advise.
            frames: clip length, 4k + 1; None means 81.
            checkpointing: recompute the VAE encoder's activations in the backward pass, see `recompute_blocks`; None means on
                CUDA.

        Raises:
            PriorError: nothing usable is there; see `find_wan`.
            ValueError: clips of this model cannot have so many frames.
        """
        folder, device = find_wan(place), usable(device)
        wanted = dtype or (torch.float32 if device.type == "cpu" else torch.bfloat16)
        try:
            from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

            transformer = read_transformer(folder / "transformer", wanted)
            how = {"low_cpu_mem_usage": False, "local_files_only": True}
            wide = torch.promote_types(wanted, torch.float32)
            vae = AutoencoderKLWan.from_pretrained(folder / "vae", torch_dtype=wide, **how)
        except Exception as error:
            raise PriorError(f"the video prior in {folder} could not be loaded: {error}") from error
        if dtype is None and sum(p.numel() for p in transformer.parameters()) < SMALL:
            transformer = transformer.float()
        freeze(device, transformer, vae)
        if checkpointing or (checkpointing is None and device.type == "cuda"):
            recompute_blocks(vae)
        return WanPrior(folder, transformer, vae, frames, read_config(folder, "scheduler").get("num_train_timesteps", 1000))

    def through(self, tiny: TinyEncoder) -> VideoPrior:
        """Refused: the tiny encoder gives latents of CogVideoX. Wan's have the same shapes, so that no size would tell.

        Raises:
            PriorError: always.
        """
        raise PriorError(
            f"the tiny VAE taecvx gives latents of CogVideoX, but {self.name} is a Wan model; leave the tiny VAE out"
        )

    def encode(self, clip: Float[Tensor, "t 3 h w"]) -> Float[Tensor, "1 lt c lh lw"]:
        """Normalized latents (float32) of a clip in 0..1, differentiable.

        They are the mean of the VAE's posterior, less the mean of each channel and divided by its spread over Wan's data.

        Raises:
            ValueError: the clip's shape does not suit the VAE or the transformer's patches.
        """
        height, width = self._size(clip)
        rows, columns = (self._space * patch for patch in self.transformer.config.patch_size[1:])
        if height % rows or width % columns:
            raise ValueError(
                f"height and width of a clip must be multiples of {rows} and {columns} for this prior, found {height}x{width}"
            )
        video = (2 * clip - 1).to(self.device, self.vae.dtype).transpose(0, 1)[None]
        mean, spread = self._channels(video)
        return ((self.vae.encode(video).latent_dist.mode() - mean) / spread).transpose(1, 2).float()

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "t 3 h w"]:
        """The clip in 0..1 that normalized latents stand for; to look at, without gradient."""
        hidden = latents.to(self.device, self.vae.dtype).transpose(1, 2)
        mean, spread = self._channels(hidden)
        return (self.vae.decode(hidden * spread + mean).sample[0].transpose(0, 1).float() / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def predict_v(
        self,
        noisy: Float[Tensor, "1|b lt c lh lw"],
        timestep: int,
        text_embeddings: Float[Tensor, "b l d"],
    ) -> Float[Tensor, "b lt c lh lw"]:
        """v = sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) x0 as the model predicts it, in float32; no gradient passes through.

        `noisy` is variance preserving, with the alpha_bar of `alphas_cumprod[timestep]`. Latents of batch 1 are used for all
        texts, in one evaluation of the transformer.
        """
        batch, sigma = text_embeddings.shape[0], timestep / len(self.alphas_cumprod)
        noisy = noisy.to(self.device, torch.float32)
        flow = self.transformer(
            hidden_states=(math.hypot(1 - sigma, sigma) * noisy).to(self.dtype).transpose(1, 2).expand(batch, -1, -1, -1, -1),
            timestep=torch.full((batch,), timestep, device=self.device, dtype=torch.long),
            encoder_hidden_states=text_embeddings.to(self.device, self.dtype),
            return_dict=False,
        )[0]
        return v_from_flow(flow.transpose(1, 2).float(), noisy, sigma)

    def _channels(self, like: Tensor) -> tuple[Float[Tensor, "c 1 1 1"], Float[Tensor, "c 1 1 1"]]:
        config = self.vae.config
        mean, spread = (like.new_tensor(values)[:, None, None, None] for values in (config.latents_mean, config.latents_std))
        return mean, spread
