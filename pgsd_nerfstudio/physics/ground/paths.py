"""Kernels of contacts: rays along the paths of particles, and which of their hits can be contacts."""

from __future__ import annotations

import math

import numpy as np

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.surface.smooth_normals import smooth_normal


@kernel()
def rays_along(start, stop, which):
    """Origins and unit directions [r, 6] of rays along some straight paths, and the lengths [r] of the paths, float32.

    Args:
        start: [n, 3] m.
        stop: [n, 3] m.
        which: [r] indices of the paths, of more than no length.
    """
    rays, lengths = np.empty((len(which), 6), np.float32), np.empty(len(which), np.float32)
    for r in range(len(which)):
        n = which[r]
        x, y, z = stop[n, 0] - start[n, 0], stop[n, 1] - start[n, 1], stop[n, 2] - start[n, 2]
        length = math.sqrt(x * x + y * y + z * z)
        lengths[r] = length
        rays[r, 0], rays[r, 1], rays[r, 2] = start[n, 0], start[n, 1], start[n, 2]
        rays[r, 3], rays[r, 4], rays[r, 5] = x / length, y / length, z / length
    return rays, lengths


@kernel()
def within_reach(distances, hit, weights, own, rays, lengths, thickest, grazing, vertex_normals, triangles):
    """Hits that are on their paths, or would be if the surface were raised by the thickest cover.

    A path reaches a plane that is raised by h earlier by the distance h n_z / (-d . n).

    Args:
        distances: [r] m.
        hit: [r] triangle of each hit; this and the next two mean nothing where the distance is inf.
        weights: [r, 2] weights of the triangle's second and third corner.
        own: [r, 3] the triangle's normal.
        rays: [r, 6] origins and unit directions.
        lengths: [r] of the paths, m.
        thickest: m of cover.
        grazing: smallest sine of the angle between path and surface that counts.
        vertex_normals: [v, 3] unit normals of the surface's vertices.
        triangles: [f, 3] vertices of its triangles.

    Returns:
        Indices [h] of these hits, ascending, and their unit normals [h, 3] on the side from which the paths come, float32.
    """
    which, normals, count = np.empty(len(distances), np.int64), np.empty((len(distances), 3), np.float32), 0
    for r in range(len(distances)):
        if not distances[r] <= lengths[r] + thickest / grazing:
            continue
        x, y, z = smooth_normal(vertex_normals, triangles, hit[r], weights[r, 0], weights[r, 1], own[r])
        into = -(x * rays[r, 3] + y * rays[r, 4] + z * rays[r, 5])
        if into < 0.0:
            into, x, y, z = -into, -x, -y, -z
        sooner = thickest * z / max(into, grazing) if z > 0.0 else 0.0
        if distances[r] - sooner <= lengths[r] * (1.0 + 1e-6):
            which[count] = r
            normals[count, 0], normals[count, 1], normals[count, 2] = x, y, z
            count += 1
    return which[:count].copy(), normals[:count].copy()
