"""Depth images fused into triangles by a truncated signed distance on sparse voxel blocks.

The method is that of Curless & Levoy, "A volumetric method for building complex models from range images" (1996), in Open3D's
VoxelBlockGrid (Dong et al. 2022). Every view also clears the space that it sees through, so stray Gaussians in front of a
surface leave no triangles.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras

BLOCK = 8  # voxels along the edge of a block
FAR_AWAY = 1e6  # m, depth of the sky


def open3d() -> Any:
    """Open3D, imported at the first call because the import takes seconds. Its stubs know no NumPy arrays, hence `Any`."""
    return importlib.import_module("open3d")


@dataclass(frozen=True, kw_only=True)
class Fusion:
    """How depth images become triangles."""

    voxel: float
    """Edge of a voxel in metres."""
    reach: float
    """Depth in metres beyond which nothing is fused."""
    truncation: float = 8.0
    """Signed distances are kept up to this many voxels from a surface; below the noise of the depth, meshes get holes."""
    min_component: float = 12.0
    """A component of the mesh is removed as noise if its bounding box is shorter than this many voxels."""


Region = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
"""Signed distance in metres from points to the border of a part of space; negative inside."""


def everywhere(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The region without a border."""
    return np.full(len(points), -np.inf, points.dtype)


def fuse(
    depths: Sequence[Float[Tensor, "h w"]],  # m along the optical axis; 0 where nothing was seen, inf where the sky was
    cameras: Cameras,  # metric
    fusion: Fusion,
    region: Region = everywhere,
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Fuse depth images into triangles whose winding faces the side that the cameras saw.

    Returns:
        Vertices in metres, and the triangles with their middle in the region.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), fusion.voxel, BLOCK, 4096, core.Device("CPU:0")
    )
    views = []
    for depth, viewmat, K in zip(depths, cameras.viewmats, cameras.Ks, strict=True):
        # Depth beyond `reach`, and the sky, clears the space in front of it but activates no blocks.
        touched = _image(torch.where(depth < fusion.reach, depth, 0.0))
        camera = (core.Tensor(K.double().cpu().numpy()), core.Tensor(viewmat.double().cpu().numpy()))
        views.append((_image(depth.clamp(max=FAR_AWAY)), camera))
        # Only every fourth pixel of a row and of a column is looked at, so an image with depth may touch nothing.
        find = partial(grid.compute_unique_block_coordinates, touched, *camera, 1.0, fusion.reach, fusion.truncation)
        blocks = _or_nothing(find, "No block is touched")
        if blocks is not None:
            _activate(grid, blocks, fusion.voxel * BLOCK, region)
    if grid.hashmap().size() == 0:
        return _nothing()
    blocks = grid.hashmap().key_tensor()[grid.hashmap().active_buf_indices().to(core.int64)]
    for image, camera in views:
        grid.integrate(blocks, image, *camera, 1.0, 2 * FAR_AWAY, fusion.truncation)
    mesh = _or_nothing(partial(grid.extract_triangle_mesh, 0.5), "SetVertexColors")  # a grid without a surface has none
    if mesh is None or mesh.is_empty() or "indices" not in mesh.triangle:
        return _nothing()
    vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int32)
    triangles = triangles[region(vertices[triangles].mean(1)) < 0]
    return _without_crumbs(vertices, triangles, fusion.min_component * fusion.voxel)


def _or_nothing(find: Callable[[], Any], complaint: str) -> Any:
    """What Open3D finds; None where it raises an error with these words because there is nothing to find."""
    try:
        return find()
    except RuntimeError as error:
        if complaint not in str(error):
            raise
        return None


def _activate(grid: Any, blocks: Any, edge: float, region: Region) -> None:
    centers = (blocks.numpy() + 0.5) * edge
    near = np.flatnonzero(region(centers.astype(np.float32)) < edge)
    if len(near):
        grid.hashmap().activate(open3d().core.Tensor(np.ascontiguousarray(blocks.numpy()[near])))


def without_silhouettes(
    depth: Float[Tensor, "h w"],  # m; 0 where unknown, inf where the sky was
    focal: float,  # pixels
    pixels: float = 60.0,
    share: float = 0.1,
) -> Float[Tensor, "h w"]:
    """Depth in metres, set to 0 beside silhouettes and the sky, where the expected depth lies between two surfaces.

    A pixel is at a silhouette if its neighbourhood spans more than 60 pixel widths of depth (a surface seen at 2 degrees spans
    as much), or more than a tenth of the depth.
    """
    edge = min(pixels / focal, share)
    image = np.pad(depth.float().cpu().clamp(max=FAR_AWAY).numpy(), 1, mode="edge")
    high = np.maximum(np.maximum(image[:-2], image[1:-1]), image[2:])
    low = np.minimum(np.minimum(image[:-2], image[1:-1]), image[2:])
    high = np.maximum(np.maximum(high[:, :-2], high[:, 1:-1]), high[:, 2:])
    low = np.minimum(np.minimum(low[:, :-2], low[:, 1:-1]), low[:, 2:])
    return torch.where(torch.from_numpy(high - low) <= edge * depth.cpu(), depth.cpu(), 0.0)


def _without_crumbs(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "f 3"], size: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The mesh without small components and without vertices that no triangle uses."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(triangles) == 0:
        return _nothing()
    ends = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    links = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2)
    count, component = connected_components(links, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, component, vertices)
    np.maximum.at(high, component, vertices)
    large = (high - low).max(1) >= size
    return _in_order(vertices, triangles[large[component[triangles[:, 0]]]])


def _in_order(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """The mesh with only the vertices that its triangles use, in an order that does not depend on threads."""
    used, renumbered = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[used].astype(np.float32), renumbered.reshape(-1, 3)
    order = np.lexsort(vertices.T)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[triangles]
    # Each triangle is rotated until its lowest index comes first, which keeps the winding.
    turned = (triangles.argmin(1)[:, None] + np.arange(3)) % 3
    triangles = np.take_along_axis(triangles, turned, axis=1)
    return vertices[order], triangles[np.lexsort(triangles.T[::-1])]


def _image(depth: Float[Tensor, "h w"]) -> Any:
    o3d = open3d()
    return o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth.float().cpu().numpy())[:, :, None]))


def _nothing() -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
