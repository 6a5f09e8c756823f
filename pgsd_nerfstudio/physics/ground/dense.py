"""The hand-over to the dense regime: sliding matter that fills the air around it moves as a whole, by the material point
method.

Each sliding particle stands for a volume of the layer (many real ones, and the time lapse of the cover). Where the volumes in a
cell of the grid add up to `Dense.solid_fraction` of it, its particles become material points; what comes to rest on something
is handed back and lies. The grid, Taichi and the obstacle's distances are made when the first particle needs them.
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
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

FRAMES = 3  # frames for which matter must be slow before it rests


class Moved(NamedTuple):
    """Dense particles after a step."""

    positions: Float[ndarray, "n 3"]
    velocities: Float[ndarray, "n 3"]
    rests: Bool[ndarray, " n"]
    left: Bool[ndarray, " n"]


class DenseMatter:
    """The material points of a run."""

    def __init__(self, dense: Dense, response: SurfaceResponse, surface: SurfaceMesh, domain: Domain) -> None:
        self.dense, self.response, self.surface, self.domain = dense, response, surface, domain
        self._mpm = None
        self._ids = np.zeros(0, np.int64)
        """Number of each of the run's dense bodies, in their order, within the solver."""

    def crowded(self, sliding: Bodies, volumes: Float[ndarray, " n"], dense: Bodies, filled: Float[ndarray, " d"]) -> ndarray:
        """Which sliders lie in cells that sliders and dense matter (`filled`: its volumes) fill enough."""
        if len(sliding) == 0:
            return np.zeros(0, bool)
        cells = np.floor(np.concatenate([sliding.positions, dense.positions]) / self.dense.cell).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        total = np.bincount(cell, np.concatenate([volumes, filled]))
        return total[cell[: len(sliding)]] >= self.dense.solid_fraction * self.dense.cell**3

    def add(self, bodies: Bodies, volumes: Float[ndarray, " n"]) -> None:
        """Hand particles over; they follow those that are there already."""
        ids = self._solver().emit(
            torch.from_numpy(bodies.positions.astype(np.float64)),
            torch.from_numpy(bodies.velocities.astype(np.float64)),
            self._matter(),
            torch.from_numpy(volumes.astype(np.float64)),
        )
        self._ids = np.concatenate([self._ids, ids.numpy()])

    def step(self, seconds: float) -> Moved:
        """Advance all of them; those that rest or left are forgotten by the next call."""
        from pgsd_nerfstudio.physics.mpm import REMOVED, RESTING

        solver = self._solver()
        solver.step(seconds)
        states = solver.states.numpy(force=True)[self._ids]
        positions, velocities = (rows.double().numpy(force=True)[self._ids] for rows in (solver.positions, solver.velocities))
        rests, left = states == RESTING, states == REMOVED
        self._ids = self._ids[~(rests | left)]
        return Moved(positions, velocities, rests, left)

    def snapshot(self) -> dict[str, ndarray]:
        """Its state as arrays; empty where there never was dense matter."""
        if self._mpm is None:
            return {}
        rows = {f"mpm.{name}": value.numpy(force=True).copy() for name, value in self._mpm.snapshot().items()}
        return rows | {"dense_ids": self._ids.copy()}

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """The state that `snapshot` gave."""
        if "dense_ids" not in arrays:
            self._mpm, self._ids = None, np.zeros(0, np.int64)
            return
        self._ids = arrays["dense_ids"].copy()
        rows = {name.removeprefix("mpm."): torch.from_numpy(v.copy()) for name, v in arrays.items() if name.startswith("mpm.")}
        self._solver().restore(rows)

    def _solver(self):
        if self._mpm is None:
            from pgsd_nerfstudio.physics.mpm import Mpm, MpmConfig, Obstacle, Sleep
            from pgsd_nerfstudio.surface.distance import DistanceGrid

            cell = self.dense.cell
            obstacle = None
            if len(self.surface.triangles):
                lower = np.asarray(self.domain.lower) - cell
                grid = DistanceGrid.of(self.surface, lower, np.asarray(self.domain.upper) + cell, cell)
                slopes = np.stack(np.gradient(grid.values.astype(np.float64), cell), -1)
                # Far from any surface distances are clamped and have no slope; nothing touches there.
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
