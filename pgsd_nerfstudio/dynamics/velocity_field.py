"""The simulated velocity by place and frame, for particles that have left their simulated places.

The steps of the simulated particles, kept on a coarse grid. A node takes the mean of the particles around it with the weights
of trilinear interpolation. Reading that back smooths; so the means of the remaining error are added a few times (Van Cittert's
iteration, stable since the weights are not negative and sum to one), which also takes off most of the error of nodes that have
particles on one side only. Nodes without particles take the value of the nearest node that has some.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from pgsd_nerfstudio.physics.record.history import ParticleHistory

MOST_BYTES = 50e6
PER_CELL = 4  # active particles in a cell, on average: with fewer the grid keeps their own fall speeds instead of the flow
CORRECTIONS = 3


class Stencil(NamedTuple):
    """The eight nodes around each of n places, and their weights."""

    nodes: Int[Tensor, "n 8"]
    weights: Float[Tensor, "n 8"]

    def read(self, values: Float[Tensor, "m 3"]) -> Float[Tensor, "n 3"]:
        """Values at the places."""
        return (self.weights[:, :, None] * values[self.nodes]).sum(dim=1)

    def gather(self, values: Float[Tensor, "n k"], nodes: int) -> Float[Tensor, "m k"]:
        """Weighted sums at the nodes of values at the places."""
        parts = (self.weights[:, :, None] * values[:, None]).flatten(0, 1)
        return values.new_zeros(nodes, values.shape[1]).index_add(0, self.nodes.flatten(), parts)


@dataclass(frozen=True)
class VelocityField:
    """One grid for every step of the simulation; read between the nodes trilinearly, outside as on the wall."""

    low: Float[Tensor, "3"]
    """Corner of the grid, metres."""
    cell: float
    """Metres between nodes."""
    shape: tuple[int, int, int]
    """Nodes along x, y and z."""
    values: Float[Tensor, "steps m 3"]
    """Metres per frame at the nodes; step k leads from frame k to frame k + 1."""

    @staticmethod
    @torch.no_grad()
    def of(history: ParticleHistory, cell: float | None = None) -> VelocityField:
        """The velocities of all active particles.

        Args:
            history: the simulated motion.
            cell: metres between nodes; None: as fine as 50 MB and four particles in a cell allow.

        Raises:
            ValueError: the cell is not a positive length, or would take more than 50 MB.
        """
        steps = max(history.frames - 1, 1)
        like = history.positions
        low, high = like.aminmax(dim=0) if len(like) else (like.new_zeros(3), like.new_ones(3))
        if cell is None:
            cell = _cell(history, (high - low).tolist(), steps)
        if not 0 < cell < math.inf:
            raise ValueError(f"the cells of a velocity field must have a positive size, got {cell} m")
        shape = _shape((high - low).tolist(), cell)
        nodes, size = math.prod(shape), steps * math.prod(shape) * 3 * like.element_size()
        if size > MOST_BYTES:
            raise ValueError(
                f"a velocity field must stay below {MOST_BYTES / 1e6:.0f} MB; cells of {cell:.3g} m take {size / 1e6:.0f} MB "
                f"for {steps} steps, take larger ones"
            )
        field = VelocityField(low, cell, shape, like.new_zeros(steps, nodes, 3))
        for frame in range(1, history.frames):
            before, step = _steps(history, frame)
            if len(before):
                field.values[frame - 1] = field._fitted(field._stencil(before), step)
        return field

    @property
    def nbytes(self) -> int:
        """Memory of the values in bytes."""
        return self.values.nbytes

    def at(self, frame: int, position: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Simulated displacement in metres from frame - 1 to `frame` of matter at `position` (metres); with gradient.

        Raises:
            IndexError: no step leads to this frame.
        """
        if not 1 <= frame <= len(self.values):
            raise IndexError(f"steps lead to frames 1 to {len(self.values)}, asked for frame {frame}")
        return self._stencil(position).read(self.values[frame - 1])

    def error(self, history: ParticleHistory) -> float:
        """Mean distance in metres per frame between the particles' own steps and what the field gives at their places."""
        total, count = 0.0, 0
        for frame in range(1, history.frames):
            before, step = _steps(history, frame)
            total += float((self.at(frame, before) - step).norm(dim=1).sum())
            count += len(step)
        return total / max(count, 1)

    def _stencil(self, position: Float[Tensor, "n 3"]) -> Stencil:
        last = torch.tensor(self.shape, device=position.device) - 1
        place = torch.minimum(((position - self.low) / self.cell).clamp_min(0), last.to(position))
        # As integers, so that a position that is not finite reads some node and stays what it is by its weight.
        corner = torch.minimum(place.detach().floor().long().clamp_min(0), last - 1)
        share = (place - corner)[:, None]
        up = torch.cartesian_prod(*3 * [torch.arange(2, device=position.device)])  # [8, 3]
        x, y, z = (corner[:, None] + up).unbind(2)
        along = torch.where(up.bool(), share, 1 - share)
        return Stencil((x * self.shape[1] + y) * self.shape[2] + z, along[..., 0] * along[..., 1] * along[..., 2])

    def _fitted(self, around: Stencil, step: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
        nodes = math.prod(self.shape)
        mass = around.gather(torch.ones_like(step[:, :1]), nodes)
        empty = mass[:, 0] <= 1e-6
        mass = mass.clamp_min(1e-6)
        values = around.gather(step, nodes) / mass
        for _ in range(CORRECTIONS):
            values = values + around.gather(step - around.read(values), nodes) / mass
        return values[self._nearest(empty)]

    def _nearest(self, empty: Bool[Tensor, " m"]) -> Int[Tensor, " m"]:
        """For each node the nearest that is not empty: itself, where it is not."""
        grid = empty.reshape(self.shape).numpy(force=True)
        x, y, z = distance_transform_edt(grid, return_distances=False, return_indices=True)  # type: ignore[misc]
        return torch.from_numpy((x * self.shape[1] + y) * self.shape[2] + z).flatten().long().to(empty.device)


def _steps(history: ParticleHistory, frame: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Positions in the frame before and displacements until this one, of particles active in both."""
    ids = ((history.births < frame) & (frame < history.ends)).nonzero()[:, 0]
    before = history.positions_at(frame - 1, ids)
    return before, history.positions_at(frame, ids) - before


def _shape(extent: list[float], cell: float) -> tuple[int, int, int]:
    x, y, z = (max(math.ceil(length / cell), 1) + 1 for length in extent)
    return x, y, z


def _cell(history: ParticleHistory, extent: list[float], steps: int) -> float:
    """Metres: the smallest cell that memory and the number of particles allow."""
    active = max(len(history.positions) / max(history.frames, 1), 1.0)
    volume = math.prod(max(length, 0.01) for length in extent)
    cell = (PER_CELL * volume / active) ** (1 / 3)
    while steps * math.prod(_shape(extent, cell)) * 3 * history.positions.element_size() > MOST_BYTES:
        cell *= 1.05
    return cell
