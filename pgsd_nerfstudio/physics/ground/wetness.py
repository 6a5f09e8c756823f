"""Wetness of surfaces: a grid around them takes the water of drops, which spreads and dries.

Only cells near the surface exist (the paper: "a coarse 3D grid surrounding the mesh"). They are one list of cells and a sparse
matrix of neighbours, so memory follows the area of the surface and not the volume of the air: about 110 bytes a cell. Water
diffuses between cells by the heat equation on that graph, dw/dt = (D / h^2) sum over neighbours (w_j - w_i); none of it leaves
the cells. A step of any length is the exact exponential: inside the band the water of a point becomes the discrete Gaussian
(Lindeberg 1990) whose variance is 2 D t along each axis. Drying takes the same share from all cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import csr_array

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.sampling import points_within
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_CELLS = 20_000_000  # 2.2 GB
_TAIL = 1e-13  # share of a cell's water that a step may move too short a distance


@dataclass(frozen=True, kw_only=True)
class Wetting:
    """How water spreads and dries."""

    cell: float = 0.05
    """Edge of a cell in metres; finer wet patches are not resolved."""
    reach: int = 2
    """Cells on each side of the surface that can hold water: one for interpolation, one to spread around edges."""
    diffusivity: float = 2e-5
    """m^2/s; a spot of water grows to a standard deviation of 5 cm within a minute."""
    drying_seconds: float = 120.0
    """Seconds in which a surface loses 63 % of its water; inf: it never dries."""

    def __post_init__(self) -> None:
        if not (self.cell > 0 and self.reach >= 1 and self.diffusivity >= 0 and self.drying_seconds > 0):
            given = f"{self.cell:g} m, {self.reach}, {self.diffusivity:g} m^2/s and {self.drying_seconds:g} s"
            raise ValueError(f"wetting needs cell > 0, reach >= 1, diffusivity >= 0 and drying_seconds > 0, got {given}")


class WetnessGrid:
    """Water in the cells near a surface. Each cell is centred on a lattice point, whose index is its key."""

    def __init__(
        self,
        points: Iterable[Float[ndarray, "p 3"]],
        lower: Float[ndarray, "3"],
        shape: tuple[int, int, int],
        wetting: Wetting,
    ):
        """Make the cells within `Wetting.reach` of the surface.

        Args:
            points: points that cover the surface, in pieces, m.
            lower: first point of the lattice, m.
            shape: lattice points along each axis.
            wetting: cell size and laws of spreading and drying.

        Raises:
            ValueError: there would be more than 20 million cells.
        """
        self.wetting = wetting
        self.lower = np.asarray(lower, np.float64)
        self.shape = shape
        self.keys: Int[ndarray, " c"] = self._near(points)
        self.water: Float[ndarray, " c"] = np.zeros(len(self.keys))  # kg
        self.deposited = 0.0  # kg so far
        self.evaporated = 0.0  # kg so far

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, wetting: Wetting | None = None) -> WetnessGrid:
        """The cells around a surface.

        Args:
            surface: the mesh, in metres.
            domain: bounds the cells.
            wetting: cell size and laws of spreading and drying; None: the defaults.

        Raises:
            ValueError: there would be more than 20 million cells.
        """
        wetting = wetting or Wetting()
        x, y, z = (math.ceil(edge / wetting.cell) + 1 for edge in domain.size)
        lower, room = np.asarray(domain.lower, float), wetting.cell * (wetting.reach + 1)
        upper = lower + wetting.cell * np.array([x, y, z])
        points = points_within(surface, lower - room, upper + room, wetting.cell / 2)
        return WetnessGrid(points, lower, (x, y, z), wetting)

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def held(self) -> float:
        """Water in the grid, kg; deposited = held + evaporated."""
        return float(self.water.sum())

    @property
    def centres(self) -> Float[ndarray, "c 3"]:
        """Lattice points of the cells, metres."""
        return self.lower + self.wetting.cell * np.stack(np.unravel_index(self.keys, self.shape), 1)

    @property
    def bytes(self) -> int:
        """Memory of the grid in bytes."""
        matrix = self._mixing
        return sum(part.nbytes for part in (self.keys, self.water, matrix.data, matrix.indices, matrix.indptr))

    def deposit(self, points: Float[ndarray, "n 3"], mass: Float[ndarray, " n"]) -> float:
        """Add water at points, shared among the existing ones of the eight lattice points around each, with trilinear weights.

        Args:
            points: m.
            mass: kg at each point.

        Returns:
            The kg of points without any lattice point around them, which are not added.
        """
        cells, weights = self._corners(points)
        total = weights.sum(1)
        caught = total > 0
        share = weights[caught] / total[caught, None] * np.asarray(mass, np.float64)[caught, None]
        np.add.at(self.water, cells[caught], share)
        self.deposited += float(share.sum())
        return float(np.asarray(mass, np.float64)[~caught].sum())

    def step(self, seconds: float) -> None:
        """Let water spread and dry; the step is exact for any length of time."""
        self._spread(seconds)
        before = self.held
        self.water *= math.exp(-seconds / self.wetting.drying_seconds)
        self.evaporated += before - self.held

    def sample(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Water in kg/m^3, interpolated between the existing lattice points; 0 where there are none.

        Args:
            points: m.
        """
        cells, weights = self._corners(points)
        found = (weights * self.water[cells]).sum(1) if len(self) else np.zeros(len(points))
        return found / weights.sum(1).clip(1e-12) / self.wetting.cell**3

    def _spread(self, seconds: float) -> None:
        """exp(t L) by uniformisation (Jensen 1953): a Poisson-weighted mean of powers of a stochastic matrix.

        All terms are positive and their weights sum to one, so that water neither becomes negative nor is lost.
        """
        rate = 6 * self.wetting.diffusivity / self.wetting.cell**2 * seconds  # mean number of mixings
        if rate == 0 or len(self) == 0:
            return
        pieces = math.ceil(rate / 50.0)  # exp(-rate) must not underflow
        rate /= pieces
        for _ in range(pieces):
            weight, left = math.exp(-rate), 1.0
            term, total = self.water, np.zeros_like(self.water)
            order = 0
            while True:
                last = order > rate and left - weight < _TAIL
                total += (left if last else weight) * term
                if last:
                    break
                left -= weight
                order += 1
                weight *= rate / order
                term = self._mixing @ term
            self.water = total

    @cached_property
    def _mixing(self) -> csr_array:
        """1 + L / 6: every cell gives a sixth of its water to each existing neighbour and keeps the rest."""
        at = np.stack(np.unravel_index(self.keys, self.shape), 1)
        rows, columns = [], []
        for axis in range(3):
            inside = (at[:, axis] + 1 < self.shape[axis]).nonzero()[0]
            stride = int(np.prod(self.shape[axis + 1 :]))
            other, exists = self._find(self.keys[inside] + stride)
            rows += [inside[exists], other[exists]]
            columns += [other[exists], inside[exists]]
        row, column = np.concatenate(rows).astype(np.int32), np.concatenate(columns).astype(np.int32)
        count = len(self)
        keep = 1.0 - np.bincount(row, minlength=count) / 6.0
        own = np.arange(count, dtype=np.int32)
        data = np.concatenate([np.full(len(row), 1 / 6), keep])
        return csr_array((data, (np.concatenate([row, own]), np.concatenate([column, own]))), shape=(count, count))

    def _corners(self, points: Float[ndarray, "n 3"]) -> tuple[Int[ndarray, "n 8"], Float[ndarray, "n 8"]]:
        """Indices of the cells at the eight lattice points around each point, and their weights, 0 where there is no cell."""
        at = (np.asarray(points, np.float64) - self.lower) / self.wetting.cell
        at = np.where(np.isfinite(at), at, -2.0)
        corner = np.floor(at)
        share = at - corner
        cells, weights = [], []
        for offset in np.ndindex(2, 2, 2):
            lattice = corner + offset
            inside = np.all((lattice >= 0) & (lattice < self.shape), axis=1)
            at_edge = tuple(np.where(inside[:, None], lattice, 0).astype(np.int64).T)
            key = np.asarray(np.ravel_multi_index(at_edge, self.shape))
            cell, exists = self._find(key)
            cells.append(cell)
            weights.append(np.where(exists & inside, np.where(offset, share, 1 - share).prod(1), 0.0))
        return np.stack(cells, 1), np.stack(weights, 1)

    def _find(self, keys: Int[ndarray, " n"]) -> tuple[Int[ndarray, " n"], ndarray]:
        """Index of each key among the cells, and whether it is one of them."""
        if len(self) == 0:
            return np.zeros(len(keys), np.int64), np.zeros(len(keys), bool)
        found = np.searchsorted(self.keys, keys).clip(max=len(self) - 1)
        return found, self.keys[found] == keys

    def _near(self, points: Iterable[Float[ndarray, "p 3"]]) -> Int[ndarray, " c"]:
        """Sorted keys of the lattice points within `reach` cells of the points along every axis."""
        # Points up to `reach` outside of the lattice also make cells inside. Keys are one number each, since sorting rows of
        # three takes far longer.
        reach, wide = self.wetting.reach, tuple(side + 2 * self.wetting.reach for side in self.shape)
        keys = np.zeros(0, np.int64)
        for piece in points:
            at = np.rint((piece - self.lower) / self.wetting.cell).astype(np.int64) + reach
            at = at[((at >= 0) & (at < wide)).all(1)]
            keys = np.union1d(keys, np.ravel_multi_index(tuple(at.T), wide))
        steps = np.arange(-reach, reach + 1)
        for axis in range(3):  # grow a cube axis by axis
            self._require_room(len(keys))
            stride = math.prod(wide[axis + 1 :])
            place = keys // stride % wide[axis]
            moved = [keys[(place + step >= 0) & (place + step < wide[axis])] + step * stride for step in steps]
            keys = np.unique(np.concatenate(moved))
        at = np.stack(np.unravel_index(keys, wide), 1) - reach
        at = at[((at >= 0) & (at < self.shape)).all(1)]
        self._require_room(len(at))
        return np.sort(np.ravel_multi_index(tuple(at.T), self.shape))

    def _require_room(self, cells: int) -> None:
        if cells > MAX_CELLS:
            edge = self.wetting.cell
            raise ValueError(f"wetness needs at most {MAX_CELLS:,} cells, {edge:g} m make {cells:,}; take larger cells")
