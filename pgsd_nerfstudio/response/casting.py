"""The part of the surface mesh that casts shadows: where Gaussians are.

A mesh fused from depth images closes what no camera saw: it has walls at the border of the space behind a bench, where nothing
is. What lands may lie there, but light passes.
"""

from __future__ import annotations

import torch
from scipy.spatial import KDTree

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SOLID = 0.3  # opacity from which a Gaussian is part of a surface
NEIGHBOURS = 8  # Gaussians that could reach a vertex
AWAY = 0.1  # m from a vertex to the centre of any Gaussian
BEYOND = 2.0  # and so many of its greatest standard deviations, from which the vertex is part of nothing


def casting(surface: SurfaceMesh, metric: Gaussians) -> SurfaceMesh:
    """The mesh without triangles at whose corners no Gaussian is.

    Args:
        surface: the mesh in metres.
        metric: the frozen Gaussians in metres.
    """
    solid = (metric.opacities > SOLID).nonzero()[:, 0]
    if len(solid) == 0 or len(surface.triangles) == 0:
        return surface
    apart, near = KDTree(metric.means[solid].numpy()).query(surface.vertices.numpy(), min(NEIGHBOURS, len(solid)))
    apart = torch.from_numpy(apart).reshape(len(surface.vertices), -1)
    sizes = metric.scales[solid].amax(1)[torch.from_numpy(near).reshape(apart.shape)]
    nothing = (apart.amin(1) > AWAY) & ((apart / sizes).amin(1) > BEYOND)
    return SurfaceMesh(surface.vertices, surface.triangles[~nothing[surface.triangles.long()].any(1)])
