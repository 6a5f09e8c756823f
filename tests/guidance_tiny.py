"""Random CogVideoX models of a few thousand parameters, written as diffusers writes them."""

from pathlib import Path

import torch

from pgsd_nerfstudio.guidance.memory import MemoryMeter

WORDS = ["<pad>", "</s>", "<unk>", "snow", "is", "falling", "in", "a", "garden", "no"]
VARIANTS = {
    "2b": {"patch_size_t": None, "use_rotary_positional_embeddings": False},
    "5b": {"patch_size_t": None, "use_rotary_positional_embeddings": True},
    "1.5": {"patch_size_t": 2, "use_rotary_positional_embeddings": True},
}


def scheduler_2b():
    """The noise schedule as CogVideoX-2B configures it."""
    from diffusers import CogVideoXDDIMScheduler

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


def tiny_pipeline(variant: str = "2b", seed: int = 0):
    """diffusers' own pipeline around random weights; clips of 9 frames of 32x48."""
    from diffusers import AutoencoderKLCogVideoX, CogVideoXPipeline, CogVideoXTransformer3DModel
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, T5Config, T5EncoderModel

    torch.manual_seed(seed)
    transformer = CogVideoXTransformer3DModel(
        num_attention_heads=2,
        attention_head_dim=16,
        in_channels=4,
        out_channels=4,
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
        block_out_channels=(8, 8, 8, 8),
        latent_channels=4,
        layers_per_block=1,
        norm_num_groups=2,
        sample_height=32,
        sample_width=48,
    )
    text_encoder = T5EncoderModel(T5Config(vocab_size=32, d_model=16, d_kv=8, d_ff=32, num_layers=1, num_heads=2))
    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", eos_token="</s>", unk_token="<unk>")
    pipeline = CogVideoXPipeline(tokenizer, text_encoder.eval(), vae.eval(), transformer.eval(), scheduler_2b())
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def write_tiny(folder: Path, variant: str = "2b", seed: int = 0) -> Path:
    tiny_pipeline(variant, seed).save_pretrained(folder)
    return folder


def there_and_back(prior, clip: torch.Tensor) -> tuple[torch.Tensor, int]:
    """The gradient on a clip through the prior's encoder, and the bytes that were kept for it."""
    pixels = clip.clone().requires_grad_()
    with MemoryMeter() as meter:
        latents = prior.encode(pixels)
    kept = meter.live
    return torch.autograd.grad(latents.square().sum(), pixels)[0], kept
