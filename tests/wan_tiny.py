"""Random Wan models of a few thousand parameters, written as diffusers writes them."""

import torch

from pgsd_nerfstudio.laboratory.tiny_cogvideox import WORDS


def tiny_wan(seed: int = 0, flow_shift: float = 3.0):
    """diffusers' own pipeline around random weights, with the scheduler as Wan 2.1 has it; clips of 9 frames of 32x48."""
    from diffusers import AutoencoderKLWan, UniPCMultistepScheduler, WanPipeline, WanTransformer3DModel
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast, UMT5Config, UMT5EncoderModel

    torch.manual_seed(seed)
    transformer = WanTransformer3DModel(
        patch_size=(1, 2, 2),
        num_attention_heads=2,
        attention_head_dim=12,
        in_channels=4,
        out_channels=4,
        text_dim=16,
        freq_dim=16,
        ffn_dim=32,
        num_layers=2,
        rope_max_seq_len=32,
    )
    vae = AutoencoderKLWan(
        base_dim=4,
        z_dim=4,
        dim_mult=[1, 2, 2, 2],
        num_res_blocks=1,
        temperal_downsample=[False, True, True],
        latents_mean=[-0.7, 0.3, 1.5, 0.0],
        latents_std=[2.8, 1.4, 0.5, 1.0],
    )
    sizes = UMT5Config(vocab_size=32, d_model=16, d_kv=8, d_ff=32, num_layers=2, num_heads=2)
    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.post_processor = processors.TemplateProcessing("$A </s>", special_tokens=[("</s>", WORDS.index("</s>"))])
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", eos_token="</s>", unk_token="<unk>")
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=flow_shift)
    encoder = UMT5EncoderModel(sizes).eval()
    pipeline = WanPipeline(tokenizer, encoder, vae.eval(), scheduler, transformer.eval())  # type: ignore[arg-type]
    pipeline.set_progress_bar_config(disable=True)
    return pipeline
