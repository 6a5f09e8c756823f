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
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
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
    reached = _reached(*passable)
    padded = [np.pad(reached, [(int(a == axis),) * 2 for a in range(3)], constant_values=True) for axis in range(3)]
    # Air that reaches the cell before a passable face reaches the one behind it too.
    passed = [faces & np.delete(padded[axis], -1, axis) for axis, faces in enumerate(passable)]
    areas = [faces * (thickness if axis < 2 else 1.0) for axis, faces in enumerate(passed)]
    undisturbed = undisturbed_winds(shape, profile)
    fluxes = undisturbed[0] * passed[0], undisturbed[1] * passed[1], undisturbed[2] * passed[2]
    for along in range(2):
        winds = [values[along] for values in fluxes]
        potential, steps, residual = _potential(RESIDUAL, 10 * math.prod(shape), *(*areas, *winds))
        if not residual <= RESIDUAL:
            raise RuntimeError(f"the wind around obstacles is not solved to {RESIDUAL:g} m/s after {steps:,} iterations")
        for axis, wind in enumerate(winds):
            inner = tuple(slice(None) if a == axis else slice(1, -1) for a in range(3))
            wind += np.diff(potential[inner], axis=axis) * passed[axis]
    return fluxes, (passed[0], passed[1], passed[2])


@kernel()
def _reached(open_x, open_y, open_z):
    """Cells [x, y, z] that air from outside of the lattice reaches through passable faces."""
    nx, ny, nz = open_x.shape[0] - 1, open_y.shape[1] - 1, open_z.shape[2] - 1
    reached, queue, last = np.zeros((nx, ny, nz), np.bool_), np.empty(nx * ny * nz, np.int64), 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                enters = (i == 0 and open_x[0, j, k]) or (i == nx - 1 and open_x[nx, j, k])
                enters |= (j == 0 and open_y[i, 0, k]) or (j == ny - 1 and open_y[i, ny, k])
                enters |= (k == 0 and open_z[i, j, 0]) or (k == nz - 1 and open_z[i, j, nz])
                if enters:
                    reached[i, j, k] = True
                    queue[last] = (i * ny + j) * nz + k
                    last += 1
    first = 0
    while first < last:
        rest, k = divmod(queue[first], nz)
        i, j = divmod(rest, ny)
        first += 1
        for side in range(6):
            axis, ahead = side >> 1, side & 1
            x, y, z = i, j, k
            if axis == 0:
                passes, x = open_x[i + ahead, j, k], i + 2 * ahead - 1
            elif axis == 1:
                passes, y = open_y[i, j + ahead, k], j + 2 * ahead - 1
            else:
                passes, z = open_z[i, j, k + ahead], k + 2 * ahead - 1
            if passes and 0 <= x < nx and 0 <= y < ny and 0 <= z < nz and not reached[x, y, z]:
                reached[x, y, z] = True
                queue[last] = (x * ny + y) * nz + z
                last += 1
    return reached


@kernel(fastmath={"contract", "reassoc"})
def _potential(tolerance, most, area_x, area_y, area_z, wind_x, wind_y, wind_z):
    """Potential whose gradient takes the divergence of a wind away, by conjugate gradients (Hestenes & Stiefel 1952).

    They are preconditioned with the diagonal. The areas of faces that air does not pass are 0, and cells that it does not reach
    have potential 0.

    Returns:
        The potential of all cells and of one more around them, where it is 0, [x + 2, y + 2, z + 2]; the number of steps, and
        the norm of the divergence that is left.
    """
    nx, ny, nz = area_x.shape[0] - 1, area_y.shape[1] - 1, area_z.shape[2] - 1
    shape = (nx + 2, ny + 2, nz + 2)
    potential, ahead, image = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    rest, inverse = np.zeros(shape), np.zeros(shape)
    product, square = 0.0, 0.0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                total = area_x[i, j, k] + area_x[i + 1, j, k] + area_y[i, j, k] + area_y[i, j + 1, k]
                total += area_z[i, j, k] + area_z[i, j, k + 1]
                out = area_x[i + 1, j, k] * wind_x[i + 1, j, k] - area_x[i, j, k] * wind_x[i, j, k]
                out += area_y[i, j + 1, k] * wind_y[i, j + 1, k] - area_y[i, j, k] * wind_y[i, j, k]
                out += area_z[i, j, k + 1] * wind_z[i, j, k + 1] - area_z[i, j, k] * wind_z[i, j, k]
                if total > 0.0:
                    inverse[i + 1, j + 1, k + 1], rest[i + 1, j + 1, k + 1] = 1.0 / total, out
                    ahead[i + 1, j + 1, k + 1] = out / total
                    product += out * out / total
                    square += out * out
    steps = 0
    while math.sqrt(square) > tolerance and steps < most:
        steps += 1
        along = 0.0
        for i in range(nx):
            for j in range(ny):
                here, before, after = ahead[i + 1, j + 1], ahead[i, j + 1], ahead[i + 2, j + 1]
                left, right, made = ahead[i + 1, j], ahead[i + 1, j + 2], image[i + 1, j + 1]
                x0, x1, y0, y1, z = area_x[i, j], area_x[i + 1, j], area_y[i, j], area_y[i, j + 1], area_z[i, j]
                for k in range(nz):
                    own = here[k + 1]
                    value = x0[k] * (own - before[k + 1]) + x1[k] * (own - after[k + 1])
                    value += y0[k] * (own - left[k + 1]) + y1[k] * (own - right[k + 1])
                    value += z[k] * (own - here[k]) + z[k + 1] * (own - here[k + 2])
                    made[k + 1] = value
                    along += own * value
        share = product / along
        before_product, product, square = product, 0.0, 0.0
        flat_potential, flat_ahead, flat_image = potential.reshape(-1), ahead.reshape(-1), image.reshape(-1)
        flat_rest, flat_inverse = rest.reshape(-1), inverse.reshape(-1)
        for c in range(len(flat_rest)):
            flat_potential[c] += share * flat_ahead[c]
            left_over = flat_rest[c] - share * flat_image[c]
            flat_rest[c] = left_over
            product += left_over * left_over * flat_inverse[c]
            square += left_over * left_over
        turn = product / before_product
        for c in range(len(flat_rest)):
            flat_ahead[c] = flat_rest[c] * flat_inverse[c] + turn * flat_ahead[c]
    return potential, steps, math.sqrt(square)


def undisturbed_winds(shape: tuple[int, int, int], profile: Float[ndarray, " z"]) -> Faces:
    """Winds along x and along y that are uniform within each layer, [2, ...] m/s.

    Args:
        shape: cells of the lattice along each axis.
        profile: wind in each layer, m/s.
    """
    x, y, z = (np.zeros((2, *(n + (a == axis) for a, n in enumerate(shape)))) for axis in range(3))
    x[0], y[1] = profile, profile
    return x, y, z
