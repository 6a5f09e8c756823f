"""Matter at rest: which particles fall asleep, how the grid accounts for them, and which particles wake.

Resting particles cost no time. They hold still the nodes that they fill by half, as an obstacle does. If matter hits them so
fast that both together would move at `Sleep.wake_speed`, they wake in the same substep, block by block, and take up the blow;
slower matter is stopped. Waking takes one pass over the tags of all particles and the stress of those that woke.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pgsd_nerfstudio.physics.mpm import contact
from pgsd_nerfstudio.physics.mpm.blocks import N_WAKING, WAKES, Blocks
from pgsd_nerfstudio.physics.mpm.config import Sleep
from pgsd_nerfstudio.physics.mpm.layout import ACTIVE, BLOCK, CELLS, QUIET, REST, RESTING, STATE, C, V
from pgsd_nerfstudio.physics.mpm.particles import Particles


class Rest:
    """Volume and mass at rest on the nodes of a grid."""

    def __init__(self, sleep: Sleep | None, blocks: Blocks, dx: float, dtype: torch.dtype, device: str) -> None:
        self._sleep, self._blocks, self._dx = sleep, blocks, dx
        real: dict[str, Any] = {"dtype": dtype, "device": device}
        self.shares = torch.zeros(math.prod(blocks.shape) * CELLS if sleep else 1, REST, **real)
        """Share of the node's volume, and mass in kg."""
        self.any = False
        """Whether any particle rests."""
        self.wake_speed = sleep.wake_speed if sleep else math.inf

    def settle(self, particles: Particles, wall: Tensor, parts: int) -> None:
        """Put particles to sleep that have been slow for long enough and touch an obstacle or resting matter."""
        p, (_, by, bz) = particles, self._blocks.shape
        if self._sleep is None or len(p.active) == 0:
            return
        limits = (parts, int(self.any), self._sleep.speed, self._sleep.frames, self._dx, by, bz)
        contact.fall_asleep(p.state, p.tags, wall, self.shares, p.active, len(p.active), *limits)
        new = p.active[p.tags[p.active.long(), STATE] == RESTING]
        if len(new):
            p.state[new.long(), V : V + 3] = 0
            p.state[new.long(), C : C + 9] = 0
            p.signal[new.long()] = 0
            self._deposit(p, new, 1.0)
            self.any = True

    def wake_marked(self, particles: Particles) -> None:
        """Wake the resting particles of blocks that matter hit fast enough in this substep."""
        if not (self.any and int(self._blocks.heads[N_WAKING])):
            return
        tags, marks = particles.tags[: particles.count], self._blocks.table[:, WAKES]
        met = marks[tags[:, BLOCK].clamp_min(0).long()] == 1
        self.wake(particles, torch.nonzero((tags[:, STATE] == RESTING) & met)[:, 0])
        marks.zero_()
        self._blocks.heads[N_WAKING] = 0

    def wake(self, particles: Particles, ids: Tensor) -> None:
        """Make resting particles active."""
        p = particles
        p.tags[ids, STATE] = ACTIVE
        p.tags[ids, QUIET] = 0
        self.any = bool((p.tags[: p.count, STATE] == RESTING).any())
        if self.any:
            self._deposit(p, ids.to(p.active), -1.0)
        else:  # exactly zero, where the many differences would leave a rounding error
            self.shares.zero_()
        p.relist()
        p.respond(ids)

    def saved(self) -> dict[str, Tensor]:
        """The nodes that hold something at rest."""
        shares = self.shares.cpu()
        nodes = torch.nonzero((shares != 0).any(1))[:, 0] if self.any else torch.zeros(0, dtype=torch.int64)
        return {"rest_nodes": nodes, "rest": shares[nodes]}

    def restore(self, nodes: Tensor, shares: Tensor, particles: Particles) -> None:
        """Take what `saved` gave."""
        self.shares.zero_()
        self.shares[nodes.to(self.shares.device)] = shares.to(self.shares)
        self.any = bool((particles.tags[: particles.count, STATE] == RESTING).any())

    def _deposit(self, particles: Particles, ids: Tensor, sign: float) -> None:
        _, by, bz = self._blocks.shape
        contact.deposit(particles.state, self.shares, ids, len(ids), sign, 1 / self._dx, by, bz)
