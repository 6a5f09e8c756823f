"""Folders of video priors: what diffusers writes of a text-to-video model, on this disk or on the Hugging Face hub.

Everything is judged before any weight is read, so that a wrong path costs one sentence and no minutes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BUNDLED = Path(__file__).parent / "bundled"
PARTS = ("transformer", "vae", "scheduler", "text_encoder", "tokenizer")
"""Subfolders of a text-to-video model."""
CONFIGS = {"scheduler": "scheduler_config.json", "tokenizer": "tokenizer_config.json"}
HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
SAMPLED_BLOCKS, BLOCK_BYTES = 64, 1 << 14


class PriorError(ValueError):
    """The video prior cannot be used; the message says what was expected, what was found and what to do."""


@dataclass(frozen=True)
class Family:
    """What tells one family of text-to-video models from another, in the words of their configurations."""

    name: str
    """As the family is called in messages."""
    classes: Mapping[str, str]
    """Class that a part's configuration must name, by part."""
    channels: str
    """The VAE's key for the number of its latent channels."""
    prediction: str
    """The scheduler's prediction_type."""
    example: str
    """Hub id of a member."""
    assumed: str | None = None
    """The prediction_type of a scheduler that does not name one."""


def find_prior(place: str | Path, family: Family) -> Path:
    """The folder of a video prior of one family.

    Args:
        place: "bundled", a local folder, or the id of a model on the Hugging Face hub such as "THUDM/CogVideoX-2b".
        family: what the model must be of.

    Raises:
        PriorError: there is no such folder or model, or it is not a complete text-to-video model of this family.
    """
    folder = find_folder(place)
    _judge(folder, family)
    return folder


def find_folder(place: str | Path) -> Path:
    """The folder of a model, not yet judged: it may hold a video prior of any family, or none at all.

    Args:
        place: as `find_prior` takes it.

    Raises:
        PriorError: there is no such folder or model.
    """
    if str(place) == "bundled":
        if not (BUNDLED / "transformer").is_dir():
            raise PriorError("the bundled video prior has no weights: make them with `python scripts/train_bundled_prior.py`")
        return BUNDLED
    folder = Path(place).expanduser()
    return folder if folder.exists() else _download(str(place))


def is_of(folder: Path, family: Family) -> bool:
    """Whether the transformer in a folder says that it is of a family; False where it says nothing."""
    try:
        return read_config(folder, "transformer").get("_class_name") == family.classes["transformer"]
    except PriorError:
        return False


def fingerprint(folder: Path) -> str:
    """Identity of the files below a folder, from their names, sizes and 64 blocks of 16 KiB of each.

    This is enough to tell two trainings apart without reading gigabytes of a text encoder.
    """
    digest = hashlib.sha256()
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        size = file.stat().st_size
        digest.update(f"{file.relative_to(folder)}:{size};".encode())
        with file.open("rb") as stream:
            for block in range(SAMPLED_BLOCKS):
                stream.seek(block * max(BLOCK_BYTES, (size - BLOCK_BYTES) // (SAMPLED_BLOCKS - 1)))
                digest.update(stream.read(BLOCK_BYTES))
    return digest.hexdigest()[:16]


def stored_dtype(folder: Path) -> str:
    """Number format of the first weight stored in the folder of a part, as safetensors writes it: F16, BF16, F32."""
    from safetensors import safe_open

    with safe_open(min(folder.glob("*.safetensors")), framework="pt") as stored:
        return stored.get_slice(next(iter(stored.keys()))).get_dtype()


def read_config(folder: Path, part: str) -> dict[str, Any]:
    """Configuration of one of the `PARTS`.

    Raises:
        PriorError: the file is missing or no JSON.
    """
    path = folder / part / CONFIGS.get(part, "config.json")
    try:
        return json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise PriorError(f"a diffusers folder has {part}/{path.name}, but {path} could not be read: {error}") from error


def _download(name: str) -> Path:
    missing = f"there is no local folder {name}"
    if not HUB_ID.fullmatch(name):
        raise PriorError(
            f"{missing}; give a diffusers CogVideoX folder or Wan folder, a hub id such as THUDM/CogVideoX-2b, or `bundled`"
        )
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(name, allow_patterns=["*.json", "*.txt", "*.model", "*.safetensors"]))
    except Exception as error:  # whatever the network, the hub or the disk has to say belongs in the one sentence
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise PriorError(f"{missing}, and it could not be downloaded from the Hugging Face hub: {reason[0]}") from error


def _judge(folder: Path, family: Family) -> None:
    if not folder.is_dir():
        raise PriorError(f"a video prior is a diffusers {family.name} folder, but {folder} is a file")
    missing = [part for part in PARTS if not (folder / part).is_dir()]
    if missing:
        raise PriorError(
            f"{folder} is not a diffusers {family.name} folder: it lacks {', '.join(missing)}; "
            f"such a folder holds {', '.join(PARTS)} and is what diffusers' save_pretrained writes"
        )
    for part in PARTS:
        config, expected = read_config(folder, part) if part != "tokenizer" else {}, family.classes.get(part)
        if expected and config.get("_class_name") != expected:
            found, use = config.get("_class_name"), f"use a {family.name} model such as {family.example}"
            raise PriorError(f"{folder / part} must hold a {expected}, found {found}; {use}")
        weighted = part in ("transformer", "vae", "text_encoder")
        if weighted and not any((folder / part).glob("*.safetensors")):
            raise PriorError(f"{folder / part} holds no *.safetensors weights; download the model again")
    taken = read_config(folder, "transformer").get("in_channels", 16)
    made = read_config(folder, "vae").get(family.channels, 16)
    if taken != made:
        raise PriorError(
            f"{folder} takes {taken} channels where its VAE makes {made}: an image-to-video model; "
            f"use a text-to-video one such as {family.example}"
        )
    prediction = read_config(folder, "scheduler").get("prediction_type", family.assumed)
    if prediction != family.prediction:
        raise PriorError(
            f"the scheduler in {folder} must have the prediction_type {family.prediction}, as {family.name} has, found "
            f"{prediction}; take the scheduler's folder from the published model"
        )
