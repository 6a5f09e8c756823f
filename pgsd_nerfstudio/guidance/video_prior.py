"""The video prior: any CogVideoX text-to-video model as a function on clips. It knows nothing of Gaussians.

Yang et al., "CogVideoX" (2024). The bundled small model and CogVideoX-2B have the same parts (causal 3D VAE, expert
transformer, T5, DDIM scheduler with v-prediction), so one class serves both; only diffusers' own components compute.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.folder import PriorError, find_prior, stored_dtype
from pgsd_nerfstudio.guidance.text import PromptEncoder
from pgsd_nerfstudio.guidance.tiny_vae import LATENT_CHANNELS, SPACE, TIME, TinyEncoder

HALF = {"F16": torch.float16, "BF16": torch.bfloat16}
SMALL = 200_000_000  # parameters; below this half precision saves nothing that matters


class VideoPrior:
    """A frozen video diffusion model. Example:

    >>> prior = VideoPrior.load("bundled", "cpu")                          # doctest: +SKIP
    >>> text = prior.encode_prompt(["snow is falling in a courtyard"])     # doctest: +SKIP
    >>> latents = prior.encode(clip)                                       # doctest: +SKIP
    >>> v = prior.predict_v(latents, 500, text)                            # doctest: +SKIP
    """

    name: str
    """Where it was loaded from, as printed."""
    clip_shape: tuple[int, int, int]
    """Frames, height and width of the clips it was made for (frames as asked for in `load`)."""
    alphas_cumprod: Float[Tensor, " steps"]
    """alpha_bar after SNR shift and zero-terminal rescaling, float64, on the CPU; the last one may be exactly 0."""

    def __init__(self, folder: Path, transformer: Any, vae: Any, scheduler: Any, frames: int | None = None) -> None:
        """From diffusers components; `load` is the usual way."""
        self.name = str(folder)
        self.transformer, self.vae = transformer, vae
        self.device, self.dtype = transformer.device, transformer.dtype
        self.alphas_cumprod = scheduler.alphas_cumprod.double().cpu()
        self._space = 2 ** (len(vae.config.block_out_channels) - 1)
        self._time = int(vae.config.temporal_compression_ratio)
        self._rotary: dict[tuple[int, int, int], Any] = {}
        self._tiny: TinyEncoder | None = None
        config = transformer.config
        native = int(config.sample_frames)
        self.clip_shape = (frames or native, config.sample_height * self._space, config.sample_width * self._space)
        self._check_frames(self.clip_shape[0])
        self.text_encoder = PromptEncoder(folder, config.max_text_seq_length, self.device, self.dtype)

    @staticmethod
    def load(
        place: str | Path,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | None = None,
        *,
        frames: int | None = None,
        checkpointing: bool | None = None,
    ) -> VideoPrior:
        """Load a prior for inference; no weight ever gets a gradient.

        Args:
            place: "bundled", a diffusers CogVideoX folder, or a hub id such as "THUDM/CogVideoX-2b".
            device: where it computes.
            dtype: number format; None means float32 on a CPU and for small models, on CUDA the format its weights are stored in
                (float16 for the 2B, bfloat16 for the 5B).
            frames: clip length, 4k + 1; None means the model's own (CogVideoX-2B: 49; the paper distils clips of 9).
            checkpointing: recompute the VAE encoder's activations in the backward pass instead of keeping them, see
                `recompute_resnets`; None means on CUDA.

        Raises:
            PriorError: nothing usable is there; see `find_prior`.
        """
        from diffusers.models.autoencoders.autoencoder_kl_cogvideox import AutoencoderKLCogVideoX
        from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel
        from diffusers.schedulers.scheduling_ddim_cogvideox import CogVideoXDDIMScheduler
        from diffusers.utils.import_utils import is_accelerate_available

        folder, device = find_prior(place), usable(device)
        how = {"low_cpu_mem_usage": is_accelerate_available(), "local_files_only": True}
        try:
            stored = HALF.get(stored_dtype(folder / "transformer"), torch.float32)
            weights = {"torch_dtype": dtype or (torch.float32 if device.type == "cpu" else stored), **how}
            transformer = CogVideoXTransformer3DModel.from_pretrained(folder / "transformer", **weights)
            vae = AutoencoderKLCogVideoX.from_pretrained(folder / "vae", **weights)
            scheduler = CogVideoXDDIMScheduler.from_pretrained(folder / "scheduler", local_files_only=True)
        except Exception as error:
            raise PriorError(f"the video prior in {folder} could not be loaded: {error}") from error
        if dtype is None and sum(p.numel() for p in transformer.parameters()) < SMALL:
            transformer, vae = transformer.float(), vae.float()
        freeze(device, transformer, vae)
        if checkpointing or (checkpointing is None and device.type == "cuda"):
            recompute_resnets(vae)
        return VideoPrior(folder, transformer, vae, scheduler, frames)

    def encode_prompt(self, texts: Sequence[str]) -> Float[Tensor, "n l d"]:
        """Text embeddings, one per text; cached on disk, the text encoder is loaded only when a text is new."""
        return self.text_encoder(texts)

    def through(self, tiny: TinyEncoder) -> VideoPrior:
        """The same prior with a small encoder in place of its VAE's in `encode`, for a cheaper and less exact gradient.

        Raises:
            PriorError: this prior's latents are of another shape.
        """
        found = (int(self.vae.config.latent_channels), self._space, self._time)
        if found != (LATENT_CHANNELS, SPACE, TIME):
            raise PriorError(
                f"the tiny VAE is made for priors with {LATENT_CHANNELS} latent channels, {SPACE} pixels and {TIME} frames "
                f"per latent, as CogVideoX has, but {self.name} has {found[0]}, {found[1]} and {found[2]}"
            )
        other = copy.copy(self)
        other._tiny = tiny
        return other

    def encode(self, clip: Float[Tensor, "t 3 h w"]) -> Float[Tensor, "1 lt c lh lw"]:
        """Scaled latents (float32) of a clip in 0..1, differentiable.

        They are the mean of the VAE's posterior, so that the same clip always has the same latents.

        Raises:
            ValueError: the clip's shape does not suit the VAE.
        """
        height, width = self._size(clip)
        step = self._space * self.transformer.config.patch_size
        if height % step or width % step:
            raise ValueError(f"height and width of a clip must be multiples of {step} for this prior, found {height}x{width}")
        if self._tiny is not None:
            return self._tiny.encode(clip)
        video = (2 * clip - 1).to(self.device, self.dtype).transpose(0, 1)[None]
        return self.vae.encode(video).latent_dist.mode().float().transpose(1, 2) * self.vae.config.scaling_factor

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "t 3 h w"]:
        """The clip in 0..1 that latents stand for; to look at, without gradient."""
        hidden = latents.transpose(1, 2) / self.vae.config.scaling_factor
        return (self.vae.decode(hidden.to(self.device, self.dtype)).sample[0].transpose(0, 1).float() / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def predict_v(
        self,
        noisy: Float[Tensor, "1|b lt c lh lw"],
        timestep: int,
        text_embeddings: Float[Tensor, "b l d"],
    ) -> Float[Tensor, "b lt c lh lw"]:
        """v = sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) x0 as the model predicts it, in float32; no gradient passes through.

        Latents of batch 1 are used for all texts, in one evaluation of the transformer.
        """
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

    def _size(self, clip: Float[Tensor, "t 3 h w"]) -> tuple[int, int]:
        """Height and width of a clip whose shape and number of frames suit the VAE."""
        if clip.ndim != 4 or clip.shape[1] != 3:
            raise ValueError(f"a clip must have the shape [frames, 3, height, width], found {list(clip.shape)}")
        self._check_frames(clip.shape[0])
        return clip.shape[2], clip.shape[3]

    def _check_frames(self, frames: int) -> None:
        if frames < 1 or (frames - 1) % self._time:
            below = max(0, frames - 1) // self._time * self._time + 1
            raise ValueError(
                f"clips of this video prior have {self._time}k + 1 frames, found {frames}; use {below} or {below + self._time}"
            )

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
            self._rotary[frames, height, width] = pipeline._prepare_rotary_positional_embeddings(
                height * self._space, width * self._space, frames, self.device
            )
        return self._rotary[frames, height, width]


def usable(device: str | torch.device) -> torch.device:
    """The device, if there is one.

    Raises:
        PriorError: it is CUDA, and there is none.
    """
    device = torch.device(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise PriorError("the video prior was asked onto CUDA, but no CUDA device was found; use the device cpu")
    return device


def freeze(device: torch.device, *models: torch.nn.Module) -> None:
    """Put models on a device for inference; no weight gets a gradient."""
    for model in models:
        torch.nn.Module.to(model, device).eval().requires_grad_(False)


def recompute_resnets(vae: Any) -> None:
    """Let a VAE's encoder keep only the input of each resnet for the backward pass, and make the rest again.

    diffusers' own switch also does this to whole stages, so that the first resnets are computed three times. Counted for
    CogVideoX-2B with 9 frames of 720x480 that lowers no peak: 13 GB either way (28 without), 104 against 132 TFLOP a step.
    """
    vae.enable_gradient_checkpointing()
    vae.encoder.gradient_checkpointing = False
