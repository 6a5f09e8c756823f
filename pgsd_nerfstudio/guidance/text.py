"""Embeddings of texts, as a video prior takes them. Each text is encoded once, ever: its embedding is cached on disk.

The text encoder is by far the largest part of CogVideoX (T5-XXL, 4.7 billion parameters). It is loaded only for texts that are
not in the cache, and dropped at once.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.guidance.folder import PriorError, fingerprint
from pgsd_nerfstudio.storage import cache_dir, content_key, load_tensors, save_tensors


class PromptEncoder:
    """Text embeddings of one prior, remembered in memory and on disk."""

    encoder_class = "T5EncoderModel"
    """Name of the text encoder's class in transformers."""

    def __init__(self, folder: Path, length: int, device: torch.device, dtype: torch.dtype) -> None:
        """Remember where the text encoder lies; nothing is loaded yet.

        Args:
            folder: of the prior, with text_encoder and tokenizer in it.
            length: tokens per text; texts are padded or cut to it.
            device: where embeddings are made and handed out.
            dtype: number format of the text encoder and of its embeddings.
        """
        self._folder, self._length, self._device, self._dtype = folder, length, device, dtype
        self._identity = content_key(fingerprint(folder / "text_encoder"), fingerprint(folder / "tokenizer"), length)
        self._known: dict[str, Tensor] = {}

    def __call__(self, texts: Sequence[str]) -> Float[Tensor, "n l d"]:
        """Embeddings in the prior's device and dtype, one per text."""
        if isinstance(texts, str):
            raise TypeError("encode_prompt takes a list of texts; wrap the one text in [ ]")
        for text in texts:
            if text not in self._known and (stored := load_tensors(self._path(text))):
                self._known[text] = stored[0]["embedding"]
        new = [text for text in dict.fromkeys(texts) if text not in self._known]
        for text, embedding in zip(new, self._encode(new), strict=True):
            self._known[text] = embedding
            save_tensors(self._path(text), {"embedding": embedding}, {"text": text})
        return torch.stack([self._known[text] for text in texts]).to(self._device, self._dtype)

    def _path(self, text: str) -> Path:
        return cache_dir() / "prompts" / f"{content_key(self._identity, text, str(self._dtype))}.safetensors"

    @torch.no_grad()
    def _encode(self, texts: list[str]) -> list[Tensor]:
        if not texts:
            return []
        import transformers

        try:
            ids = token_ids(self._folder / "tokenizer", texts, self._length)
            kind = getattr(transformers, self.encoder_class)
            encoder = kind.from_pretrained(self._folder / "text_encoder", dtype=self._dtype, local_files_only=True)
        except Exception as error:
            raise PriorError(f"the text encoder in {self._folder} could not be loaded: {error}") from error
        torch.nn.Module.to(encoder, self._device).eval()
        embeddings = [self._embedding(encoder, row.to(self._device)).cpu() for row in ids]
        del encoder
        gc.collect()
        if self._device.type == "cuda":
            torch.cuda.empty_cache()
        bad = [text for text, e in zip(texts, embeddings, strict=True) if not torch.isfinite(e).all()]
        if bad:
            raise PriorError(
                f"the text encoder gave NaN or infinity for {bad[0]!r} in {self._dtype}; use a wider dtype, e.g. float32"
            )
        return embeddings

    def _embedding(self, encoder: Any, ids: Int[Tensor, " l"]) -> Float[Tensor, "l d"]:
        """One text as CogVideoX' pipeline embeds it: padded to full length; the padding attends and is attended to."""
        return encoder(ids[None])[0][0]


def token_ids(folder: Path, texts: Sequence[str], length: int) -> Int[Tensor, "n l"]:
    """T5 tokens of texts, closed by the end token.

    CogVideoX ships a bare SentencePiece model. transformers' conversion of one needs a newer protobuf than nerfstudio allows,
    so the model is asked directly; the tokens are the same.

    Args:
        folder: the tokenizer's.
        texts: any strings.
        length: tokens per text; texts are padded or cut to it.
    """
    model = folder / "spiece.model"
    if model.is_file() and not (folder / "tokenizer.json").is_file():
        from sentencepiece import SentencePieceProcessor

        pieces = SentencePieceProcessor(model_file=str(model))
        rows = [[*pieces.encode(text)[: length - 1], pieces.eos_id()] for text in texts]
        return torch.tensor([row + [pieces.pad_id()] * (length - len(row)) for row in rows])
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    return tokenizer(list(texts), padding="max_length", max_length=length, truncation=True, return_tensors="pt").input_ids
