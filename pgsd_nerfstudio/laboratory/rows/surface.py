"""Figures of the room surface: how far the mesh lies from the demo's exact one, and what asking it costs."""

from __future__ import annotations

import time

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import scene_size
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_depth, demo_scene
from pgsd_nerfstudio.scene.frame import attention
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import NEAR_VOXEL, SurfaceMesh, surface_from_depths, surface_of

_EXACT = "the demo's own triangles, hit by slanting rays from above within 2.5 m of its middle"


def verify(quick: bool) -> list[Record]:
    """The fused surface against the triangles that the demo scene was built from; quick: only from exact depth."""
    scene, exact, voxel = _demo()
    cameras = scene.cameras[:: 2 if quick else 1].resized(480, 320)
    rows = _judged("fusion of exact depth", _from_exact_depth(scene, cameras, voxel), exact, voxel)
    return rows if quick else rows + _judged("surface of the demo", _from_splat(scene), exact, voxel)


def _judged(name: str, mesh: SurfaceMesh, exact: SurfaceMesh, voxel: float) -> list[Record]:
    error, holes = _against(mesh, exact)
    paid = {"error": 100 * error, "error_unit": "cm"}
    return [
        Record.judged(f"{name}: median error over voxel", error / voxel, "", "<= 0.5", source=_EXACT, **paid),
        Record.judged(f"{name}: holes", 100 * holes, "% of rays", "<= 1", source=_EXACT),
    ]


def bench(quick: bool) -> list[Record]:
    """Cost beside error."""
    scene, exact, _ = _demo()
    began = time.perf_counter()
    mesh = _from_splat(scene)
    seconds = time.perf_counter() - began
    count = 20_000 if quick else 100_000
    origins, directions = _falling(count)
    mesh.cast(origins[:10], directions[:10])  # builds the tree
    rays = _seconds(lambda: mesh.cast(origins, directions))
    points = origins + (mesh.cast(origins, directions).distance.clamp(max=10.0) - 0.05)[:, None] * directions
    nearest = _seconds(lambda: mesh.closest(points))
    error = 100 * _against(mesh, exact)[0]
    size = f"{len(mesh.triangles):,} triangles of the demo"
    return [
        Record("surface from 40 views", seconds, "s", error=error, error_unit="cm", source=size),
        Record("rays that fall on the surface", 1e6 * rays / count, "us each", source=size),
        Record("closest points 5 cm above it", 1e6 * nearest / count, "us each", source=size),
        *scene_size.rows(exact, quick=quick),
    ]


def _demo() -> tuple[Scene, SurfaceMesh, float]:
    """The demo, its exact surface in metres, and the voxel that its surface is fused with."""
    scene = demo_scene()
    assert scene.mesh is not None
    vertices, triangles = scene.mesh
    voxel = NEAR_VOXEL * attention(scene.cameras, scene.gaussians)[1] * scene.frame.metres_per_unit
    return scene, SurfaceMesh(scene.frame.to_metric(vertices.float()), triangles.int()), voxel


def _from_splat(scene: Scene) -> SurfaceMesh:
    return surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), cache=False, progress=False)


def _from_exact_depth(scene: Scene, cameras: Cameras, voxel: float) -> SurfaceMesh:
    middle, radius = attention(scene.cameras, scene.gaussians)
    metres = scene.frame.metres_per_unit
    depths = list(metres * demo_depth(cameras))
    center = scene.frame.to_metric(middle.float())
    return surface_from_depths(depths, scene.frame.cameras_to_metric(cameras), center, metres * radius, voxel)


def _against(mesh: SurfaceMesh, exact: SurfaceMesh) -> tuple[float, float]:
    """Median distance in metres between where rays end, and the share of the rays that only the exact surface stops."""
    rays = _falling(20_000)
    truth, found = exact.cast(*rays).distance, mesh.cast(*rays).distance
    hit, both = torch.isfinite(truth), torch.isfinite(truth) & torch.isfinite(found)
    return float((found - truth)[both].abs().median()), 1 - int(both.sum()) / int(hit.sum())


def _falling(count: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    generator = torch.Generator().manual_seed(0)
    across = 2.5 * (2 * torch.rand(count, 2, generator=generator) - 1)
    directions = torch.tensor([0.2, -0.1, -1.0]) + 0.1 * torch.randn(count, 3, generator=generator)
    return torch.cat([across, torch.full((count, 1), 2.5)], dim=1), torch.nn.functional.normalize(directions, dim=1)


def _seconds(call) -> float:
    times = []
    for _ in range(3):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)
