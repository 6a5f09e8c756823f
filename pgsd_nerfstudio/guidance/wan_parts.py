"""The parts of a Wan model as diffusers writes them: the transformer's weights, the VAE's memory, the texts."""

from __future__ import annotations

import html
import importlib
import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pgsd_nerfstudio.guidance.folder import PriorError
from pgsd_nerfstudio.guidance.text import PromptEncoder


def read_transformer(folder: Path, dtype: torch.dtype) -> Any:
    """The transformer in `dtype`, but for the parts that diffusers keeps in float32.

    diffusers' own loader does this through the library accelerate only, which nothing else here needs.

    Raises:
        PriorError: weights are missing or unknown.
        RuntimeError, OSError, SafetensorError: weights are damaged or of another size.
    """
    from diffusers.models.transformers.transformer_wan import WanRotaryPosEmbed, WanTransformer3DModel
    from safetensors.torch import load_file

    config: Any = WanTransformer3DModel.load_config(folder, local_files_only=True)
    with torch.device("meta"):
        model: Any = WanTransformer3DModel.from_config(config)
    wide, kept = torch.promote_types(dtype, torch.float32), {*WanTransformer3DModel._keep_in_fp32_modules}
    stored = {}
    for file in sorted(folder.glob("*.safetensors")):
        for name, weight in load_file(file).items():
            stored[name] = weight.to(dtype if kept.isdisjoint(name.split(".")) else wide)
    missing, unknown = model.load_state_dict(stored, strict=False, assign=True)
    if missing or unknown:
        raise PriorError(
            f"{folder} must hold the {len(model.state_dict())} weights of its configuration, found {len(missing)} missing and "
            f"{len(unknown)} unknown, first {[*missing, *unknown][0]}; download the model again"
        )
    # A table that is made, not stored: on the meta device it is empty.
    sizes = model.config
    model.rope = WanRotaryPosEmbed(sizes.attention_head_dim, sizes.patch_size, sizes.rope_max_seq_len)
    return model


def recompute_blocks(vae: Any) -> None:
    """Let a Wan VAE's encoder keep only what goes into each residual block for the backward pass, and make the rest again.

    diffusers' AutoencoderKLWan has no switch for it, since a block also reads and writes the cache that joins its chunks of
    frames. Here a block's two entries of that cache go in and come out like its other values.
    """
    from diffusers.models.autoencoders.autoencoder_kl_wan import WanResidualBlock

    for block in vae.encoder.modules():
        if isinstance(block, WanResidualBlock):
            block.forward = _recomputed(block.forward)


def _recomputed(forward: Any) -> Any:
    def pure(x: Tensor, *before: Tensor | None) -> tuple[Any, ...]:
        cache = [*before]
        return forward(x, cache, [0]), *cache

    def thrifty(x: Tensor, feat_cache: list[Tensor | None], feat_idx: list[int]) -> Tensor:
        mine = slice(feat_idx[0], feat_idx[0] + 2)
        made, *feat_cache[mine] = checkpoint(pure, x, *feat_cache[mine], use_reentrant=False, preserve_rng_state=False)
        feat_idx[0] += 2
        return made

    return thrifty


class WanPromptEncoder(PromptEncoder):
    """Embeddings by UMT5 as diffusers' pipeline makes them: texts are cleaned, padding is neither attended to nor passed on."""

    encoder_class = "UMT5EncoderModel"

    def __call__(self, texts: Sequence[str]) -> Float[Tensor, "n l d"]:
        return super().__call__(texts if isinstance(texts, str) else [cleaned(text) for text in texts])

    def _embedding(self, encoder: Any, ids: Int[Tensor, " l"]) -> Float[Tensor, "l d"]:
        said = ids != encoder.config.pad_token_id
        return torch.where(said[:, None], encoder(ids[None], said[None].long())[0][0], 0)


def cleaned(text: str) -> str:
    """A text as Wan's pipeline cleans it: HTML entities are resolved, runs of white space become one space.

    Where ftfy is installed, it repairs what a wrong encoding has garbled; plain texts are the same without it.
    """
    if importlib.util.find_spec("ftfy"):
        text = importlib.import_module("ftfy").fix_text(text)
    return re.sub(r"\s+", " ", html.unescape(html.unescape(text))).strip()
