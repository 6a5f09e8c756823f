"""Chunks of a run: the record of some frames, its file, and the history that all chunks make together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import DENSE, ENDS, SLID, SPLASHED, RunState, with_prefix, without_prefix
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.record.codec import quantised
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.storage import load_tensors, save_tensors


@dataclass(frozen=True)
class Chunk:
    """Record of `frames` frames from `start` on."""

    start: int
    frames: int
    row_ids: Int[ndarray, " m"]
    """Particle of each row; rows are ordered by frame."""
    row_frames: Int[ndarray, " m"]
    row_positions: Float[ndarray, "m 3"]
    """Metres."""
    births: Int[ndarray, " b"]
    """First active frame of each particle born in this chunk; their ids follow those of the chunk before."""
    diameters: Float[ndarray, " b"]
    """Metres."""
    represents: Float[ndarray, " b"]
    """Real particles that each particle represents."""
    reaches: Float[ndarray, " b"]
    """Metres up to which a camera shows each particle."""
    quats: Float[ndarray, "b 4"]
    """Orientation while active, wxyz."""
    kind_ids: Int[ndarray, " k"]
    """Particles whose kinds changed in this chunk."""
    kind_bits: UInt8[ndarray, " k"]
    """Bits of all kinds of each of them."""
    ended_ids: Int[ndarray, " e"]
    ended_frames: Int[ndarray, " e"]
    """Exclusive end of the active frames."""
    ended_how: UInt8[ndarray, " e"]
    """LANDED, ABSORBED, LEFT or UNSEEN."""
    rest_ids: Int[ndarray, " h"]
    """Particles that landed; the other rest arrays are as in `ParticleHistory`."""
    rest_positions: Float[ndarray, "h 3"]
    rest_quats: Float[ndarray, "h 4"]
    rest_extents: Float[ndarray, " h"]
    rest_covers: Float[ndarray, " h"]
    rest_represents: Float[ndarray, " h"]
    """Real particles that each represents where it landed."""
    state: RunState
    """State at the end of the chunk."""


_ARRAYS = tuple(f.name for f in fields(Chunk) if f.name not in ("start", "frames", "state"))
_STATE = "state."  # before the names of the state's arrays in a file


def _path(folder: Path, index: int) -> Path:
    return folder / f"chunk-{index:04d}.safetensors"


def save_chunk(folder: Path, index: int, chunk: Chunk) -> bool:
    """Store a chunk.

    Args:
        folder: folder of the run's chunks.
        index: number of the chunk.
        chunk: the record.

    Returns:
        False where the file could not be written.
    """
    arrays = {name: getattr(chunk, name) for name in _ARRAYS} | with_prefix(_STATE, chunk.state.arrays())
    tensors = {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}
    plain = {"start": chunk.start, "frames": chunk.frames, "born": chunk.state.born}
    try:
        save_tensors(_path(folder, index), tensors, plain)
    except OSError:
        return False
    return True


def load_chunk(folder: Path, index: int, start: int, frames: int) -> Chunk | None:
    """A stored chunk; None where there is no file, or where it is damaged or has other frames.

    Args:
        folder: folder of the run's chunks.
        index: number of the chunk.
        start: its first frame.
        frames: its number of frames.
    """
    stored = load_tensors(_path(folder, index))
    if stored is None:
        return None
    tensors, about = stored
    if (about.get("start"), about.get("frames")) != (start, frames):
        return None
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    state = RunState.of(without_prefix(_STATE, arrays), about["born"])
    own = {name: value for name, value in arrays.items() if not name.startswith(_STATE)}
    return Chunk(start=start, frames=frames, state=state, **own)


_REST = {"positions": (3,), "quats": (4,), "extents": (), "covers": ()}


def assemble(chunks: Sequence[Chunk], clock: Clock, about: Mapping[str, Any]) -> ParticleHistory:
    """The history of a run.

    Args:
        chunks: all chunks of the run, in order.
        clock: frame rate and number of frames.
        about: plain values to keep with the history, which also gets the counts of particles by kind and by how they ended.
    """

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
    rest = {f"rest_{name}": np.zeros((count, *shape), np.float32) for name, shape in _REST.items()}
    rest["rest_quats"][:, 0] = 1.0
    for name, value in rest.items():
        value[rests] = joined(name)
    represents = joined("represents")
    represents[rests] = joined("rest_represents")
    kinds = np.zeros(count, np.uint8)
    np.bitwise_or.at(kinds, joined("kind_ids"), joined("kind_bits"))
    arrays = {
        "births": births,
        "ends": ends,
        "collided": collided,
        "offsets": offsets,
        "positions": quantised(positions, offsets),
        **rest,
        "quats": joined("quats"),
        "diameters": joined("diameters"),
        "represents": represents,
        "reaches": joined("reaches"),
        "kinds": kinds,
    }
    last = chunks[-1].state
    counts = {name: int((how == code).sum()) for name, code in ENDS.items()}
    counts |= {"emitted": count, "in_air": last.moving, "splashed": int((kinds & SPLASHED > 0).sum())}
    counts |= {"slid": int((kinds & SLID > 0).sum()), "dense": int((kinds & DENSE > 0).sum())}
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    return ParticleHistory(**tensors, fps=clock.fps, frames=clock.frames, about={**about, **counts})
