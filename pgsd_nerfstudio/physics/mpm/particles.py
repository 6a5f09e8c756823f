"""All particles of a simulation: storage that grows, emission, the list of active ones, and the check for finite numbers."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.physics.mpm import constitutive
from pgsd_nerfstudio.physics.mpm.layout import (
    ACTIVE,
    ENERGY,
    MASS,
    MATERIAL,
    REMOVED,
    STATE,
    TAGS,
    VOLUME,
    WIDTH,
    C,
    F,
    J,
    V,
    X,
)
from pgsd_nerfstudio.physics.mpm.materials import COLUMNS, SAND, WATER, Matter, kind_of

QUANTITIES = {
    "position": slice(X, X + 3),
    "velocity": slice(V, V + 3),
    "velocity gradient": slice(C, C + 9),
    "deformation": slice(F, F + 9),
    "volume ratio": slice(J, J + 1),
    "energy": slice(ENERGY, ENERGY + 1),
    "stress": slice(0, WIDTH),  # what is left when all others are finite
}


class Particles:
    """Rows of numbers, as `layout` describes them; row n belongs to the particle with id n."""

    def __init__(self, dtype: torch.dtype, device: str) -> None:
        self._real: dict[str, Any] = {"dtype": dtype, "device": device}
        self._int: dict[str, Any] = {"dtype": torch.int32, "device": device}
        self.count = 0
        self.state = torch.zeros(0, WIDTH, **self._real)
        self.tags = torch.zeros(0, TAGS, **self._int)
        self.signal = torch.zeros(0, **self._real)
        """Speed of sound plus speed of the particle, m/s; 0 where it is not active."""
        self.order = torch.zeros(0, **self._int)
        """Scratch: active particles as the grid wants them."""
        self.active = torch.zeros(0, **self._int)
        """Ids, ascending."""
        self.materials: list[Matter] = []
        self.table = torch.zeros(0, 0, **self._real)

    def add(
        self,
        x: Float[Tensor, "n 3"],
        v: Float[Tensor, "n 3"],
        f: Float[Tensor, "n 3 3"],
        volume: Float[Tensor, " n"],
        removed: Tensor,  # bool [n]: particles that are outside from the start
        material: Matter,
    ) -> Tensor:
        """Append particles; returns their ids."""
        if material not in self.materials:
            self.materials.append(material)
            self.table = torch.tensor([m.row() for m in self.materials], **self._real)
        first, last = self.count, self.count + len(x)
        self._reserve(last)
        state, tags = self.state[first:last], self.tags[first:last]
        state.zero_()
        tags.zero_()
        state[:, X : X + 3], state[:, V : V + 3] = x.to(**self._real), v.to(**self._real)
        state[:, F : F + 9] = f.reshape(-1, 9).to(**self._real)
        ratio = {SAND: torch.zeros_like(volume), WATER: torch.linalg.det(f)}.get(kind_of(material), torch.ones_like(volume))
        state[:, J] = ratio.to(**self._real)
        state[:, VOLUME] = volume.to(**self._real)
        state[:, MASS] = (volume * material.density).to(**self._real)
        tags[:, MATERIAL] = self.materials.index(material)
        tags[:, STATE] = torch.where(removed, REMOVED, ACTIVE).to(**self._int)
        self.count = last
        self.relist()
        ids = torch.arange(first, last)
        self.respond(ids)
        return ids

    def restore(self, state: Tensor, tags: Tensor, signal: Tensor, materials: list[Matter]) -> None:
        """Forget all particles and take these in their place."""
        self.materials, self.count = list(materials), 0
        self.table = torch.tensor([m.row() for m in materials], **self._real).reshape(-1, COLUMNS)
        self._reserve(len(state))
        self.count = len(state)
        self.state[: self.count] = state.to(**self._real)
        self.tags[: self.count] = tags.to(**self._int)
        self.signal[: self.count] = signal.to(**self._real)
        self.relist()

    def relist(self) -> None:
        """List the active particles anew."""
        condition = self.tags[: self.count, STATE]
        self.active = torch.nonzero(condition == ACTIVE)[:, 0].to(torch.int32)
        self.signal[: self.count][condition == REMOVED] = 0

    def respond(self, ids: Tensor) -> None:
        """Stress and speed of sound of particles as they are now."""
        if len(ids):
            constitutive.respond(self.state, self.tags, self.signal, self.table, ids.to(**self._int), len(ids), 0.0)

    def require_finite(self, seconds: float) -> None:
        """Check every number of every particle.

        Raises:
            FloatingPointError: one is not finite; the message names the quantity.
        """
        rows = self.state[: self.count]
        if rows.isfinite().all():
            return
        for name, where in QUANTITIES.items():
            bad = ~rows[:, where].isfinite().all(1)
            if bad.any():
                first = int(bad.nonzero()[0])
                raise FloatingPointError(
                    f"the {name} of {int(bad.sum())} particles (first: {first}) is not finite at {seconds:.6g} s"
                )

    def _reserve(self, count: int) -> None:
        if count <= len(self.state):
            return
        size = max(count, 2 * len(self.state))
        for name in ("state", "tags", "signal", "order"):
            old = getattr(self, name)
            new = old.new_zeros(size, *old.shape[1:])
            new[: len(old)] = old
            setattr(self, name, new)
