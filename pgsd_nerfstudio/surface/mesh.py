"""The surface of a scene, on which particles land: a triangle mesh in metres with queries for rays and closest points.

The mesh is fused (fusion.py) from the depth of the frozen Gaussians as the training cameras see it (depth.py), so it works for
any capture. Rays and closest points run in Open3D's RaycastingScene (Embree).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt32
from torch import Tensor

from pgsd_nerfstudio.rendering.rasterizer import Rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import attention
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import cache_dir, content_key, load_tensors, save_tensors
from pgsd_nerfstudio.surface.depth import SETTINGS, chosen_views, render_depths, without_sky
from pgsd_nerfstudio.surface.fusion import Fusion, Region, fuse, open3d, without_silhouettes
from pgsd_nerfstudio.surface.smooth_normals import smooth_normals, vertex_normals

VERSION = 2  # of the fusion; cached meshes of another version are not read
NEAR_VOXEL, FAR_VOXEL, REACH = 1 / 80, 1 / 16, 4.0  # in radii: median distance from the cameras to what they look at
NEAR = 1.25  # radius of the finely fused ball around what the cameras look at, in radii
SKY = 1.25 * REACH  # distance from the nearest camera in radii beyond which a Gaussian is sky: nothing is fused there
FEW = 20_000  # rays or points that one thread takes alone
MAX_TRIANGLES = {"near": 330_000, "far": 70_000}

Points = Float[Tensor | np.ndarray, "n 3"]
"""Places or directions, of any float type."""


class Hits(NamedTuple):
    """First hits of rays on the surface."""

    distance: Float[Tensor, " n"]
    """In lengths of the ray's direction: metres for unit directions, 0..1 along a displacement. It is inf without a hit."""
    normal: Float[Tensor, "n 3"]
    """Unit normals of the open side; zero without a hit."""


class Closest(NamedTuple):
    """The surface points nearest to given points."""

    points: Float[Tensor, "n 3"]
    """Metres."""
    normals: Float[Tensor, "n 3"]
    """Unit normals of the open side."""
    distance: Float[Tensor, " n"]
    """Metres, never negative; inf if the mesh is empty."""


