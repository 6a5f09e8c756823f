"""All that the next step depends on, as plain tensors: what `Mpm.snapshot` gives and `Mpm.restore` takes.

Particles are kept bit for bit, so that a run that goes on from a snapshot is the run that was never interrupted. The grid is
computed anew in every substep and is left out, except for the volume at rest, of which only the nodes that hold some are kept.
Config, domain and obstacle are not in it; sums that tell them apart are, and a snapshot of another setting is refused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from pgsd_nerfstudio.physics.mpm.materials import Elastic, Matter, Sand, Snow, Water

KEYS = ("state", "tags", "signal", "materials", "rest_nodes", "rest", "seconds", "substeps", "setting")
"""Keys of a snapshot."""
_KINDS: dict[str, type[Matter]] = {kind.name: kind for kind in (Water, Elastic, Snow, Sand)}


def materials_as_tensor(materials: Sequence[Matter]) -> Tensor:
    """Materials in the order of their index, as bytes of JSON (whose numbers come back to the last bit)."""
    text = json.dumps([{"kind": material.name, **asdict(material)} for material in materials])
    return torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8).clone()


def materials_from(tensor: Tensor) -> list[Matter]:
    """Materials from the bytes of `materials_as_tensor`.

    Raises:
        ValueError: a kind or number is not one of a material.
    """
    materials: list[Matter] = []
    for row in json.loads(bytes(tensor.cpu().tolist())):
        numbers: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in row.items()}
        kind = numbers.pop("kind")
        if kind not in _KINDS:
            raise ValueError(f"a snapshot's materials must be of {', '.join(_KINDS)}, found {kind!r}")
        try:
            materials.append(_KINDS[kind](**numbers))
        except TypeError as error:
            raise ValueError(f"a snapshot's {kind} does not have the numbers of {kind}: {error}") from error
    return materials


def require_fitting(snapshot: Mapping[str, Tensor], setting: Tensor, dtype: torch.dtype) -> None:
    """Check that a snapshot was taken in this setting.

    Raises:
        ValueError: a key is missing, or the precision or the setting is another one.
    """
    missing = [key for key in KEYS if key not in snapshot]
    if missing:
        raise ValueError(f"a snapshot must hold {', '.join(KEYS)}; missing: {', '.join(missing)}")
    if snapshot["state"].dtype != dtype:
        raise ValueError(f"this simulation computes in {dtype}, the snapshot was taken in {snapshot['state'].dtype}")
    found = snapshot["setting"].cpu()
    if found.shape != setting.shape or not torch.allclose(found, setting, rtol=1e-6, atol=1e-9):
        raise ValueError(
            "a snapshot fits only the setting that it was taken in (spacing, domain, gravity, sleep, obstacle): its sums are "
            f"{[round(v, 6) for v in found.tolist()]}, here they are {[round(v, 6) for v in setting.tolist()]}"
        )
