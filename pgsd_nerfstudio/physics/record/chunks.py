"""A run in pieces: what a chunk of frames yields, how it is stored, how chunks become one history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import DENSE, ENDS, SLID, SPLASHED, RunState
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.record.codec import quantised
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.storage import content_key, load_tensors, save_tensors


@dataclass(frozen=True)
class Chunk:
    """What happened in `frames` frames from `start` on."""

    start: int
    frames: int
    row_ids: Int[ndarray, " m"]
    """Particle of each row; rows are ordered by frame."""
    row_frames: Int[ndarray, " m"]
    row_positions: Float[ndarray, "m 3"]
    births: Int[ndarray, " b"]
    """Of the particles born in this chunk, whose ids follow on from the chunk before."""
    diameters: Float[ndarray, " b"]
    represents: Float[ndarray, " b"]
    quats: Float[ndarray, "b 4"]
    kind_ids: Int[ndarray, " k"]
    """Particles that became of a kind in this chunk, and the bits of all kinds that they then have been of."""
    kind_bits: Int[ndarray, " k"]
    ended_ids: Int[ndarray, " e"]
    ended_frames: Int[ndarray, " e"]
    """Exclusive end of the active frames."""
    ended_how: Int[ndarray, " e"]
    rest_ids: Int[ndarray, " h"]
    """Of those that landed."""
    rest_positions: Float[ndarray, "h 3"]
    rest_quats: Float[ndarray, "h 4"]
    rest_extents: Float[ndarray, " h"]
    rest_covers: Float[ndarray, " h"]
    state: RunState
    """At the end of the chunk."""


_ARRAYS = tuple(f.name for f in fields(Chunk) if f.name not in ("start", "frames", "state"))


def _path(folder: Path, index: int) -> Path:
    return folder / f"chunk-{index:04d}.safetensors"


def save_chunk(folder: Path, index: int, chunk: Chunk) -> bool:
    """Store a chunk; False where the disk would not take it."""
    tensors = {name: torch.from_numpy(np.ascontiguousarray(getattr(chunk, name))) for name in _ARRAYS}
    arrays = chunk.state.arrays()
    tensors |= {f"state.{name}": torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}
    plain = {"start": chunk.start, "frames": chunk.frames, "born": chunk.state.born, "carry": chunk.state.carry.hex()}
    try:
        save_tensors(_path(folder, index), tensors, {**plain, "content": content_key(tensors, plain)})
    except OSError:
        return False
    return True


def load_chunk(folder: Path, index: int, start: int, frames: int) -> Chunk | None:
    """A stored chunk; None where there is none, or where what is there is damaged or of other frames."""
    stored = load_tensors(_path(folder, index))
    if stored is None:
        return None
    tensors, about = stored
    content = about.pop("content", None)
    if content != content_key(tensors, about) or (about.get("start"), about.get("frames")) != (start, frames):
        return None
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    inner = {name: arrays.pop(name) for name in list(arrays) if name.startswith("state.")}
    inner = {name.removeprefix("state."): value for name, value in inner.items()}
    state = RunState.of(inner, about["born"], float.fromhex(about["carry"]))
    return Chunk(start=start, frames=frames, state=state, **arrays)


_LYING = {"positions": (3,), "quats": (4,), "extents": (), "covers": ()}


def assemble(chunks: Sequence[Chunk], clock: Clock, about: Mapping[str, Any]) -> ParticleHistory:
    """One history from all chunks of a run; `about` gains the counts of how particles ended."""

    def joined(name: str) -> ndarray:
        return np.concatenate([getattr(chunk, name) for chunk in chunks])

    births, count = joined("births"), chunks[-1].state.born
    ends = np.full(count, clock.frames, np.int32)
    ended, how = joined("ended_ids"), joined("ended_how")
    ends[ended] = joined("ended_frames")
    offsets = np.concatenate([[0], np.cumsum(ends.astype(np.int64) - births)])
    ids = joined("row_ids")
    positions = np.full((offsets[-1], 3), np.nan, np.float32)
    positions[offsets[ids] + joined("row_frames") - births[ids]] = joined("row_positions")
    rests, collided = joined("rest_ids"), np.zeros(count, bool)
    collided[rests] = True
    lying = {f"rest_{name}": np.zeros((count, *shape), np.float32) for name, shape in _LYING.items()}
    lying["rest_quats"][:, 0] = 1.0
    for name, value in lying.items():
        value[rests] = joined(name)
    kinds = np.zeros(count, np.uint8)
    np.bitwise_or.at(kinds, joined("kind_ids"), joined("kind_bits"))
    arrays = {
        "births": births,
        "ends": ends,
        "collided": collided,
        "offsets": offsets,
        "positions": quantised(positions, offsets),
        **lying,
        "quats": joined("quats"),
        "diameters": joined("diameters"),
        "represents": joined("represents"),
        "kinds": kinds,
    }
    last = chunks[-1].state
    counts = {name: int((how == code).sum()) for name, code in ENDS.items()}
    counts |= {"emitted": count, "in_air": last.moving, "splashed": int((kinds & SPLASHED > 0).sum())}
    counts |= {"slid": int((kinds & SLID > 0).sum()), "dense": int((kinds & DENSE > 0).sum())}
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    return ParticleHistory(**tensors, fps=clock.fps, frames=clock.frames, about={**about, **counts})
