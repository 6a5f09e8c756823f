"""Normals at hits: those of a triangle's corners, blended by the hit's weights, or the triangle's own where they cancel."""

from __future__ import annotations

import math

import numpy as np

from pgsd_nerfstudio.kernels import kernel

LEAST = 0.1  # length of the blend of unit normals below which it says nothing


@kernel()
def vertex_normals(vertices, triangles):
    """Unit normals [v, 3] of vertices: the mean of the adjoining triangles' normals, weighted by area; 0 without any area.

    Args:
        vertices: [v, 3], float32.
        triangles: [f, 3] vertices of each triangle.
    """
    total = np.zeros(vertices.shape, np.float32)
    for f in range(len(triangles)):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for vertex in (a, b, c):
            total[vertex, 0] += x
            total[vertex, 1] += y
            total[vertex, 2] += z
    for vertex in range(len(total)):
        x, y, z = total[vertex, 0], total[vertex, 1], total[vertex, 2]
        inverse = np.float32(1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12))
        total[vertex, 0], total[vertex, 1], total[vertex, 2] = x * inverse, y * inverse, z * inverse
    return total


@kernel(inline="always")
def smooth_normal(normals, triangles, triangle, u, v, own):
    """One unit normal, float32.

    Args:
        normals: [v, 3] unit normals of all vertices.
        triangles: [f, 3] vertices of all triangles.
        triangle: index of the triangle.
        u: weight of its second corner.
        v: weight of its third corner.
        own: [3] the triangle's own normal, of any length.
    """
    w = np.float32(1.0) - u - v
    a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
    x = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
    y = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
    z = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
    square = x * x + y * y + z * z
    if not square > LEAST * LEAST:
        x, y, z = own[0], own[1], own[2]
        square = x * x + y * y + z * z
    inverse = np.float32(1.0 / max(math.sqrt(square), 1e-12))
    return x * inverse, y * inverse, z * inverse


@kernel()
def smooth_normals(vertex_normals, triangles, hit, weights, own, which):
    """Unit normals [h, 3] of some hits.

    Args:
        vertex_normals: [v, 3] unit normals of all vertices.
        triangles: [f, 3] vertices of all triangles.
        hit: [n] triangle of each hit.
        weights: [n, 2] weights of its second and third corner.
        own: [n, 3] its own normal.
        which: [h] indices of the hits that are asked for.
    """
    normals = np.empty((len(which), 3), np.float32)
    for h in range(len(which)):
        n = which[h]
        normals[h] = smooth_normal(vertex_normals, triangles, hit[n], weights[n, 0], weights[n, 1], own[n])
    return normals
