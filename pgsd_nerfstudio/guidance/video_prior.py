"""What a video prior promises, whatever its family: a frozen text-to-video model as a function on clips.

The families are CogVideoX (`cogvideox`) and Wan (`wan`); `load_prior` opens a model of either. Only diffusers' own models
compute. A prior knows nothing of Gaussians.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.folder import Family, PriorError, find_prior
from pgsd_nerfstudio.guidance.text import PromptEncoder
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder

Kind = TypeVar("Kind", bound="VideoPrior")
SMALL = 200_000_000  # parameters; below this half precision saves nothing that matters


class Sizes(NamedTuple):
    """Sizes of a model, which every family writes down in another place."""

    pixels_per_latent: int
    """Along an edge."""
    frames_per_latent: int
    """All but the first frame of a clip, which has a latent frame of its own."""
    patch: tuple[int, int]
    """Height and width, in latents, of what the transformer takes as one token."""
    clip_shape: tuple[int, int, int]
    """Frames, height and width of the clips that the model was made for."""
    text_length: int
    """Tokens per text."""


class VideoPrior(ABC):
    """A frozen video diffusion model. Example:

    >>> prior = load_prior("bundled", "cpu")                               # doctest: +SKIP
    >>> text = prior.encode_prompt(["snow is falling in a courtyard"])     # doctest: +SKIP
    >>> latents = prior.encode(clip)                                       # doctest: +SKIP
    >>> v = prior.predict_v(latents, 500, text)                            # doctest: +SKIP
    """

    family: ClassVar[Family]
    """What tells a folder of this family from others."""
    prompt_encoder: ClassVar[type[PromptEncoder]] = PromptEncoder
    """Class of `text_encoder`."""

    name: str
    """The folder that the model was loaded from, as printed."""
    clip_shape: tuple[int, int, int]
    """Frames, height and width of the clips that the model was made for (frames as asked for in `load`)."""
    alphas_cumprod: Float[Tensor, " steps"]
    """alpha_bar of every timestep, float64, on the CPU."""

    def __init__(self, folder: Path, transformer: Any, vae: Any, schedule: Any, frames: int | None = None) -> None:
        """Build a prior from parts that diffusers made; `load` is the usual way.

        Args:
            folder: where the text encoder and its tokenizer lie.
            transformer: the denoiser; its device and dtype become the prior's.
            vae: the video autoencoder.
            schedule: the noise schedule, as the family's class says.
            frames: clip length; None means the model's own.

        Raises:
            ValueError: clips of this model cannot have so many frames.
        """
        self.name = str(folder)
        self.transformer, self.vae = transformer, vae
        self.device, self.dtype = transformer.device, transformer.dtype
        self.alphas_cumprod = self._alphas_cumprod(schedule)
        self._sizes = self._read_sizes()
        own, height, width = self._sizes.clip_shape
        self.clip_shape = (frames or own, height, width)
        self._check_frames(self.clip_shape[0])
        self.text_encoder = self.prompt_encoder(folder, self._sizes.text_length, self.device, self.dtype)

    @classmethod
    def load(
        cls: type[Kind],
        place: str | Path,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | None = None,
        *,
        frames: int | None = None,
        checkpointing: bool | None = None,
    ) -> Kind:
        """Load a model of this family for inference, as `load_prior` does for any family; no weight ever gets a gradient.

        Args:
            place: "bundled", a diffusers folder of this family, or a hub id such as "THUDM/CogVideoX-2b".
            device: where the model computes.
            dtype: number format of the transformer; None means float32 on a CPU and for small models, else half precision (Wan:
                bfloat16; CogVideoX: as its weights are stored, float16 for the 2B, bfloat16 for the 5B). CogVideoX' VAE has the
                same format, Wan's never computes in less than float32, as its authors advise.
            frames: clip length, 4k + 1; None means the model's own (CogVideoX-2B: 49, Wan: 81; the paper distils clips of 9).
            checkpointing: recompute the VAE encoder's activations in the backward pass instead of keeping them, see
                `cogvideox.recompute_resnets` and `wan_parts.recompute_blocks`; None means on CUDA.

        Raises:
            PriorError: nothing usable is there; see `find`.
            ValueError: clips of this model cannot have so many frames.
        """
        folder, device = cls.find(place), _existing(device)
        try:
            half = cls._half_dtype(folder)
            usual = torch.float32 if device.type == "cpu" else half
            transformer, vae, schedule = cls._read(folder, dtype or usual)
        except Exception as error:
            raise PriorError(f"the video prior in {folder} could not be loaded: {error}") from error
        if dtype is None and sum(p.numel() for p in transformer.parameters()) < SMALL:
            transformer, vae = transformer.float(), vae.float()
        for model in (transformer, vae):
            torch.nn.Module.to(model, device).eval().requires_grad_(False)
        if checkpointing or (checkpointing is None and device.type == "cuda"):
            cls._recompute(vae)
        return cls(folder, transformer, vae, schedule, frames)

    @classmethod
    def find(cls, place: str | Path) -> Path:
        """The folder of a model of this family, judged before any weight is read.

        Raises:
            PriorError: there is no such folder or model, or it is not a complete text-to-video model of this family.
        """
        return find_prior(place, cls.family)

    def encode_prompt(self, texts: Sequence[str]) -> Float[Tensor, "n l d"]:
        """Text embeddings, one per text; cached on disk, the text encoder is loaded only when a text is new."""
        return self.text_encoder(texts)

    @abstractmethod
    def through(self, tiny: TinyEncoder) -> VideoPrior:
        """The same prior with a tiny encoder in place of its VAE's in `encode`, for a cheaper and less exact gradient.

        Raises:
            PriorError: this prior has other latents.
        """

    def encode(self, clip: Float[Tensor, "t 3 h w"]) -> Float[Tensor, "1 lt c lh lw"]:
        """Scaled latents (float32) of a clip in 0..1, differentiable.

        They are the mean of the VAE's posterior, so that the same clip always has the same latents.

        Raises:
            ValueError: the clip's shape does not suit the VAE or the transformer's patches.
        """
        self._check_clip(clip)
        video = (2 * clip - 1).to(self.device, self.vae.dtype).transpose(0, 1)[None]
        return self._scaled(self.vae.encode(video).latent_dist.mode())

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "t 3 h w"]:
        """The clip in 0..1 that scaled latents stand for; to look at, without gradient."""
        return (self.vae.decode(self._unscaled(latents)).sample[0].transpose(0, 1).float() / 2 + 0.5).clamp(0, 1)

    @abstractmethod
    def predict_v(
        self,
        noisy: Float[Tensor, "#b lt c lh lw"],
        timestep: int,
        text_embeddings: Float[Tensor, "b l d"],
    ) -> Float[Tensor, "b lt c lh lw"]:
        """v = sqrt(alpha_bar) eps - sqrt(1 - alpha_bar) x0 as the model predicts it, in float32; no gradient passes through.

        Args:
            noisy: scaled latents with noise, variance preserving, with the alpha_bar of `alphas_cumprod[timestep]`. Latents of
                batch 1 are used for all texts, in one evaluation of the transformer.
            timestep: noise level, 0 .. steps - 1.
            text_embeddings: what `encode_prompt` gives.
        """

    @staticmethod
    @abstractmethod
    def _half_dtype(folder: Path) -> torch.dtype:
        """Number format of the transformer of a large model on CUDA."""

    @staticmethod
    @abstractmethod
    def _read(folder: Path, dtype: torch.dtype) -> tuple[Any, Any, Any]:
        """Transformer, VAE and noise schedule, the weights in this number format."""

    @staticmethod
    @abstractmethod
    def _recompute(vae: Any) -> None:
        """Let the VAE's encoder make activations again in the backward pass."""

    @staticmethod
    @abstractmethod
    def _alphas_cumprod(schedule: Any) -> Float[Tensor, " steps"]: ...

    @abstractmethod
    def _read_sizes(self) -> Sizes: ...

    @abstractmethod
    def _scaled(self, hidden: Float[Tensor, "1 c lt lh lw"]) -> Float[Tensor, "1 lt c lh lw"]:
        """Scaled latents (float32) of what the VAE gives."""

    @abstractmethod
    def _unscaled(self, latents: Float[Tensor, "1 lt c lh lw"]) -> Float[Tensor, "1 c lt lh lw"]:
        """What the VAE takes for scaled latents, on its device and in its dtype."""

    def _check_clip(self, clip: Float[Tensor, "t 3 h w"]) -> None:
        if clip.ndim != 4 or clip.shape[1] != 3:
            raise ValueError(f"a clip must have the shape [frames, 3, height, width], found {list(clip.shape)}")
        frames, _, height, width = clip.shape
        self._check_frames(frames)
        rows, columns = (self._sizes.pixels_per_latent * patch for patch in self._sizes.patch)
        if height % rows or width % columns:
            steps = f"{rows}" if rows == columns else f"{rows} and {columns}"
            raise ValueError(f"height and width of a clip must be multiples of {steps} for this prior, found {height}x{width}")

    def _check_frames(self, frames: int) -> None:
        step = self._sizes.frames_per_latent
        if frames < 1 or (frames - 1) % step:
            below = max(0, frames - 1) // step * step + 1
            raise ValueError(
                f"clips of this video prior have {step}k + 1 frames, found {frames}; use {below} or {below + step}"
            )


def _existing(device: str | torch.device) -> torch.device:
    device = torch.device(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise PriorError("the video prior was asked onto CUDA, but no CUDA device was found; use the device cpu")
    return device
