"""Mass-consistent flow of the wind around obstacles on a coarse lattice.

It is the flow nearest to the undisturbed wind u0 that has no divergence and passes through no obstacle (Sherman, "A
mass-consistent model for wind fields over complex terrain", 1978; QUIC-URB and WindNinja solve the same): u = u0 + grad lambda,
div u = 0, u . n = 0 on blocked faces and on the ground at z = 0, lambda = 0 on the sides and the top of the lattice. The flow
is linear in u0, so two solutions, for 1 m/s along x and along y, combine into every gust. The flow has no wake: the air is
equally slow before and behind a wall, and it is fast above and beside it.

A lattice face is blocked where the mesh cuts the line between the two cell centres: thin walls stop the air, closed bodies are
tight, and no inside has to be known. Cells that are closed off hold still air.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from numpy import ndarray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

CELL = 0.35  # m; smaller only where a side of the domain would otherwise have fewer than FEWEST cells
FEWEST = 4
MOST = 60_000  # cells; larger domains get larger cells
RESIDUAL = 1e-9  # of the divergence, m/s per cell
OVERLAP = 1e-4  # cells; lines reach that far beyond a centre, so that a wall through centres is not missed on both sides
BOTTOM = 0.75  # thickness of the lowest layer in cells, as `deflection` interpolates it

Faces = tuple[ndarray, ndarray, ndarray]
"""A value on every face across x, y and z: shapes [..., x+1, y, z], [..., x, y+1, z], [..., x, y, z+1]."""


class Lattice(NamedTuple):
    """Cubic cells that cover a domain, with one more cell on each side and above."""

    lower: Float[ndarray, "3"]
    """Corner of the first cell, m."""
    cell: float
    """Edge, m."""
    shape: tuple[int, int, int]
    grounded: bool
    """Whether the lowest faces are the ground; otherwise air passes through them."""

    @staticmethod
    def around(domain: Domain) -> Lattice:
        """The lattice of a domain.

        Raises:
            ValueError: the domain is not finite.
        """
        lower, upper = np.array(domain.lower), np.array(domain.upper)
        if not np.isfinite([lower, upper]).all():
            raise ValueError(f"wind can be deflected in a finite domain only, got {domain.lower} to {domain.upper} m")
        cell = min(CELL, min(domain.size) / FEWEST)
        while True:
            grounded = bool(lower[2] < cell)
            bottom = 0.0 if grounded else lower[2] - cell
            shape = (
                math.ceil(domain.size[0] / cell - 1e-6) + 2,
                math.ceil(domain.size[1] / cell - 1e-6) + 2,
                max(math.ceil((upper[2] - bottom) / cell - 1e-6), 1) + 1,
            )
            if math.prod(shape) <= MOST:
                break
            cell *= max((math.prod(shape) / MOST) ** (1 / 3), 1.01)
        corner = (lower + upper) / 2 - cell * np.array(shape) / 2
        return Lattice(np.array([corner[0], corner[1], bottom]), cell, shape, grounded)

    @property
    def heights(self) -> Float[ndarray, " z"]:
        """Height of the middle of each layer, m."""
        return self.lower[2] + self.cell * (np.arange(self.shape[2]) + 0.5)

    @property
    def thickness(self) -> Float[ndarray, " z"]:
        """Thickness of each layer, in cells."""
        return np.where((np.arange(self.shape[2]) == 0) & self.grounded, BOTTOM, 1.0)

    def face_centres(self, axis: int) -> Float[ndarray, "x y z 3"]:
        """Middle of every face across an axis, m.

        Args:
            axis: 0, 1 or 2.
        """
        middle = [np.arange(n + (a == axis)) + 0.5 * (a != axis) for a, n in enumerate(self.shape)]
        return self.lower + self.cell * np.stack(np.meshgrid(*middle, indexing="ij"), -1)


def open_faces(surface: SurfaceMesh, lattice: Lattice) -> Faces:
    """Whether air can pass each face: no triangle cuts the line between the cell centres, and the face is not the ground."""
    found = []
    for axis in range(3):
        step = lattice.cell * np.eye(3)[axis]
        start = lattice.face_centres(axis) - step / 2
        rays = torch.from_numpy(start.reshape(-1, 3)).float()
        # Only distances are needed; `SurfaceMesh.cast` also computes normals, which would take a hundred times as long.
        hits = surface.raycasting.cast_rays(queries(rays, torch.from_numpy(step).float().expand_as(rays)))
        found.append(hits["t_hit"].numpy().reshape(start.shape[:3]) > 1 + OVERLAP)
    if lattice.grounded:
        found[2][:, :, 0] = False
    return found[0], found[1], found[2]


def mass_consistent(passable: Faces, profile: Float[ndarray, " z"], thickness: Float[ndarray, " z"]) -> tuple[Faces, Faces]:
    """The flows without divergence that are nearest to undisturbed winds along x and along y.

    Args:
        passable: whether air can pass each face.
        profile: undisturbed wind in each layer, m/s.
        thickness: of each layer, in cells.

    Returns:
        The wind through every face, [2, ...] m/s, and the faces that it passes; faces of closed-off cells are not among them.

    Raises:
        RuntimeError: the conjugate gradients did not converge.
    """
    shape = passable[0].shape[0] - 1, passable[1].shape[1] - 1, passable[2].shape[2] - 1
    count = math.prod(shape)  # also the index of the one cell that represents all of the outside
    first, second = _cells_beside(shape)
    free = _flat(passable)
    joins = sparse.coo_array((np.ones(free.sum()), (first[free], second[free])), (count + 1, count + 1))
    labels = connected_components(joins, directed=False)[1]
    reached = labels == labels[count]
    free &= reached[first]

    rows = np.arange(free.sum())
    entries = np.repeat([-1.0, 1.0], len(rows)), (np.tile(rows, 2), np.concatenate([first[free], second[free]]))
    gradient = sparse.coo_array(entries, (len(rows), count + 1)).tocsc()[:, :count].tocsr()  # lambda is 0 outside
    area = _flat([np.broadcast_to(thickness if axis < 2 else 1.0, faces.shape) for axis, faces in enumerate(passable)])
    divergence = -(gradient.T @ sparse.diags_array(area[free])).tocsr()
    sealed = sparse.diags_array(np.where(reached[:count], 0.0, 1.0))
    laplacian = (sealed - divergence @ gradient).tocsr()
    preconditioner = sparse.diags_array(1 / laplacian.diagonal())
    undisturbed, fluxes = _flat(undisturbed_winds(shape, profile)), np.zeros((2, len(free)))
    for along in range(2):
        wind = undisturbed[along, free]
        potential, failed = cg(laplacian, divergence @ wind, rtol=0.0, atol=RESIDUAL, M=preconditioner)
        if failed:
            raise RuntimeError(f"the wind around obstacles is not solved to {RESIDUAL:g} m/s after {failed:,} iterations")
        fluxes[along, free] = wind + gradient @ potential
    return _faces(fluxes, passable), _faces(free, passable)


def _cells_beside(shape: tuple[int, int, int]) -> tuple[Int[ndarray, " f"], Int[ndarray, " f"]]:
    """Indices of the cells before and after every face; one more cell represents all of the outside."""
    count = math.prod(shape)
    cells = np.arange(count).reshape(shape)
    padded = [np.pad(cells, [(int(a == axis),) * 2 for a in range(3)], constant_values=count) for axis in range(3)]
    before, after = (_flat([np.delete(ids, last, axis) for axis, ids in enumerate(padded)]) for last in (-1, 0))
    return before, after


def undisturbed_winds(shape: tuple[int, int, int], profile: Float[ndarray, " z"]) -> Faces:
    """Winds along x and along y that are uniform within each layer, [2, ...] m/s.

    Args:
        shape: cells of the lattice along each axis.
        profile: wind in each layer, m/s.
    """
    x, y, z = (np.zeros((2, *(n + (a == axis) for a, n in enumerate(shape)))) for axis in range(3))
    x[0], y[1] = profile, profile
    return x, y, z


def _flat(faces: Sequence[ndarray]) -> Shaped[ndarray, "... f"]:
    """Values of all faces in one row."""
    return np.concatenate([values.reshape(*values.shape[:-3], -1) for values in faces], -1)


def _faces(flat: Shaped[ndarray, "... f"], like: Faces) -> Faces:
    """Values in one row put back onto faces of the shapes of `like`."""
    x, y, z = np.split(flat, np.cumsum([values.size for values in like])[:2], -1)
    lead = flat.shape[:-1]
    return x.reshape(*lead, *like[0].shape), y.reshape(*lead, *like[1].shape), z.reshape(*lead, *like[2].shape)
