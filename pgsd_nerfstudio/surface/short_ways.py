"""Kernels for short ways and near points among the triangles of `triangle_cells`; other kernels call them for a particle each.

A `grid` is the tuple of numbers that `grid_of` makes. The arrays of the cells are passed one by one, since a kernel that takes
them out of a tuple counts references to them each time, which takes longer than a short way; those of triangles, vertices and
normals are one list of numbers each. Away from the surface a way is followed in steps as long as the clearance where it is
("sphere tracing", Hart 1996), near it from cell to cell. Triangles are met as in Moeller & Trumbore, "Fast, minimum storage
ray-triangle intersection" (1997), but grow by a hundred-thousandth beyond their edges, so that no way slips through between two
of them. Nearest points are those of Ericson, "Real-time collision detection" (2005, 5.1.5).
"""

from __future__ import annotations

import math

import numpy as np

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.surface.clearance import PARTS, ROOM
from pgsd_nerfstudio.surface.smooth_normals import LEAST
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

GROWN = 1e-5  # share of a triangle's edges by which it is met beyond them
TINY = 1e-12  # m


def grid_of(cells: TriangleCells) -> tuple[np.floating | np.unsignedinteger, ...]:
    """Corner of the first cell in cells, cells per metre, and numbers of cells along each axis.

    Args:
        cells: the triangles.
    """
    where = cells.clearance
    low, counts = (where.lower / where.cell).astype(np.float32), np.array(where.parts.shape, np.uint64)
    return (low[0], low[1], low[2], np.float32(1 / where.cell), counts[0], counts[1], counts[2])


@kernel(inline="always")
def corners_of(triangles, f):
    """Where the three corners of triangle f begin in the list of all vertices' coordinates; unsigned indices spare checks."""
    at = np.uint64(3) * np.uint64(f)
    a, b, c = triangles[at], triangles[at + np.uint64(1)], triangles[at + np.uint64(2)]
    return np.uint64(3) * np.uint64(a), np.uint64(3) * np.uint64(b), np.uint64(3) * np.uint64(c)


@kernel(inline="always")
def difference(vertices, a, b):
    """Vector from one vertex to another; both as of `corners_of`."""
    one, two = np.uint64(1), np.uint64(2)
    return vertices[b] - vertices[a], vertices[b + one] - vertices[a + one], vertices[b + two] - vertices[a + two]


@kernel(inline="always")
def met(vertices, a, b, c, x, y, z, dx, dy, dz):
    """Where the line x + t d meets a triangle: t, inf where it does not, and the weights of the second and third corner."""
    bx, by, bz = difference(vertices, a, b)
    cx, cy, cz = difference(vertices, a, c)
    px, py, pz = dy * cz - dz * cy, dz * cx - dx * cz, dx * cy - dy * cx
    sx, sy, sz = x - vertices[a], y - vertices[a + np.uint64(1)], z - vertices[a + np.uint64(2)]
    qx, qy, qz = sy * bz - sz * by, sz * bx - sx * bz, sx * by - sy * bx
    area = bx * px + by * py + bz * pz
    u, v, t = sx * px + sy * py + sz * pz, dx * qx + dy * qy + dz * qz, cx * qx + cy * qy + cz * qz
    if area < 0:
        area, u, v, t = -area, -u, -v, -t
    room = area * GROWN
    if u >= -room and v >= -room and u + v <= area + room and t >= 0 and area > 0:
        return t / area, u / area, v / area
    return np.inf, u, v


@kernel(inline="always")
def first_met(x, y, z, dx, dy, dz, reach, grid, parts, first, members, triangles, vertices):
    """First triangle on the way x + t d up to t = `reach` metres; d is a unit vector.

    Returns:
        t in metres, the triangle, and the weights of its second and third corner; the triangle is -1 where there is none.
    """
    low_x, low_y, low_z, inverse, nx, ny, nz = grid
    ox, oy, oz = x * inverse - low_x, y * inverse - low_y, z * inverse - low_z
    # Ways to the faces of cells: face - o, times these; along an axis that the way hardly changes they are far.
    wx, wy, wz = (
        1.0 / (dx if abs(dx) > TINY else TINY),
        1.0 / (dy if abs(dy) > TINY else TINY),
        1.0 / (dz if abs(dz) > TINY else TINY),
    )
    ahead_x, ahead_y, ahead_z = 1.0 if dx > 0.0 else 0.0, 1.0 if dy > 0.0 else 0.0, 1.0 if dz > 0.0 else 0.0
    best, which, best_u, best_v = np.inf, -1, 0.0, 0.0
    t, far = 0.0, reach * inverse
    while t <= far:
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        if not (px >= 1.0 and py >= 1.0 and pz >= 1.0 and px < nx - 1.0 and py < ny - 1.0 and pz < nz - 1.0):
            break
        at = (np.uint64(px) * ny + np.uint64(py)) * nz + np.uint64(pz)
        if parts[at] > 0:
            t += parts[at] * (1.0 / PARTS)
            continue
        for n in range(first[at], first[at + np.uint64(1)]):
            f = members[np.uint64(n)]
            a, b, c = corners_of(triangles, f)
            found, u, v = met(vertices, a, b, c, x, y, z, dx, dy, dz)
            if found < best:
                best, which, best_u, best_v = found, f, u, v
                far = min(far, best * inverse)
        exit_x, exit_y = (np.floor(px) + ahead_x - ox) * wx, (np.floor(py) + ahead_y - oy) * wy
        t = max(min(exit_x, exit_y, (np.floor(pz) + ahead_z - oz) * wz), t) + 0.5 * ROOM
    if not best <= reach:
        which = -1
    return best, which, best_u, best_v


