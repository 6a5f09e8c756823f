"""Dense matter: crowded sliders move together, by the material point method (`mpm`).

Each slider has a volume of layer (many real particles, and the time lapse of the cover). Where these volumes fill a share
`Dense.solid_fraction` of a cell of the grid, the cell's sliders become material points. A material point at rest lands. The
grid, Taichi and the distances to the surface are made when the first particle needs them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.effects.matter import Dense
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
from pgsd_nerfstudio.physics.bodies import Bodies, with_prefix, without_prefix
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MOST_CELLS = 12_000_000  # of the grid: 3 GB while it is made; larger domains get larger cells
FRAMES = 3  # frames for which matter must be slow before it is at rest
FEWEST = 30  # particles that move as a whole


class Moved(NamedTuple):
    """Dense particles after a step."""

    positions: Float[ndarray, "n 3"]
    """m."""
    velocities: Float[ndarray, "n 3"]
    """m/s."""
    rests: Bool[ndarray, " n"]
    """Particles that have come to rest."""
    left: Bool[ndarray, " n"]
    """Particles that have left the domain."""


class DenseMatter:
    """The material points of a run."""

    def __init__(self, dense: Dense, response: SurfaceResponse, surface: SurfaceMesh, domain: Domain) -> None:
        self.dense, self.response, self.surface, self.domain = dense, response, surface, domain
        self.cell = max(dense.cell, (domain.volume / MOST_CELLS) ** (1 / 3))
        """Spacing of the grid, m."""
        self._mpm = None
        self._ids = np.zeros(0, np.int64)
        """Index in the solver of each of the run's dense particles, in their order."""

    def crowded(self, sliding: Bodies, volumes: Float[ndarray, " n"], dense: Bodies, filled: Float[ndarray, " d"]) -> ndarray:
        """Which sliders are in cells that sliders and dense particles together fill enough, [n].

        Args:
            sliding: the sliders.
            volumes: layer of each slider, m^3.
            dense: the dense particles.
            filled: layer of each dense particle, m^3.
        """
        if len(sliding) == 0:
            return np.zeros(0, bool)
        cells = np.floor(np.concatenate([sliding.positions, dense.positions]) / self.cell).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        full = np.bincount(cell, np.concatenate([volumes, filled])) >= self.dense.solid_fraction * self.cell**3
        found = full[cell[: len(sliding)]]
        # A few flakes that stand for many real ones may fill a cell, but are no mass that moves as a whole.
        return found if found.sum() + len(dense) >= FEWEST else np.zeros_like(found)

    def add(self, bodies: Bodies, volumes: Float[ndarray, " n"]) -> None:
        """Add particles after the present ones.

        Args:
            bodies: the new dense particles.
            volumes: layer of each, m^3.
        """
        ids = self._solver().emit(
            torch.from_numpy(bodies.positions.astype(np.float64)),
            torch.from_numpy(bodies.velocities.astype(np.float64)),
            self._matter(),
            torch.from_numpy(volumes.astype(np.float64)),
        )
        self._ids = np.concatenate([self._ids, ids.numpy()])

    def step(self, seconds: float) -> Moved:
        """Advance all dense particles; those that rest or have left are not part of the next step."""
        from pgsd_nerfstudio.physics.mpm import REMOVED, RESTING

        solver = self._solver()
        solver.step(seconds)
        states = solver.states.numpy(force=True)[self._ids]
        positions, velocities = (rows.double().numpy(force=True)[self._ids] for rows in (solver.positions, solver.velocities))
        rests, left = states == RESTING, states == REMOVED
        self._ids = self._ids[~(rests | left)]
        return Moved(positions, velocities, rests, left)

    def snapshot(self) -> dict[str, ndarray]:
        """The state as arrays, for `restore`; empty where there never was dense matter."""
        if self._mpm is None:
            return {}
        rows = {name: value.numpy(force=True).copy() for name, value in self._mpm.snapshot().items()}
        return with_prefix("mpm.", rows) | {"dense_ids": self._ids.copy()}

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """Take a state from `snapshot`."""
        if "dense_ids" not in arrays:
            self._mpm, self._ids = None, np.zeros(0, np.int64)
            return
        self._ids = arrays["dense_ids"].copy()
        rows = without_prefix("mpm.", arrays)
        self._solver().restore({name: torch.from_numpy(value.copy()) for name, value in rows.items()})

    def _solver(self):
        if self._mpm is None:
            from pgsd_nerfstudio.physics.mpm import Mpm, MpmConfig, Obstacle, Sleep
            from pgsd_nerfstudio.surface.distance import DistanceGrid

            cell = self.cell
            obstacle = None
            if len(self.surface.triangles):
                lower = np.asarray(self.domain.lower) - cell
                grid = DistanceGrid.of(self.surface, lower, np.asarray(self.domain.upper) + cell, cell)
                slopes = np.stack(np.gradient(grid.values.astype(np.float64), cell), -1)
                # Far from any surface distances are clamped and have no slope; there are no contacts there.
                steep = np.linalg.norm(slopes, axis=-1, keepdims=True)
                normals = np.where(steep > 1e-6, slopes / steep.clip(1e-6), [0.0, 0.0, 1.0])
                corner = (float(grid.lower[0]), float(grid.lower[1]), float(grid.lower[2]))
                obstacle = Obstacle.from_grid(
                    torch.from_numpy(grid.values), torch.from_numpy(normals), corner, cell, self.dense.friction
                )
            sleep = Sleep(speed=self.dense.rests_below, frames=FRAMES)
            self._mpm = Mpm(MpmConfig(dx=cell, sleep=sleep), self.domain, obstacle)
        return self._mpm

    def _matter(self):
        from pgsd_nerfstudio.physics.mpm import Sand, Snow

        if self.dense.matter == "sand":
            return Sand(
                density=self.response.layer_density,
                youngs_modulus=self.dense.young,
                friction_degrees=self.response.repose_degrees,
            )
        return Snow(density=self.response.layer_density, youngs_modulus=self.dense.young)
