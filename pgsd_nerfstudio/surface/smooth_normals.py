"""Normals at hits: those of a triangle's corners, blended by the hit's weights, or the triangle's own where they cancel."""

from __future__ import annotations

import math

import numba
import numpy as np

LEAST = 0.1  # length of the blend of unit normals below which it says nothing


@numba.njit(cache=True, nogil=True, inline="always")
def smooth_normal(corners, triangle, u, v, own):
    """One unit normal, float32.

    Args:
        corners: [f, 3, 3] unit normals at the corners of all triangles.
        triangle: index of the triangle.
        u: weight of its second corner.
        v: weight of its third corner.
        own: [3] the triangle's own normal, of any length.
    """
    w = np.float32(1.0) - u - v
    at = corners[triangle]
    x = w * at[0, 0] + u * at[1, 0] + v * at[2, 0]
    y = w * at[0, 1] + u * at[1, 1] + v * at[2, 1]
    z = w * at[0, 2] + u * at[1, 2] + v * at[2, 2]
    square = x * x + y * y + z * z
    if not square > LEAST * LEAST:
        x, y, z = own[0], own[1], own[2]
        square = x * x + y * y + z * z
    inverse = np.float32(1.0 / max(math.sqrt(square), 1e-12))
    return x * inverse, y * inverse, z * inverse


@numba.njit(cache=True, nogil=True)
def smooth_normals(corners, triangles, weights, own, which):
    """Unit normals [h, 3] of some hits.

    Args:
        corners: [f, 3, 3] unit normals at the corners of all triangles.
        triangles: [n] triangle of each hit.
        weights: [n, 2] weights of its second and third corner.
        own: [n, 3] its own normal.
        which: [h] indices of the hits that are asked for.
    """
    normals = np.empty((len(which), 3), np.float32)
    for h in range(len(which)):
        n = which[h]
        normals[h] = smooth_normal(corners, triangles[n], weights[n, 0], weights[n, 1], own[n])
    return normals
