"""Points on the triangles of a surface within a box, handed out in pieces whose memory does not depend on the surface.

The points of a triangle are a lattice in its barycentric coordinates. Squares of that lattice are divided into quarters, and
those outside the box are dropped before any of their points is made. A triangle of a kilometre through a room therefore costs
as much as its part in the room.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.surface.mesh import SurfaceMesh

BLOCK = 16  # steps along a side of the squares that are not divided further
MOST_POINTS = 500_000  # of a piece: 12 MB


def points_within(
    surface: SurfaceMesh, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], spacing: float
) -> Iterator[Float[ndarray, "s 3"]]:
    """Points so dense that every point of a triangle in the box has one within `spacing`; some lie outside of the box.

    Args:
        surface: the mesh, in metres.
        lower: corner of the box, m.
        upper: opposite corner of the box, m.
        spacing: m.
    """
    vertices = surface.vertices.numpy(force=True).astype(np.float64)
    corners = vertices[surface.triangles.numpy(force=True)]
    corners = corners[_meets(corners, lower, upper)]
    edges = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1) if len(corners) else np.zeros(0)
    # Triangles of similar size are sampled together, so that a large triangle does not refine the small ones.
    steps = 2 ** np.ceil(np.log2(np.maximum(edges / spacing, 1.0))).astype(int)
    for count in np.unique(steps):
        yield from _of_equal_steps(corners[steps == count], int(count), lower, upper)


def _of_equal_steps(
    corners: Float[ndarray, "f 3 3"], count: int, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]
) -> Iterator[Float[ndarray, "s 3"]]:
    """The points of triangles whose edges are divided into `count` steps."""
    whole = np.zeros((len(corners), 3), np.int64)
    whole[:, 0] = np.arange(len(corners))
    waiting = [(whole, count)]  # squares as rows (triangle, first step along each side), and their steps along a side
    while waiting:
        squares, size = waiting.pop()
        most = max(1, MOST_POINTS // (min(size, BLOCK) + 1) ** 2)
        if len(squares) > most:
            waiting += [(squares[most:], size), (squares[:most], size)]
            continue
        if size < count:
            squares = squares[squares[:, 1] + squares[:, 2] <= count]
            ends = np.array([[0, 0], [size, 0], [0, size], [size, size]])
            squares = squares[_meets(_places(corners, squares, ends, count), lower, upper)]
        if len(squares) == 0:
            continue
        if size > BLOCK:
            half = size // 2
            quarters = np.array([[0, 0, 0], [0, half, 0], [0, 0, half], [0, half, half]])
            waiting.append(((squares[:, None] + quarters).reshape(-1, 3), half))
            continue
        lattice = np.stack(np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij"), -1).reshape(-1, 2)
        on_triangle = (squares[:, None, 1:] + lattice).sum(2) <= count
        yield _places(corners, squares, lattice, count)[on_triangle]


def _places(
    corners: Float[ndarray, "f 3 3"], squares: Int[ndarray, "q 3"], lattice: Int[ndarray, "p 2"], count: int
) -> Float[ndarray, "q p 3"]:
    """Points of a lattice in every square, metres."""
    first, second, third = np.moveaxis(corners[squares[:, 0], None], 2, 0)
    u, v = np.moveaxis((squares[:, None, 1:] + lattice) / count, 2, 0)[..., None]
    return (1 - u - v) * first + u * second + v * third


def _meets(points: Float[ndarray, "n p 3"], lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]) -> ndarray:
    """Whether the box around the points of each row meets a box, [n]."""
    return ((points.min(1) <= upper) & (points.max(1) >= lower)).all(1)
