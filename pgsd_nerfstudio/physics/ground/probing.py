"""The neighbourhood of landed particles: how far the surface around each is flat and unbroken, and its mean normal.

From a particle's point the surface is followed in eight directions, from triangle to triangle, as a straight line seen along
the normal. It is unbroken as far as it goes on to three rings around the point, nearly in the plane of the particle. The walk
knows only the sheet that the particle lies on. Rays onto the rings find the same but where other sheets are close, and take
three times as long.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.surface.short_ways import blended, corners_of, grid_of, nearest, normal_at
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

RINGS = (0.25, 0.5, 1.0)  # radii of the rings, relative to SurfaceResponse.probe
PROBES = 8  # directions
SMALLEST = 0.15  # relative to SurfaceResponse.probe; extent where the first ring finds no surface, as on a blade of grass
ROUGH = 0.35  # rise per run up to which the neighbourhood counts as the same surface
FAR = 0.3  # m within which the surface is looked for
INWARD = 1e-3
MOST = 200  # triangles on the way in one direction


def probed(
    cells: TriangleCells, points: Float[ndarray, "h 3"], probe: float
) -> tuple[Float[ndarray, "h 3"], Float[ndarray, "h 3"], Float[ndarray, " h"], Int[ndarray, " h"]]:
    """Nearest points of the surface, the normals around them, and how far the surface is unbroken.

    Args:
        cells: triangles of the surface.
        points: m.
        probe: radius of the outermost ring, m.

    Returns:
        Nearest points in metres, upward unit normals averaged over the unbroken neighbourhood, and its radii in metres, all
        float32; and the triangles, -1 where there is none within FAR, and then the rest means nothing.
    """
    rings = np.array(RINGS) * probe
    mesh = cells.triangles.reshape(-1), cells.vertices.reshape(-1), cells.normals.reshape(-1)
    lists = cells.first, cells.members, *mesh, cells.across
    return _probed(np.ascontiguousarray(points, np.float64), rings, SMALLEST * probe, grid_of(cells), *lists)


@kernel()
def _probed(points, rings, smallest, grid, first, members, triangles, vertices, vertex_normals, sides):
    count = len(points)
    at, normals = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    extents, owners = np.empty(count, np.float32), np.empty(count, np.int32)
    found, total, same = np.empty((PROBES, len(rings), 3)), np.empty(3), np.empty(len(rings), np.int64)
    for n in range(count):
        _, f, u, v = nearest(points[n, 0], points[n, 1], points[n, 2], FAR, grid, first, members, triangles, vertices)
        owners[n] = f
        if f < 0:
            continue
        a, b, c = corners_of(triangles, f)
        at[n, 0], at[n, 1], at[n, 2] = blended(vertices, a, b, c, u, v)
        x, y, z = normal_at(vertices, vertex_normals, a, b, c, u, v)
        side = -1.0 if z < 0.0 else 1.0
        normal = (side * x, side * y, side * z)
        # Walks begin a thousandth of the way to the middle of the triangle, since none leaves it from one of its corners.
        u, v = u + INWARD * (1.0 / 3.0 - u), v + INWARD * (1.0 / 3.0 - v)
        start = blended(vertices, a, b, c, u, v)
        same[:] = 0
        for probe in range(PROBES):
            turn = 2.0 * math.pi * probe / PROBES
            along, across = math.cos(turn), math.sin(turn)
            reached = _walk(f, start, normal, along, across, triangles, vertices, vertex_normals, sides, rings, found[probe])
            for ring in range(len(rings)):
                same[ring] += (reached >> ring) & 1
        total[0], total[1], total[2] = 2.0 * normal[0], 2.0 * normal[1], 2.0 * normal[2]
        extent = smallest
        for ring in range(len(rings)):
            for probe in range(PROBES):
                for axis in range(3):
                    total[axis] += side * found[probe, ring, axis]
            if same[ring] < PROBES - 1:  # a single miss is a hole in a scanned mesh rather than an edge
                break
            extent = rings[ring]
        extents[n] = extent
        size = math.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
        inverse = (-1.0 if total[2] < 0.0 else 1.0) / max(size, 1e-6)
        normals[n, 0], normals[n, 1], normals[n, 2] = total[0] * inverse, total[1] * inverse, total[2] * inverse
    return at, normals, extents, owners


@kernel(inline="always")
def _corner(triangles, f, k):
    """Where corner k of a triangle begins in the list of all vertices' coordinates."""
    return np.uint64(3) * np.uint64(triangles[np.uint64(3 * f + k)])


