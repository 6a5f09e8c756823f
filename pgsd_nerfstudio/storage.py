"""Content-addressed storage of results that are costly to compute: meshes, motion priors, the demo scene.

A file is named by the hash of everything it was made from, so a stale file is never read. A file is written under a temporary
name and then renamed, so a half-written file never carries the final name. A file of tensors holds a digest of all that is in
it, which is compared whenever it is read: a disk or a copy that changes a single bit is noticed.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

_log = logging.getLogger(__name__)


def cache_dir() -> Path:
    """The folder of all stored files: $PGSD_CACHE, else ~/.cache/pgsd_nerfstudio."""
    return Path(os.environ.get("PGSD_CACHE") or Path.home() / ".cache" / "pgsd_nerfstudio")


def content_key(*parts: Any) -> str:
    """Hash of the parts, in their order: 16 hexadecimal digits of SHA-256.

    Args:
        parts: tensors, arrays, dataclasses, mappings, lists, tuples, paths and plain values, nested as deep as needed. The name
            of a dataclass and the names of its fields count.

    Raises:
        TypeError: a part is of a type that has no stable content.
    """
    digest = hashlib.sha256()
    for part in parts:
        _feed(digest, part)
    return digest.hexdigest()[:16]


def _feed(digest: Any, part: Any) -> None:
    if isinstance(part, Tensor):
        part = part.detach().cpu().contiguous().numpy()
    if isinstance(part, np.ndarray):
        digest.update(f"{part.dtype}{part.shape}".encode())
        digest.update(np.ascontiguousarray(part).data)
    elif is_dataclass(part) and not isinstance(part, type):
        digest.update(type(part).__name__.encode())
        for name in part.__dataclass_fields__:
            digest.update(name.encode())
            _feed(digest, getattr(part, name))
    elif isinstance(part, Mapping):
        for key in sorted(part):
            _feed(digest, key)
            _feed(digest, part[key])
    elif isinstance(part, list | tuple):
        digest.update(f"[{len(part)}".encode())
        for item in part:
            _feed(digest, item)
    elif part is None or isinstance(part, str | bytes | int | float | bool | Path):
        digest.update(f"{type(part).__name__}:{part!r};".encode())
    else:
        raise TypeError(f"no stable content hash for a {type(part).__name__}")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`, and rename it to `path` when the block ends; a block that fails leaves no file.

    Args:
        path: the final name; its folder is made where it is missing.

    Raises:
        OSError: the folder could not be made, or the file could not be renamed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{uuid.uuid4().hex[:8]}.{path.name}")  # with the suffix by which writers choose a format
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def save_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any] | None = None) -> None:
    """Write tensors as one safetensors file, atomically.

    Args:
        path: the final name; its folder is made where it is missing.
        tensors: tensors of any device by name.
        about: a description that JSON can hold, stored with the tensors.

    Raises:
        OSError: the file could not be written (disk full, no permission); no file is left behind.
    """
    try:
        with atomic_write(path) as temporary:
            data = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
            described = json.dumps(dict(about or {}))
            save_file(data, temporary, metadata={"about": described, "digest": _digest(data, described)})
    except (OSError, SafetensorError) as error:
        raise OSError(
            f"could not write {path}: {error}; free some space or set PGSD_CACHE to a folder on another disk"
        ) from error


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """The tensors and the description of a stored file; None if there is none, or if it is damaged, which is logged."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as stored:
            tensors = {name: stored.get_tensor(name) for name in list(stored.keys())}
            metadata = stored.metadata() or {}
        described = metadata.get("about", "")
        if metadata.get("digest") == _digest(tensors, described):
            return tensors, json.loads(described)
        fault = "its content is not what was written" if "digest" in metadata else "it was written by an older version"
    except (SafetensorError, OSError, ValueError) as error:
        fault = " ".join(str(error).split())
    _log.warning("%s is damaged and is not read: %s", path, fault)
    return None


def header_of(path: Path) -> tuple[dict[str, Any], int]:
    """The header of a file of tensors, and the place in the file at which its values begin, in bytes.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is too short for its header, or its header is no JSON object.
    """
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if length > path.stat().st_size:
            raise ValueError(f"{path} is shorter than its header")
        header = json.loads(file.read(length))
    if not isinstance(header, dict):
        raise ValueError(f"the header of {path} is no object")
    return header, 8 + length


def _digest(tensors: Mapping[str, Tensor], described: str) -> str:
    """SHA-256 of names, types, shapes and values of the tensors, and of their description."""
    digest = hashlib.sha256(described.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\0{name}\0{tensor.dtype}{tuple(tensor.shape)}".encode())
        # As bytes, since NumPy has no bfloat16; torch sees none in a tensor of one value with an odd stride.
        flat = tensor.contiguous().as_strided((tensor.numel(),), (1,))
        digest.update(flat.view(torch.uint8).numpy().data)
    return digest.hexdigest()