@kernel(inline="always")
def _near_triangle(vertices, a, b, c, x, y, z):
    """Weights of the second and third corner at the point of a triangle that is nearest to a point, and its square distance."""
    px, py, pz = x - vertices[a], y - vertices[a + np.uint64(1)], z - vertices[a + np.uint64(2)]
    ux, uy, uz = difference(vertices, a, b)
    vx, vy, vz = difference(vertices, a, c)
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        u, v = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        u, v = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        u, v = d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        u, v = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        u, v = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        v = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-30)
        u = 1.0 - v
    else:
        inverse = 1.0 / (va + vb + vc)
        u, v = vb * inverse, vc * inverse
    rx, ry, rz = px - u * ux - v * vx, py - u * uy - v * vy, pz - u * uz - v * vz
    return u, v, rx * rx + ry * ry + rz * rz


@kernel(inline="always")
def nearest(x, y, z, reach, grid, first, members, triangles, vertices):
    """Nearest triangle to a point within `reach` metres.

    Returns:
        The distance in metres, the triangle, and the weights of its second and third corner at the nearest point; the triangle
        is -1 where there is none.
    """
    low_x, low_y, low_z, inverse, nx, ny, nz = grid
    ox, oy, oz = x * inverse - low_x, y * inverse - low_y, z * inverse - low_z
    square, which, best_u, best_v = reach * reach, -1, 0.0, 0.0
    far = square * inverse * inverse
    if ox >= 0.0 and oy >= 0.0 and oz >= 0.0 and ox < nx and oy < ny and oz < nz:
        # First among the triangles of the point's own cell, then of those around it that may have nearer ones.
        ci, cj, ck = int(ox), int(oy), int(oz)
        inner = min(ox - ci, 1.0 - ox + ci, oy - cj, 1.0 - oy + cj, oz - ck, 1.0 - oz + ck)
        for ring in range(int(reach * inverse) + 2):
            if ring > 0 and (ring - 1 + inner) ** 2 > far:  # all that lies in the ring is at least so far
                break
            for i in range(max(ci - ring, 0), min(ci + ring + 1, int(nx))):
                gap_x = max(i - ox, ox - i - 1.0, 0.0)
                for j in range(max(cj - ring, 0), min(cj + ring + 1, int(ny))):
                    gap_y = max(j - oy, oy - j - 1.0, 0.0)
                    whole = abs(i - ci) == ring or abs(j - cj) == ring
                    for k in range(ck - ring, ck + ring + 1, 1 if whole else 2 * ring):
                        gap_z = max(k - oz, oz - k - 1.0, 0.0)
                        if k < 0 or k >= int(nz) or gap_x * gap_x + gap_y * gap_y + gap_z * gap_z > far:
                            continue
                        at = (np.uint64(i) * ny + np.uint64(j)) * nz + np.uint64(k)
                        for n in range(first[at], first[at + np.uint64(1)]):
                            f = members[np.uint64(n)]
                            a, b, c = corners_of(triangles, f)
                            u, v, apart = _near_triangle(vertices, a, b, c, x, y, z)
                            if apart < square or (apart == square and which < 0):
                                square, which, best_u, best_v = apart, f, u, v
                                far = square * inverse * inverse
    return math.sqrt(square), which, best_u, best_v


@kernel(inline="always")
def blended(values, a, b, c, u, v):
    """Vectors of three vertices blended with these weights of the second and third; the vertices as of `corners_of`."""
    w, one, two = 1.0 - u - v, np.uint64(1), np.uint64(2)
    return (
        w * values[a] + u * values[b] + v * values[c],
        w * values[a + one] + u * values[b + one] + v * values[c + one],
        w * values[a + two] + u * values[b + two] + v * values[c + two],
    )


@kernel(inline="always")
def normal_at(vertices, normals, a, b, c, u, v):
    """Unit normal of the open side, smooth as that of `smooth_normals`."""
    x, y, z = blended(normals, a, b, c, u, v)
    square = x * x + y * y + z * z
    if not square > LEAST * LEAST:
        bx, by, bz = difference(vertices, a, b)
        cx, cy, cz = difference(vertices, a, c)
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        square = x * x + y * y + z * z
    inverse = 1.0 / max(math.sqrt(square), 1e-12)
    return x * inverse, y * inverse, z * inverse