@kernel(inline="always")
def _walk(f, start, normal, along, across, triangles, vertices, normals, sides, rings, found):
    """Follow the surface from `start` on triangle f in one direction; `found` takes its normals on the rings, or zeros.

    Seen along the normal, with the way along the first axis, it leaves a triangle by a side between a corner on its left and
    one on its right. Between the points where it enters and leaves, heights and normals change evenly.

    Returns:
        A bit for each ring on which the surface is nearly in the plane.
    """
    found[:] = 0.0
    n_x, n_y, n_z = normal
    # Two unit vectors square to the normal (Duff et al., "Building an orthonormal basis, revisited", 2017), of which d is made.
    b = -n_x * n_y / (1.0 + n_z)
    d_x, d_y = along * (1.0 - n_x * n_x / (1.0 + n_z)) + across * b, along * b + across * (1.0 - n_y * n_y / (1.0 + n_z))
    d_z = -along * n_x - across * n_y
    e_x, e_y, e_z = n_y * d_z - n_z * d_y, n_z * d_x - n_x * d_z, n_x * d_y - n_y * d_x
    o_a, o_b = d_x * start[0] + d_y * start[1] + d_z * start[2], e_x * start[0] + e_y * start[1] + e_z * start[2]
    o_h = n_x * start[0] + n_y * start[1] + n_z * start[2]
    side, s, left = -1, -1.0, np.uint64(0)
    l_a, l_b, l_h, r_a, r_b, r_h, right = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.uint64(0)
    for k in range(3):
        p, q = _corner(triangles, f, k), _corner(triangles, f, (k + 1) % 3)
        p_b = e_x * vertices[p] + e_y * vertices[p + np.uint64(1)] + e_z * vertices[p + np.uint64(2)] - o_b
        q_b = e_x * vertices[q] + e_y * vertices[q + np.uint64(1)] + e_z * vertices[q + np.uint64(2)] - o_b
        if (p_b >= 0.0) == (q_b >= 0.0):
            continue
        p_a = d_x * vertices[p] + d_y * vertices[p + np.uint64(1)] + d_z * vertices[p + np.uint64(2)] - o_a
        q_a = d_x * vertices[q] + d_y * vertices[q + np.uint64(1)] + d_z * vertices[q + np.uint64(2)] - o_a
        out = p_a - p_b * (q_a - p_a) / (q_b - p_b)
        if out > s:
            p_h = n_x * vertices[p] + n_y * vertices[p + np.uint64(1)] + n_z * vertices[p + np.uint64(2)] - o_h
            q_h = n_x * vertices[q] + n_y * vertices[q + np.uint64(1)] + n_z * vertices[q + np.uint64(2)] - o_h
            s, side = out, 3 * f + k
            if p_b >= 0.0:
                left, l_a, l_b, l_h, right, r_a, r_b, r_h = p, p_a, p_b, p_h, q, q_a, q_b, q_h
            else:
                left, l_a, l_b, l_h, right, r_a, r_b, r_h = q, q_a, q_b, q_h, p, p_a, p_b, p_h
    if side < 0:
        return 0
    ring, reached = 0, 0
    before, below, b_x, b_y, b_z = 0.0, 0.0, n_x, n_y, n_z  # where the way enters the triangle: its length, height, and normal
    for _ in range(MOST):
        share = l_b / (l_b - r_b)
        above = l_h + share * (r_h - l_h)
        if s >= rings[ring]:
            rest = 1.0 - share
            a_x = rest * normals[left] + share * normals[right]
            a_y = rest * normals[left + np.uint64(1)] + share * normals[right + np.uint64(1)]
            a_z = rest * normals[left + np.uint64(2)] + share * normals[right + np.uint64(2)]
            while s >= rings[ring]:
                part = min(max((rings[ring] - before) / max(s - before, 1e-9), 0.0), 1.0)
                if abs(below + part * (above - below)) <= ROUGH * rings[ring] + 0.01:
                    reached |= 1 << ring
                    found[ring, 0], found[ring, 1] = b_x + part * (a_x - b_x), b_y + part * (a_y - b_y)
                    found[ring, 2] = b_z + part * (a_z - b_z)
                ring += 1
                if ring == len(rings):
                    return reached
        entered = left, right, share
        side = sides[side]
        if side < 0:
            return reached
        before, below = s, above
        other = side // 3
        k = side - 3 * other
        p = _corner(triangles, other, (k + 2) % 3)
        a = d_x * vertices[p] + d_y * vertices[p + np.uint64(1)] + d_z * vertices[p + np.uint64(2)] - o_a
        b = e_x * vertices[p] + e_y * vertices[p + np.uint64(1)] + e_z * vertices[p + np.uint64(2)] - o_b
        h = n_x * vertices[p] + n_y * vertices[p + np.uint64(1)] + n_z * vertices[p + np.uint64(2)] - o_h
        # It leaves by the side between the third corner and the one that is not on the third corner's side of the way.
        left_first = _corner(triangles, other, k) == left
        on_left = b >= 0.0
        side = 3 * other + (k + (1 if on_left == left_first else 2)) % 3
        if on_left:
            left, l_a, l_b, l_h = p, a, b, h
        else:
            right, r_a, r_b, r_h = p, a, b, h
        s = l_a - l_b * (r_a - l_a) / (r_b - l_b)
        if s >= rings[ring]:
            rest, (one, two, share) = 1.0 - entered[2], entered
            b_x = rest * normals[one] + share * normals[two]
            b_y = rest * normals[one + np.uint64(1)] + share * normals[two + np.uint64(1)]
            b_z = rest * normals[one + np.uint64(2)] + share * normals[two + np.uint64(2)]
    return reached
