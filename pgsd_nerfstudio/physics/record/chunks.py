"""Chunks of a run: the record of some frames, its file, and the history that all chunks make together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.bodies import DENSE, ENDS, SLID, SPLASHED, RunState, with_prefix, without_prefix
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.record.codec import FINEST, exponent_for, quantised
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.storage import load_tensors, save_tensors


@dataclass(frozen=True)
class Chunk:
    """Record of `frames` frames from `start` on."""

    start: int
    frames: int
    row_ids: Int[ndarray, " m"]
    """Particle of each row; rows are ordered by frame."""
    row_counts: Int[ndarray, " f"]
    """Number of rows of each frame."""
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


def assemble(chunks: list[Chunk], clock: Clock, about: Mapping[str, Any]) -> ParticleHistory:
    """The history of a run.

    Args:
        chunks: all chunks of the run, in order. They are taken out of the list one by one, so that no row is in memory twice.
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
        **rest,
        "quats": joined("quats"),
        "diameters": joined("diameters"),
        "represents": represents,
        "reaches": joined("reaches"),
        "kinds": kinds,
    }
    last = chunks[-1].state
    arrays["positions"] = _trajectories(chunks, births, offsets)
    counts = {name: int((how == code).sum()) for name, code in ENDS.items()}
    counts |= {"emitted": count, "in_air": last.moving, "splashed": int((kinds & SPLASHED > 0).sum())}
    counts |= {"slid": int((kinds & SLID > 0).sum()), "dense": int((kinds & DENSE > 0).sum())}
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    return ParticleHistory(**tensors, fps=clock.fps, frames=clock.frames, about={**about, **counts})


def _trajectories(chunks: list[Chunk], births: Int[ndarray, " p"], offsets: Int[ndarray, " p+1"]) -> Float[ndarray, "m 3"]:
    """The rows of all chunks ordered by particle and frame, rounded to the lattice of `codec`; NaN where a row is missing.

    Raises:
        ValueError: a position is NaN or infinite, or a row belongs to a frame in which its particle is not active.
    """
    positions = np.empty((int(offsets[-1]), 3), np.float32)
    largest, first = 0.0, 0
    while chunks:
        chunk = chunks.pop(0)
        # Particles are numbered as they are born, so that those of a chunk have rows beside each other.
        born = first + len(chunk.births)
        positions[offsets[first] : offsets[born]] = np.nan
        first = born
        rows = chunk.row_positions, chunk.row_ids, chunk.row_counts.astype(np.int64)
        found, bad = _place(positions, *rows, chunk.start, births, offsets, 2.0**-FINEST, 2.0**FINEST)
        largest = max(largest, float(found))
        if bad >= 0:
            frame = chunk.start + int(np.searchsorted(np.cumsum(chunk.row_counts), bad, side="right"))
            where = f"in frame {frame}: {chunk.row_positions[bad].tolist()}"
            raise ValueError(f"the position of particle {chunk.row_ids[bad]} is not finite, or it is not active, {where}")
    # The lattice is nearly always the finest. Where a coordinate is too large for it, the rows are rounded to a coarser one.
    return positions if exponent_for(largest) == FINEST else quantised(positions, offsets)


@kernel()
def _place(positions, row_positions, row_ids, row_counts, start, births, offsets, quanta, quantum):
    """Put rounded rows into their places; returns the largest absolute coordinate, and the first row without a place, or -1."""
    largest, row = np.float32(0.0), 0
    for frame in range(len(row_counts)):
        for _ in range(row_counts[frame]):
            particle = row_ids[row]
            place = offsets[particle] + (start + frame - births[particle])
            size = np.float32(0.0)
            for axis in range(3):
                size = max(size, abs(row_positions[row, axis]))
            whole = row_positions[row, 0] + row_positions[row, 1] + row_positions[row, 2]  # NaN where one of them is
            if not (size < np.inf and whole == whole and place >= offsets[particle] and place < offsets[particle + 1]):
                return largest, row
            largest = max(largest, size)
            for axis in range(3):
                # The way through a whole number, as in decoding, avoids a negative zero.
                positions[place, axis] = np.int64(np.rint(row_positions[row, axis] * quanta)) * quantum
            row += 1
    return largest, -1
