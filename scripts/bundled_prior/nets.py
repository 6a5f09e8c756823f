"""The untrained parts of the bundled prior: a CogVideoX in the shapes of diffusers, small enough for two cores.

9 frames of 96x64 become latents of 3x16x24 with 16 channels; 288 patches and 40 words go through the transformer.
"""

from __future__ import annotations

from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors
from torch import nn
from transformers import PreTrainedTokenizerFast, T5Config, T5EncoderModel

WORDS = 40
"""Length of every caption in tokens; longer ones are cut, shorter ones padded."""
CHANNELS = 16
TEXT = 64


def make_vae() -> AutoencoderKLCogVideoX:
    """1.9 M parameters; two blocks halve space and time, the third works at 24x16."""
    return AutoencoderKLCogVideoX(
        down_block_types=("CogVideoXDownBlock3D",) * 3,
        up_block_types=("CogVideoXUpBlock3D",) * 3,
        block_out_channels=(16, 32, 64),
        layers_per_block=1,
        norm_num_groups=8,
        latent_channels=CHANNELS,
        temporal_compression_ratio=4,
        sample_height=64,
        sample_width=96,
        scaling_factor=1.0,
    )


def make_transformer(width: int = 160, layers: int = 5) -> CogVideoXTransformer3DModel:
    """Its last layer and the gates of its blocks start at zero, so that training begins from the identity."""
    transformer = CogVideoXTransformer3DModel(
        num_attention_heads=width // 32,
        attention_head_dim=32,
        in_channels=CHANNELS,
        out_channels=CHANNELS,
        time_embed_dim=128,
        text_embed_dim=TEXT,
        num_layers=layers,
        sample_width=24,
        sample_height=16,
        sample_frames=9,
        patch_size=2,
        temporal_compression_ratio=4,
        max_text_seq_length=WORDS,
        spatial_interpolation_scale=1.0,
        temporal_interpolation_scale=1.0,
    )
    nn.init.zeros_(transformer.proj_out.weight)
    nn.init.zeros_(transformer.proj_out.bias)
    for block in transformer.transformer_blocks:
        for norm in (block.norm1, block.norm2):
            nn.init.normal_(norm.linear.weight, std=0.01)
            gates = norm.linear.bias.data.view(6, -1)  # shift, scale, gate for the video, then for the text
            gates.zero_()
            gates[2], gates[5] = 0.3, 0.3
    return transformer


def make_text_encoder(vocabulary: int) -> T5EncoderModel:
    config = T5Config(
        vocab_size=vocabulary,
        d_model=TEXT,
        d_kv=16,
        d_ff=2 * TEXT,
        num_layers=2,
        num_heads=4,
        dropout_rate=0.0,
        pad_token_id=0,
        eos_token_id=1,
    )
    return T5EncoderModel(config)


def make_tokenizer(words: list[str]) -> PreTrainedTokenizerFast:
    """One token per word; case and punctuation are dropped, words that no caption holds become <unk>."""
    specials = ["<pad>", "</s>", "<unk>"]
    tokenizer = Tokenizer(models.WordLevel({w: i for i, w in enumerate(specials + words)}, unk_token="<unk>"))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Lowercase(), normalizers.Replace(Regex(r"[^\w\s]"), " ")])
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>", unk_token="<unk>", model_max_length=WORDS
    )


def make_scheduler() -> CogVideoXDDIMScheduler:
    """As CogVideoX-2B's, but without its shift toward noise, which large frames need and 96x64 do not."""
    return CogVideoXDDIMScheduler(
        beta_schedule="scaled_linear",
        beta_start=0.00085,
        beta_end=0.012,
        prediction_type="v_prediction",
        rescale_betas_zero_snr=True,
        snr_shift_scale=1.0,
        timestep_spacing="trailing",
        clip_sample=False,
        set_alpha_to_one=True,
    )