class RayHits(NamedTuple):
    """First hits of n rays as Open3D returns them; without a hit the distance is inf and the rest means nothing."""

    distance: Float[np.ndarray, " n"]
    """In lengths of the ray's direction."""
    triangles: UInt32[np.ndarray, " n"]
    weights: Float[np.ndarray, "n 2"]
    """Weights of the triangle's second and third corner at the hit."""
    own_normals: Float[np.ndarray, "n 3"]
    """Normals of the triangles."""


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles in metres, z up. Their winding faces the open side, from which the cameras saw them. A mesh may be empty."""

    vertices: Float[Tensor, "v 3"]
    triangles: Int[Tensor, "f 3"]

    @staticmethod
    def empty() -> SurfaceMesh:
        """A mesh without triangles."""
        return SurfaceMesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lowest and highest corner in metres; zeros if the mesh is empty."""
        if len(self.vertices) == 0:
            return torch.zeros(2, 3)
        return torch.stack(self.vertices.aminmax(dim=0))

    def cast(self, origins: Points, directions: Points) -> Hits:
        """First hits of rays, from either side of the surface.

        Args:
            origins: where the rays start, in metres.
            directions: of any length; distances count in this length.
        """
        n = len(origins)
        if len(self.triangles) == 0 or n == 0:
            return Hits(torch.full((n,), torch.inf), torch.zeros(n, 3))
        found = self.first_hits(origins, directions)
        normals, hit = np.zeros((n, 3), np.float32), np.isfinite(found.distance).nonzero()[0]
        normals[hit] = self.normals_of(found, hit)
        return Hits(torch.from_numpy(found.distance), torch.from_numpy(normals))

    def first_hits(self, origins: Points, directions: Points) -> RayHits:
        """First hits of rays as `cast` finds them, without normals, which take longer than the rays; for a mesh with triangles.

        Args:
            origins: where the rays start, in metres.
            directions: of any length; distances count in this length.
        """
        return self.hits_of(queries(origins, directions))

    def hits_of(self, rays: Any) -> RayHits:
        """First hits of rays, given as Open3D's tensor of origins and directions side by side; see `first_hits`."""
        found = self.raycasting.cast_rays(rays, _threads(len(rays)))
        return RayHits(*(found[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")))

    def normals_of(self, found: RayHits, which: Int[np.ndarray, " h"]) -> Float[np.ndarray, "h 3"]:
        """Unit normals of the open side at some of the hits.

        Args:
            found: hits of rays.
            which: indices of rays that have a hit.
        """
        mesh = self.vertex_normals.numpy(), self.triangles.numpy(force=True)
        return smooth_normals(*mesh, found.triangles, found.weights, found.own_normals, which)

    def closest(self, points: Points) -> Closest:
        """Nearest points of the surface, however far away.

        Args:
            points: in metres.
        """
        if len(self.triangles) == 0 or len(points) == 0:
            points = torch.as_tensor(points, dtype=torch.float32).cpu()
            up = torch.tensor([0.0, 0.0, 1.0]).repeat(len(points), 1)
            return Closest(points.clone(), up, torch.full((len(points),), torch.inf))
        query = queries(points)
        found = self.raycasting.compute_closest_points(query, _threads(len(points)))
        nearest = torch.from_numpy(found["points"].numpy())
        distance = (nearest - torch.from_numpy(query.numpy())).norm(dim=1)
        own = found["primitive_normals"].numpy()
        hits = RayHits(distance.numpy(), found["primitive_ids"].numpy(), found["primitive_uvs"].numpy(), own)
        normals = self.normals_of(hits, np.arange(len(nearest)))
        return Closest(nearest, torch.from_numpy(normals), distance)

    @cached_property
    def vertex_normals(self) -> Float[Tensor, "v 3"]:
        """Unit normals of the vertices: the mean of the adjoining triangles' normals, weighted by area."""
        return torch.from_numpy(vertex_normals(self.vertices.float().numpy(force=True), self.triangles.numpy(force=True)))

    @cached_property
    def raycasting(self) -> Any:
        """Open3D's scene of the triangles, for rays and distances."""
        o3d = open3d()
        scene = o3d.t.geometry.RaycastingScene()
        triangles = np.ascontiguousarray(self.triangles.numpy().astype(np.uint32))
        scene.add_triangles(o3d.core.Tensor(self.vertices.numpy()), o3d.core.Tensor(triangles))
        return scene


def surface_of(
    scene: Scene, rasterizer: Rasterizer, *, voxel: float | None = None, cache: bool = True, progress: bool = True
) -> SurfaceMesh:
    """The surface of a scene, from the depth of its solid part as at most 40 of its training cameras see it.

    The mesh is finer inside the ring of the cameras than beyond it and ends at four times their distance. A sky beyond
    that, at five times their distance or more, does not change it. It has at most 400,000 triangles; voxels grow until it does.
    It is kept in the cache under the hash of the scene and of these settings.

    Args:
        scene: the frozen scene with its training cameras.
        rasterizer: of the scene; depth is rendered on its device.
        voxel: edge of a voxel inside the cameras' ring in metres, by default 1/80 of the cameras' distance; voxels beyond the
            ring are five times as large.
        cache: whether to read the mesh from the cache, and to write it there.
        progress: whether to show a progress bar.

    Raises:
        ValueError: `voxel` is not positive.
        OSError: the cache could not be written.
    """
    metres = scene.frame.metres_per_unit
    middle, radius_units = attention(scene.cameras, scene.gaussians)
    radius = radius_units * metres
    voxel = NEAR_VOXEL * radius if voxel is None else voxel
    if not voxel > 0:
        raise ValueError(f"the voxel of the surface must be a positive number of metres, got {voxel}")
    fusion = Fusion(voxel=voxel, reach=REACH * radius)
    settings = (VERSION, *SETTINGS, SKY, NEAR, FAR_VOXEL / NEAR_VOXEL, MAX_TRIANGLES, fusion)
    path = cache_dir() / "surfaces" / f"{content_key(scene.content_key(), *settings)}.safetensors"
    if cache and (mesh := _stored(path)) is not None:
        return mesh
    cameras = chosen_views(scene.cameras)
    ground = without_sky(scene.gaussians, cameras, SKY * radius_units)
    depths = [metres * depth for depth in render_depths(ground, cameras, rasterizer.frozen.device, progress=progress)]
    center = scene.frame.to_metric(middle.float())
    mesh = surface_from_depths(depths, scene.frame.cameras_to_metric(cameras), center, radius, voxel)
    if cache:
        save_tensors(path, {"vertices": mesh.vertices, "triangles": mesh.triangles}, {"voxel": voxel, "radius": radius})
    return mesh


def surface_from_depths(
    depths: Sequence[Float[Tensor, "h w"]],  # m along the optical axis; 0 where unknown, inf where the sky was
    cameras: Cameras,  # metric
    center: Float[Tensor, "3"],  # m, what the cameras look at
    radius: float,  # m, from the cameras to it
    voxel: float,  # m, inside the cameras' ring
) -> SurfaceMesh:
    """Fuse depth images: finely inside a ball of 1.25 radii around the centre, coarsely up to 4 radii from the cameras."""
    inside, far_voxel = NEAR * radius, voxel * FAR_VOXEL / NEAR_VOXEL
    middle = center.numpy()
    sharp = [without_silhouettes(depth, float(K[0, 0])) for depth, K in zip(depths, cameras.Ks, strict=True)]
    # The far region reaches into the near one by one voxel, so that no gap stays between the two.
    near: Region = lambda points: np.linalg.norm(points - middle, axis=1) - inside  # noqa: E731
    far: Region = lambda points: inside - far_voxel - np.linalg.norm(points - middle, axis=1)  # noqa: E731
    vertices, triangles = _fuse_within(MAX_TRIANGLES["near"], sharp, cameras, Fusion(voxel=voxel, reach=REACH * radius), near)
    around = _fuse_within(MAX_TRIANGLES["far"], sharp, cameras, Fusion(voxel=far_voxel, reach=REACH * radius), far)
    return SurfaceMesh(
        torch.from_numpy(np.concatenate([vertices, around[0]])),
        torch.from_numpy(np.concatenate([triangles, around[1] + np.int32(len(vertices))])),
    )


def _stored(path: Any) -> SurfaceMesh | None:
    """The mesh of a cache file; None if there is no file, or if it holds no such mesh."""
    found = load_tensors(path)
    if found is None or set(found[0]) != {"vertices", "triangles"}:
        return None
    vertices, triangles = found[0]["vertices"], found[0]["triangles"]
    sound = torch.isfinite(vertices).all() and (len(triangles) == 0 or int(triangles.max()) < len(vertices))
    return SurfaceMesh(vertices, triangles) if sound else None


def _fuse_within(
    budget: int, depths: Sequence[Float[Tensor, "h w"]], cameras: Cameras, fusion: Fusion, region: Region
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a region; voxels grow until the triangles keep within the budget."""
    while True:
        vertices, triangles = fuse(depths, cameras, fusion, region)
        if len(triangles) <= budget:
            return vertices, triangles
        fusion = replace(fusion, voxel=fusion.voxel * 1.05 * (len(triangles) / budget) ** 0.5)


def _threads(count: int) -> int:
    """Threads for as many rays or points, 0 for all: to wake them costs as much as a few thousand rays."""
    return 1 if count < FEW else 0


def queries(*parts: Points) -> Any:
    """Points, or origins and directions, as the tensor that Open3D expects."""
    arrays = [part.numpy(force=True) if isinstance(part, Tensor) else part for part in parts]
    rows = np.empty((len(arrays[0]), 3 * len(arrays)), np.float32)
    for column, array in enumerate(arrays):
        rows[:, 3 * column : 3 * column + 3] = array
    return open3d().core.Tensor(rows)
