"""Trajectories of all particles of one simulation, stored ragged: each particle has rows only from its birth to its end.

Frames count rendered time steps. A particle is *active* in the frames births <= frame < ends. A particle that lands is active
through the frame of the contact, which is its last active position; from `ends` to the last frame it is *collided* and rests at
`rest_positions`. A particle that leaves the domain or is absorbed ends without a rest position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pgsd_nerfstudio.physics.bodies import DENSE, SLID
from pgsd_nerfstudio.physics.record.codec import Steps, decode, encode
from pgsd_nerfstudio.storage import load_tensors, save_tensors


class Window(NamedTuple):
    """Trajectories in t consecutive frames as dense tensors."""

    ids: Int[Tensor, " n"]
    """Particles that are active in at least one frame of the window."""
    positions: Float[Tensor, "n t 3"]
    """Metres; the first active position before birth, the last one after the end."""
    active: Bool[Tensor, "n t"]


@dataclass(frozen=True)
class ParticleHistory:
    """Trajectories of p particles over `frames` frames. All tensors share a device."""

    births: Int[Tensor, " p"]
    """First active frame, int32. A particle that is in the air from the start has 0."""
    ends: Int[Tensor, " p"]
    """Exclusive end of the active frames, int32."""
    collided: Bool[Tensor, " p"]
    """Whether the particle is at rest on a surface from `ends` on."""
    offsets: Int[Tensor, " p+1"]
    """Row of `positions` where each particle's active frames start, int64."""
    positions: Float[Tensor, "m 3"]
    """Metres, metric frame; rows offsets[i] .. offsets[i+1] belong to frames births[i] .. ends[i]."""
    rest_positions: Float[Tensor, "p 3"]
    """Positions at rest, metres; zero for particles that did not collide."""
    rest_quats: Float[Tensor, "p 4"]
    """Orientation at rest, wxyz: the local z axis is the surface normal, the spin about it is random."""
    rest_extents: Float[Tensor, " p"]
    """Radius in metres over which the surface around the contact is flat and unbroken."""
    rest_covers: Float[Tensor, " p"]
    """Thickness along z in metres of the cover beneath the particle; zero where there is none."""
    quats: Float[Tensor, "p 4"]
    """Orientation while active, wxyz."""
    diameters: Float[Tensor, " p"]
    """Metres."""
    represents: Float[Tensor, " p"]
    """Real particles that each particle represents: where it was born, or where it landed."""
    reaches: Float[Tensor, " p"]
    """Metres up to which a camera shows each particle; `physics.air.emitters` draws them. 1e9: at any distance."""
    kinds: UInt8[Tensor, " p"]
    """Bits: 1 the particle is a splash droplet, 2 it has slid, 4 it has been dense matter."""
    fps: float
    """Frames per second."""
    frames: int
    about: Mapping[str, Any] = field(default_factory=dict)
    """Settings and totals of the simulation: plain values, saved as JSON."""

    def __post_init__(self) -> None:
        p = self.births.shape[0]
        if self.offsets.shape[0] != p + 1 or int(self.offsets[-1]) != self.positions.shape[0]:
            raise ValueError(
                f"offsets must have {p + 1} entries and end at {self.positions.shape[0]}, "
                f"found {self.offsets.shape[0]} entries that end at {int(self.offsets[-1])}"
            )

    def __len__(self) -> int:
        return self.births.shape[0]

    @property
    def device(self) -> torch.device:
        return self.positions.device

    @property
    def nbytes(self) -> int:
        """Memory of all tensors in bytes."""
        return sum(getattr(self, name).nbytes for name in _TENSORS)

    def active(self, frame: int) -> Int[Tensor, " n"]:
        """Ids of the particles that are active at `frame`, ascending."""
        return ((self.births <= frame) & (frame < self.ends)).nonzero()[:, 0]

    def resting(self, frame: int) -> Int[Tensor, " n"]:
        """Ids of the particles that have collided and are at rest at `frame`, ascending."""
        return (self.collided & (self.ends <= frame)).nonzero()[:, 0]

    def positions_at(self, frame: int, ids: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Positions of particles in metres.

        Args:
            frame: the frame.
            ids: particles that are active in that frame.
        """
        return self.positions[self._rows(frame, ids)]

    def displacement_at(self, frame: int, ids: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Displacements of particles in metres within one frame at the velocity that they have at `frame`.

        That is x(frame) - x(frame - 1), with two exceptions. In the frame of birth it is the displacement of the next frame, as
        if the particle had entered with that velocity. In the last frame of a particle that flew into something it is that of
        the frame before, since a contact cuts its last step short and not the velocity with which it arrives. It is zero for a
        particle that is active in one frame only.

        Args:
            frame: the frame.
            ids: particles that are active in that frame.
        """
        rows, first = self._rows(frame, ids), self.offsets[ids]
        last = self.offsets[ids + 1] - 1
        flew = (self.kinds[ids] & (SLID | DENSE)) == 0
        cut_short = (rows == last) & (self.ends[ids] < self.frames) & flew
        here = torch.where(rows == first, torch.minimum(rows + 1, last), rows - cut_short.long())
        here = torch.maximum(here, torch.minimum(first + 1, last))
        return self.positions[here] - self.positions[torch.maximum(here - 1, first)]

    def window(self, start: int, stop: int) -> Window:
        """Dense trajectories of the particles that are active in any frame of a window.

        Args:
            start: first frame.
            stop: exclusive end of the frames.
        """
        ids = ((self.births < stop) & (start < self.ends)).nonzero()[:, 0]
        at = torch.arange(start, stop, device=self.device)
        born, ended = self.births[ids].long()[:, None], self.ends[ids].long()[:, None]
        rows = self.offsets[ids][:, None] + (torch.minimum(torch.maximum(at, born), ended - 1) - born)
        return Window(ids, self.positions[rows], (born <= at) & (at < ended))

    def select(self, ids: Int[Tensor, " n"]) -> ParticleHistory:
        """The history of the given particles alone, in their order; their new ids are 0 .. n - 1."""
        first, lengths = self.offsets[ids], self.offsets[ids + 1] - self.offsets[ids]
        offsets = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
        total = int(offsets[-1])
        rows = (first - offsets[:-1]).repeat_interleave(lengths) + torch.arange(total, device=self.device)
        every = {name: getattr(self, name)[ids] for name in _TENSORS if name not in ("offsets", "positions")}
        return replace(self, **every, offsets=offsets, positions=self.positions[rows])

    def to(self, device: torch.device | str) -> ParticleHistory:
        """The same history on another device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in _TENSORS})

    def check_finite(self) -> None:
        """Check that all numbers are finite.

        Raises:
            ValueError: a quantity is NaN or infinite; the message names the first one, with its particle and frame.
        """
        for name in _TENSORS:
            value = getattr(self, name)
            # A finite sum has finite terms only; a mask of all positions would take far longer.
            if not value.dtype.is_floating_point or math.isfinite(float(value.sum())):
                continue
            if not bool(torch.isfinite(value).all()):
                row = int((~torch.isfinite(value)).reshape(value.shape[0], -1).any(1).nonzero()[0, 0])
                if name == "positions":
                    particle = int(torch.searchsorted(self.offsets, row, right=True)) - 1
                    frame = int(self.births[particle]) + row - int(self.offsets[particle])
                else:
                    particle, frame = row, int(self.ends[row])
                raise ValueError(f"{name} of particle {particle} are not finite in frame {frame}: {value[row].tolist()}")

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically; positions are rounded to the lattice of `codec`.

        Raises:
            ValueError: a position is NaN or infinite.
            OSError: the file could not be written.
        """
        *lists, exponent = encode(self.positions.numpy(force=True), self.offsets.numpy(force=True))
        tensors = {name: getattr(self, name) for name in _TENSORS if name != "positions"}
        tensors |= {name: torch.from_numpy(steps) for name, steps in zip(_LISTS, lists, strict=True)}
        plain = {"fps": self.fps, "frames": self.frames, "exponent": exponent, "format": _FORMAT}
        save_tensors(path, tensors, {**self.about, **plain})

    @staticmethod
    def load(path: Path) -> ParticleHistory | None:
        """A saved history; None where there is no file, or where it is damaged or has another format."""
        stored = load_tensors(path)
        if stored is None or stored[1].get("format") != _FORMAT or _STORED - set(stored[0]):
            return None
        tensors, about = stored
        about = dict(about)
        del about["format"]
        one, two, four = (tensors.pop(name).numpy() for name in _LISTS)
        try:
            positions = torch.from_numpy(decode(Steps(one, two, four, about.pop("exponent")), tensors["offsets"].numpy()))
        except ValueError:  # damaged
            return None
        fps, frames = about.pop("fps"), about.pop("frames")
        return ParticleHistory(**tensors, positions=positions, fps=fps, frames=frames, about=about)

    def _rows(self, frame: int, ids: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        return self.offsets[ids] + (frame - self.births[ids])


_FORMAT = 3
_TENSORS = tuple(f.name for f in fields(ParticleHistory) if f.name not in ("fps", "frames", "about"))
_LISTS = ("steps", "steps_two", "steps_four")  # names of the encoded positions in a file
_STORED = (set(_TENSORS) - {"positions"}) | set(_LISTS)
