"""Wetness of surfaces: a grid around them takes the water of drops, which spreads and dries.

Only cells near the surface exist (the paper: "a coarse 3D grid surrounding the mesh"). They are one list of cells with their
neighbours, so memory follows the area of the surface and not the volume of the air: about 50 bytes a cell, and a byte for every
point of the lattice while the list is made. Water
diffuses between cells by the heat equation on that graph, dw/dt = (D / h^2) sum over neighbours (w_j - w_i); none of it leaves
the cells. A step of any length is the exact exponential: inside the band the water of a point becomes the discrete Gaussian
(Lindeberg 1990) whose variance is 2 D t along each axis. Drying takes the same share from all cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.clearance import occupied_cells
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

MAX_CELLS = 20_000_000  # 1 GB
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
        occupied: Bool[ndarray, "x y z"],
        lower: Float[ndarray, "3"],
        wetting: Wetting,
    ):
        """Make the cells within `Wetting.reach` of occupied ones.

        Args:
            occupied: cells in which the surface lies, with `Wetting.reach` more of them on each side of the lattice.
            lower: first point of the lattice, m.
            wetting: cell size and laws of spreading and drying.

        Raises:
            ValueError: there would be more than 20 million cells.
        """
        self.wetting = wetting
        self.lower = np.asarray(lower, np.float64)
        x, y, z = (side - 2 * wetting.reach for side in occupied.shape)
        self.shape = x, y, z
        near = np.zeros(self.shape, np.bool_)
        count = _grow(occupied, near, wetting.reach)
        if count > MAX_CELLS:
            edge = wetting.cell
            raise ValueError(f"wetness needs at most {MAX_CELLS:,} cells, {edge:g} m make {count:,}; take larger cells")
        self.keys: Int[ndarray, " c"] = near.ravel().nonzero()[0]
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
        x, y, z = (math.ceil(edge / wetting.cell) + 1 + 2 * wetting.reach for edge in domain.size)
        lower = np.asarray(domain.lower, float)
        corner = lower - wetting.cell * (wetting.reach + 0.5)  # a cell is centred on its lattice point
        return WetnessGrid(occupied_cells(surface, corner, wetting.cell, (x, y, z)), lower, wetting)

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
        return sum(part.nbytes for part in (self.keys, self.water, self._columns, self._neighbours))

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
        _add(self.water, cells[caught], share)
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
                term = _mixed(term, self._neighbours)
            self.water = total

    @cached_property
    def _columns(self) -> Int[ndarray, " k"]:
        """First cell of every column of the lattice; keys run up each column in turn."""
        columns = np.arange(self.shape[0] * self.shape[1] + 1) * self.shape[2]
        return np.searchsorted(self.keys, columns).astype(np.int32)

    @cached_property
    def _neighbours(self) -> Int[ndarray, "c 6"]:
        """The six neighbours of each cell; where one does not exist, the cell itself, which keeps that share."""
        return _beside(self.keys, self._columns, self.shape)

    def _corners(self, points: Float[ndarray, "n 3"]) -> tuple[Int[ndarray, "n 8"], Float[ndarray, "n 8"]]:
        """Indices of the cells at the eight lattice points around each point, and their weights, 0 where there is no cell."""
        at = (np.asarray(points, np.float64) - self.lower) / self.wetting.cell
        return _corners_of(at, self.keys, self._columns, self.shape)


@kernel()
def _grow(occupied, near, reach):
    """Mark the cells within `reach` of occupied ones along every axis, which has as many more of them on each side.

    Returns their number.
    """
    nx, ny, nz = near.shape
    along_z = np.zeros((nx + 2 * reach, ny + 2 * reach, nz), np.bool_)
    for x in range(nx + 2 * reach):
        for y in range(ny + 2 * reach):
            seen = -1  # cells after the last occupied one that still are near it
            for z in range(-2 * reach, nz):
                if occupied[x, y, z + 2 * reach]:
                    seen = 2 * reach
                if z >= 0:
                    along_z[x, y, z] = seen >= 0
                seen -= 1
    count = 0
    for x in range(nx):
        for y in range(ny):
            for i in range(x, x + 2 * reach + 1):
                for j in range(y, y + 2 * reach + 1):
                    own, other = near[x, y], along_z[i, j]
                    for z in range(nz):
                        own[z] |= other[z]
            for z in range(nz):
                count += near[x, y, z]
    return count


@kernel(inline="always")
def _lowest(keys, columns, shape, x, y, z):
    """First cell of a column that is not below z; it may be one of the next column."""
    column = x * shape[1] + y
    low, high, key = columns[column], columns[column + 1], column * shape[2] + z
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@kernel()
def _beside(keys, columns, shape):
    nx, ny, nz = shape
    found = np.empty((len(keys), 6), np.int32)
    for c in range(len(keys)):
        z, column = keys[c] % nz, keys[c] // nz
        x, y = column // ny, column % ny
        found[c, :] = c
        if z > 0 and c > 0 and keys[c - 1] == keys[c] - 1:
            found[c, 0] = c - 1
        if z + 1 < nz and c + 1 < len(keys) and keys[c + 1] == keys[c] + 1:
            found[c, 1] = c + 1
        n = 2
        for i, j in ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
            if i >= 0 and j >= 0 and i < nx and j < ny:
                other = _lowest(keys, columns, shape, i, j, z)
                if other < len(keys) and keys[other] == (i * ny + j) * nz + z:
                    found[c, n] = other
            n += 1
    return found


@kernel()
def _add(water, cells, share):
    for n in range(len(cells)):
        for corner in range(8):
            water[cells[n, corner]] += share[n, corner]


@kernel()
def _mixed(water, neighbours):
    """Every cell gives a sixth of its water to each existing neighbour and keeps the rest."""
    mixed = np.empty_like(water)
    for c in range(len(water)):
        total = 0.0
        for n in range(6):
            total += water[neighbours[c, n]]
        mixed[c] = total / 6
    return mixed


@kernel()
def _corners_of(at, keys, columns, shape):
    nx, ny, nz = shape
    cells, weights = np.zeros((len(at), 8), np.int64), np.zeros((len(at), 8))
    for n in range(len(at)):
        if not (at[n, 0] > -1 and at[n, 1] > -1 and at[n, 2] > -1 and at[n, 0] < nx and at[n, 1] < ny and at[n, 2] < nz):
            continue
        x, y, z = math.floor(at[n, 0]), math.floor(at[n, 1]), math.floor(at[n, 2])
        share_x, share_y, share_z = at[n, 0] - x, at[n, 1] - y, at[n, 2] - z
        for i in range(2):
            for j in range(2):
                if x + i < 0 or y + j < 0 or x + i >= nx or y + j >= ny:
                    continue
                flat = (share_x if i else 1 - share_x) * (share_y if j else 1 - share_y)
                cell = _lowest(keys, columns, shape, x + i, y + j, max(z, 0))
                for k in range(2):
                    key = ((x + i) * ny + y + j) * nz + z + k
                    if z + k >= 0 and z + k < nz and cell < len(keys) and keys[cell] == key:
                        cells[n, 4 * i + 2 * j + k] = cell
                        weights[n, 4 * i + 2 * j + k] = flat * (share_z if k else 1 - share_z)
                        cell += 1
    return cells, weights
