"""Deflection of the wind by obstacles: the flow of `obstacle_flow` between the nodes of its lattice, and calm air at walls.

The difference to the undisturbed wind is stored as splines: each component is quadratic along its own axis and linear along the
others. The slope of a quadratic B-spline is the difference of two linear ones, so the divergence between the nodes is the
linear interpolation of the divergence of the cells: zero anywhere in the domain. Linear interpolation of velocities at cell
centres would leave some divergence in every cell, and snow would thin out and gather there. The drawback is that an eighth of
the normal wind one cell away remains right at a wall; the surface itself stops particles.

Turbulence is ramped down beside obstacles (Bridson, Hourihan & Nordenstam, "Curl-noise for procedural fluid flow", 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.typing import DTypeLike
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.air.obstacle_flow import Faces, Lattice, mass_consistent, open_faces, undisturbed_winds
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.boundary_layer import CALM, law_of_the_wall
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

PAD = 2  # nodes around the cells, on which splines fade out


@dataclass(frozen=True, eq=False)
class Deflection:
    """Change of the wind of a domain by obstacles; it is zero farther than a cell and a half outside of the lattice."""

    lattice: Lattice
    fluxes: Faces
    """Wind through every face, [2, ...] m/s for 1 m/s along x and along y at the reference height."""
    splines: Float[ndarray, "2 i j k 3"]
    """Coefficients of the difference to the undisturbed wind; node [i, j, k] has the lower faces of cell [i, j, k] - PAD."""
    ramp: Float[ndarray, "i j k"]
    """Share of the turbulence that is left at cell centres, 0 beside obstacles and 1 in free air; nodes as above."""

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain, wind: Wind) -> Deflection | None:
        """Deflection of a wind by a surface; None where the surface blocks no face.

        Args:
            surface: the obstacles, in metres.
            domain: the simulated air.
            wind: its roughness and reference height; its speed and direction do not matter.

        Raises:
            ValueError: the domain is not finite.
            RuntimeError: the flow could not be solved.
        """
        if len(surface.triangles) == 0:
            return None
        lattice = Lattice.around(domain)
        passable = open_faces(surface, lattice)
        between = (passable[0], passable[1], passable[2][:, :, 1:] if lattice.grounded else passable[2])
        if all(faces.all() for faces in between):
            return None
        profile = law_of_the_wall(lattice.heights, wind.roughness, wind.reference_height)
        return Deflection.around(lattice, passable, profile)

    @staticmethod
    def around(lattice: Lattice, passable: Faces, profile: Float[ndarray, " z"]) -> Deflection:
        """Deflection of a wind by given faces.

        Args:
            lattice: the cells.
            passable: whether air can pass each face.
            profile: undisturbed wind in each layer, m/s.

        Raises:
            RuntimeError: the flow could not be solved.
        """
        fluxes, passable = mass_consistent(passable, profile, lattice.thickness)
        return Deflection(lattice, fluxes, _splines(lattice, fluxes, profile), _ramp(lattice, passable))

    def velocity(self, points: Float[ndarray, "n 3"], wind: Float[ndarray, "2"]) -> Float[ndarray, "n 3"]:
        """Difference to the undisturbed wind in m/s.

        Args:
            points: m.
            wind: undisturbed wind along x and y at the reference height, m/s.
        """
        base, share = self._at(points)
        linear = np.stack([1 - share, share])
        square = np.stack([(1 - share) ** 2 / 2, 0.5 + share - share**2, share**2 / 2])
        velocity = np.empty((len(points), 3))
        for axis in range(3):
            x, y, z = ((square if a == axis else linear)[..., a] for a in range(3))
            found = self.splines[(slice(None), *_block(base, (len(x), len(y), len(z))), axis)]
            velocity[:, axis] = _weighted(wind[0] * found[0] + wind[1] * found[1], x, y, z)
        return velocity

    def shelter(self, points: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
        """Share of the turbulence that is left, 0-1, and its gradient in 1/m, which is continuous.

        Args:
            points: m.
        """
        base, share = self._at(points)
        smooth, slope = share**2 * (3 - 2 * share), 6 * share * (1 - share) / self.lattice.cell
        weights, slopes = np.stack([1 - smooth, smooth]), np.stack([-slope, slope])
        found = self.ramp[_block(base, (2, 2, 2))]
        gradient = np.empty((len(points), 3))
        for axis in range(3):
            x, y, z = ((slopes if a == axis else weights)[..., a] for a in range(3))
            gradient[:, axis] = _weighted(found, x, y, z)
        return _weighted(found, *np.moveaxis(weights, 2, 0)), gradient

    def _at(self, points: Float[ndarray, "n 3"]) -> tuple[Int[ndarray, "n 3"], Float[ndarray, "n 3"]]:
        """First of the 27 nodes around each point, and the fraction of the distance to the next. The last nodes are empty."""
        raised = np.column_stack([points[:, :2], points[:, 2].clip(0.0)])
        place = np.fmax((raised - self.first) / self.lattice.cell, 0.0)  # NaN goes to the first node
        place = np.minimum(place, np.array(self.ramp.shape) - 3.0)
        base = np.floor(place).astype(int)
        return base, place - base

    @property
    def first(self) -> Float[ndarray, "3"]:
        """Middle of the cell of the first node, m."""
        return self.lattice.lower - (PAD - 0.5) * self.lattice.cell

    @property
    def cell(self) -> float:
        """Distance between nodes, m."""
        return self.lattice.cell

    def nodes(self, wind: Float[ndarray, "2"], dtype: DTypeLike) -> tuple[ndarray, ndarray, ndarray]:
        """Arrays for the kernel of `airborne`.

        Args:
            wind: undisturbed wind along x and y at the reference height, m/s.
            dtype: of the first two arrays, float32 or float64.

        Returns:
            Spline coefficients for that wind [i, j, k, 3], the ramp [i, j, k], and whether the ramp is below 1 at any of the
            eight nodes from each node on [i, j, k].
        """
        splines, ramp, calmed = self._single if dtype == np.float32 else (self.splines, self.ramp, self._calmed)
        nodes = splines[0] * splines.dtype.type(wind[0])
        nodes += splines[1] * splines.dtype.type(wind[1])
        return nodes, ramp, calmed

    @cached_property
    def _calmed(self) -> Bool[ndarray, "i j k"]:
        return minimum_filter(self.ramp, 2, origin=-1, mode="nearest") < 1

    @cached_property
    def _single(self) -> tuple[ndarray, ndarray, ndarray]:
        return self.splines.astype(np.float32), self.ramp.astype(np.float32), self._calmed


def _block(base: Int[ndarray, "n 3"], size: tuple[int, int, int]) -> tuple[ndarray, ndarray, ndarray]:
    """Indices into arrays [i, j, k] of the `size` nodes from each `base` on; they select an array [n, *size]."""
    x, y, z = (base[:, axis, None] + np.arange(size[axis]) for axis in range(3))
    return x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]


def _weighted(
    found: Float[ndarray, "n a b c"], x: Float[ndarray, "a n"], y: Float[ndarray, "b n"], z: Float[ndarray, "c n"]
) -> Float[ndarray, " n"]:
    """Sums over the nodes around each point, weighted along each axis."""
    columns = (found * z.T[:, None, None]).sum(3)
    return ((columns * y.T[:, None]).sum(2) * x.T).sum(1)


def _splines(lattice: Lattice, fluxes: Faces, profile: Float[ndarray, " z"]) -> Float[ndarray, "2 i j k 3"]:
    """Coefficients of the difference to the undisturbed wind.

    The difference vanishes on the ground. Horizontal components are reflected there with the opposite sign, so that the hat
    function of the lowest layer falls from its middle to 0 on the ground; the vertical component is that of the layer above
    times (z / cell)^2 4/3. The hat function has the area of 3/4 of a cell, which is why the lowest layer counts as that thick.
    """
    nodes = np.zeros((2, *(n + 2 * PAD + 2 for n in lattice.shape), 3))
    for axis, (wind, before) in enumerate(zip(fluxes, undisturbed_winds(lattice.shape, profile), strict=True)):
        window = tuple(slice(PAD, PAD + n) for n in wind.shape[1:])
        nodes[(slice(None), *window, axis)] = wind - before
    if lattice.grounded:
        below, lowest, above = (nodes[:, :, :, PAD + k] for k in (-1, 0, 1))
        below[..., :2] = -lowest[..., :2]
        below[..., 2], lowest[..., 2] = above[..., 2], -above[..., 2] / 3
    return nodes


def _ramp(lattice: Lattice, passable: Faces) -> Float[ndarray, "i j k"]:
    """Share of the turbulence at cell centres: 0 half a cell from blocked faces, 1 another CALM away (ramp of Bridson 2007)."""
    walls = [lattice.face_centres(axis)[~faces] for axis, faces in enumerate(passable)]
    if lattice.grounded:
        walls[2] = walls[2][walls[2][:, 2] > 0]  # `calming` already accounts for the ground
    lower, upper = lattice.face_centres(0)[:-1], lattice.face_centres(0)[1:]
    distance, _ = KDTree(np.concatenate(walls)).query((lower + upper) / 2)
    share = ((distance - lattice.cell / 2) / CALM).clip(0.0, 1.0)
    nodes = np.ones([n + 2 * PAD + 2 for n in lattice.shape])
    inner = tuple(slice(PAD, PAD + n) for n in lattice.shape)
    nodes[inner] = share * (15 - share**2 * (10 - 3 * share**2)) / 8
    nodes[:, :, :PAD] = nodes[:, :, PAD : PAD + 1]
    return nodes
