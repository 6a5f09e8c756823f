"""Text-to-video models of the CogVideoX family as a video prior.

Yang et al., "CogVideoX" (2024). The bundled small model and CogVideoX-2B have the same parts (causal 3D VAE, expert
transformer, T5, DDIM scheduler with v-prediction), so one class serves both, and the larger 5B and 1.5 as well.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.folder import Family, PriorError, stored_dtype
from pgsd_nerfstudio.guidance.tiny_vae import LATENT_CHANNELS, SPACE, TIME, TinyEncoder
from pgsd_nerfstudio.guidance.video_prior import Sizes, VideoPrior

HALF = {"F16": torch.float16, "BF16": torch.bfloat16}


class CogVideoXPrior(VideoPrior):
    """A frozen CogVideoX text-to-video model. Its noise schedule is diffusers' CogVideoXDDIMScheduler: alpha_bar follows from
    SNR shift and zero-terminal rescaling, and the last one may be exactly 0. Example:

    >>> prior = CogVideoXPrior.load("THUDM/CogVideoX-2b", "cuda", frames=9)     # doctest: +SKIP
    """

    family = Family(
        "CogVideoX",
        {"transformer": "CogVideoXTransformer3DModel", "vae": "AutoencoderKLCogVideoX"},
        channels="latent_channels",
        prediction="v_prediction",
        example="THUDM/CogVideoX-2b",
    )
    _tiny: TinyEncoder | None = None

    def __init__(self, folder: Path, transformer: Any, vae: Any, schedule: Any, frames: int | None = None) -> None:
        super().__init__(folder, transformer, vae, schedule, frames)
        self._rotary: dict[tuple[int, int, int], Any] = {}

    def through(self, tiny: TinyEncoder) -> VideoPrior:
        """The same prior with a tiny encoder in place of its VAE's in `encode`, for a cheaper and less exact gradient.

        Raises:
            PriorError: this prior's latents are of another shape.
        """
        found = (int(self.vae.config.latent_channels), self._sizes.pixels_per_latent, self._sizes.frames_per_latent)
        if found != (LATENT_CHANNELS, SPACE, TIME):
            raise PriorError(
                f"the tiny VAE is made for priors with {LATENT_CHANNELS} latent channels, {SPACE} pixels and {TIME} frames "
                f"per latent, as CogVideoX has, but {self.name} has {found[0]}, {found[1]} and {found[2]}"
            )
        other = copy.copy(self)
        other._tiny = tiny
        return other

    def encode(self, clip: Float[Tensor, "t 3 h w"]) -> Float[Tensor, "1 lt c lh lw"]:
        if self._tiny is None:
            return super().encode(clip)
        self._check_clip(clip)
        return self._tiny.encode(clip)

    @torch.no_grad()
    def predict_v(
        self,
        noisy: Float[Tensor, "#b lt c lh lw"],
        timestep: int,
        text_embeddings: Float[Tensor, "b l d"],
    ) -> Float[Tensor, "b lt c lh lw"]:
        batch = text_embeddings.shape[0]
        # Where noise came first in float32, rounding to the model's dtype costs nothing the model was not trained with.
        noisy = noisy.to(self.device, self.dtype).expand(batch, -1, -1, -1, -1)
        group = self.transformer.config.patch_size_t or 1
        pad = -noisy.shape[1] % group
        if pad:  # CogVideoX 1.5: whole groups of latent frames; the pipeline too puts the extra ones in front and drops them
            noisy = torch.cat([noisy[:, :1].expand(-1, pad, -1, -1, -1), noisy], dim=1)
        self._fit_positions(noisy.shape)
        v = self.transformer(
            hidden_states=noisy,
            encoder_hidden_states=text_embeddings.to(self.device, self.dtype),
            timestep=torch.full((batch,), timestep, device=self.device, dtype=torch.long),
            image_rotary_emb=self._rotary_embedding(noisy.shape),
            return_dict=False,
        )[0]
        return v[:, pad:].float()

    @staticmethod
    def _half_dtype(folder: Path) -> torch.dtype:
        return HALF.get(stored_dtype(folder / "transformer"), torch.float32)

    @staticmethod
    def _read(folder: Path, dtype: torch.dtype) -> tuple[Any, Any, Any]:
        from diffusers.models.autoencoders.autoencoder_kl_cogvideox import AutoencoderKLCogVideoX
        from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel
        from diffusers.schedulers.scheduling_ddim_cogvideox import CogVideoXDDIMScheduler
        from diffusers.utils.import_utils import is_accelerate_available

        how = {"torch_dtype": dtype, "low_cpu_mem_usage": is_accelerate_available(), "local_files_only": True}
        transformer = CogVideoXTransformer3DModel.from_pretrained(folder / "transformer", **how)
        vae = AutoencoderKLCogVideoX.from_pretrained(folder / "vae", **how)
        return transformer, vae, CogVideoXDDIMScheduler.from_pretrained(folder / "scheduler", local_files_only=True)

    @staticmethod
    def _recompute(vae: Any) -> None:
        recompute_resnets(vae)

    @staticmethod
    def _alphas_cumprod(schedule: Any) -> Float[Tensor, " steps"]:
        return schedule.alphas_cumprod.double().cpu()

    def _read_sizes(self) -> Sizes:
        config, space = self.transformer.config, 2 ** (len(self.vae.config.block_out_channels) - 1)
        return Sizes(
            pixels_per_latent=space,
            frames_per_latent=int(self.vae.config.temporal_compression_ratio),
            patch=(config.patch_size, config.patch_size),
            clip_shape=(int(config.sample_frames), config.sample_height * space, config.sample_width * space),
            text_length=config.max_text_seq_length,
        )

    def _scaled(self, hidden: Float[Tensor, "1 c lt lh lw"]) -> Float[Tensor, "1 lt c lh lw"]:
        return hidden.float().transpose(1, 2) * self.vae.config.scaling_factor

    def _unscaled(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "1 c lt lh lw"]:
        return (latents.transpose(1, 2) / self.vae.config.scaling_factor).to(self.device, self.vae.dtype)

    def _fit_positions(self, shape: Sequence[int]) -> None:
        """Make the sin-cos table for this latent shape once; diffusers rebuilds it in every call for all shapes but one."""
        embed = self.transformer.patch_embed
        if not embed.use_positional_embeddings or embed.use_learned_positional_embeddings:
            return
        _, latent_frames, _, height, width = shape
        frames = (latent_frames - 1) * embed.temporal_compression_ratio + 1
        if (embed.sample_frames, embed.sample_height, embed.sample_width) != (frames, height, width):
            embed.pos_embedding = embed._get_positional_embeddings(height, width, frames).to(self.device, self.dtype)
            embed.sample_frames, embed.sample_height, embed.sample_width = frames, height, width

    def _rotary_embedding(self, shape: Sequence[int]) -> Any:
        """Rotary positions of the larger models, as diffusers' pipeline makes them; None where positions are added instead."""
        if not self.transformer.config.use_rotary_positional_embeddings:
            return None
        _, frames, _, height, width = shape
        if (frames, height, width) not in self._rotary:
            from diffusers.pipelines.cogvideo.pipeline_cogvideox import CogVideoXPipeline

            pipeline = CogVideoXPipeline(None, None, self.vae, self.transformer, None)  # type: ignore[arg-type]
            space = self._sizes.pixels_per_latent
            self._rotary[frames, height, width] = pipeline._prepare_rotary_positional_embeddings(
                height * space, width * space, frames, self.device
            )
        return self._rotary[frames, height, width]


def recompute_resnets(vae: Any) -> None:
    """Let a VAE's encoder keep only the input of each resnet for the backward pass, and make the rest again.

    diffusers' own switch also does this to whole stages, so that the first resnets are computed three times. Counted for
    CogVideoX-2B with 9 frames of 720x480 that lowers no peak: 13 GB either way (28 without), 104 against 132 TFLOP a step.
    """
    vae.enable_gradient_checkpointing()
    vae.encoder.gradient_checkpointing = False
