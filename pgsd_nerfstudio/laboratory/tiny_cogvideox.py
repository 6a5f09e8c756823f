"""CogVideoX of a few thousand random parameters, made by diffusers: for checks that need no trained weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

WORDS = ("<pad>", "</s>", "<unk>", "snow", "is", "falling", "in", "a", "garden", "no")
"""All words that the tokenizer knows."""
VARIANTS: dict[str, dict[str, Any]] = {
    "2b": {"patch_size_t": None, "use_rotary_positional_embeddings": False},
    "5b": {"patch_size_t": None, "use_rotary_positional_embeddings": True},
    "1.5": {"patch_size_t": 2, "use_rotary_positional_embeddings": True},
}
"""What tells the transformers of CogVideoX-2B, CogVideoX-5B and CogVideoX 1.5 apart, but for their size."""


def scheduler_2b() -> Any:
    """The noise schedule as CogVideoX-2B configures it."""
    from diffusers.schedulers.scheduling_ddim_cogvideox import CogVideoXDDIMScheduler

    return CogVideoXDDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        snr_shift_scale=3.0,
        timestep_spacing="trailing",
    )


def tiny_models(variant: str = "2b", seed: int = 0, latent_channels: int = 4) -> tuple[Any, Any]:
    """Transformer and VAE with random weights, ready for inference; the global random generator stays as it was.

    Args:
        variant: a key of `VARIANTS`.
        seed: of the weights.
        latent_channels: of both.

    Returns:
        Models for clips of 9 frames of 32x48 pixels and texts of 12 tokens of 16 numbers.
    """
    from diffusers.models.autoencoders.autoencoder_kl_cogvideox import AutoencoderKLCogVideoX
    from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transformer = CogVideoXTransformer3DModel(
            num_attention_heads=2,
            attention_head_dim=16,
            in_channels=latent_channels,
            out_channels=latent_channels,
            time_embed_dim=8,
            text_embed_dim=16,
            num_layers=2,
            sample_height=4,
            sample_width=6,
            sample_frames=9,
            max_text_seq_length=12,
            **VARIANTS[variant],
        )
        vae = AutoencoderKLCogVideoX(
            block_out_channels=(8, 8, 8, 8),  # type: ignore[arg-type]
            latent_channels=latent_channels,
            layers_per_block=1,
            norm_num_groups=2,
            sample_height=32,
            sample_width=48,
        )
    for model in (transformer, vae):
        torch.nn.Module.eval(model).requires_grad_(False)
    return transformer, vae


def tiny_pipeline(variant: str = "2b", seed: int = 0, latent_channels: int = 4) -> Any:
    """diffusers' own pipeline around `tiny_models`, with a random T5 and a tokenizer of ten words."""
    from diffusers.pipelines.cogvideo.pipeline_cogvideox import CogVideoXPipeline
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, T5Config, T5EncoderModel

    transformer, vae = tiny_models(variant, seed, latent_channels)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = T5Config(vocab_size=32, d_model=16, d_kv=8, d_ff=32, num_layers=1, num_heads=2)
        text_encoder = T5EncoderModel(sizes).eval()
    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", eos_token="</s>", unk_token="<unk>")
    pipeline = CogVideoXPipeline(tokenizer, text_encoder, vae, transformer, scheduler_2b())  # type: ignore[arg-type]
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def write_tiny(folder: Path, variant: str = "2b", seed: int = 0, latent_channels: int = 4) -> Path:
    """Write `tiny_pipeline` as diffusers does; returns the folder."""
    tiny_pipeline(variant, seed, latent_channels).save_pretrained(folder)
    return folder
