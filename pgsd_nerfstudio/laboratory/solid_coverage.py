"""The share of a picture that solid ellipsoids cover, by casting rays on their meshes: no Gaussians, no blur of pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.courtyard.baking import as_tensor, raycasting
from pgsd_nerfstudio.scene.rotations import quat_normalize, quat_wxyz_to_xyzw, unitquat_to_rotmat

if TYPE_CHECKING:
    import open3d as o3d

RAYS = 2**21  # cast at a time


@dataclass(frozen=True)
class Ellipsoids:
    """N ellipsoids in the units of a camera."""

    centers: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Orientation, wxyz."""
    axes: Float[Tensor, "n 3"]
    """Semi-axes."""
    opacities: Float[Tensor, " n"]
    """What each takes of a ray that hits it, 0..1."""
    displacements: Float[Tensor, "n 3"]
    """Ways while the shutter is open, centred on the centres."""

    def select(self, which: Tensor) -> Ellipsoids:
        """Some of them, by mask or by index."""
        return Ellipsoids(
            self.centers[which], self.quats[which], self.axes[which], self.opacities[which], self.displacements[which]
        )


def solid_coverage(bodies: Ellipsoids, camera: Cameras, samples: int, times: int, *, seed: int = 0) -> tuple[float, float]:
    """Mean over a picture of what the first ellipsoid takes of a ray, and its standard error.

    Args:
        bodies: in the units of the camera.
        camera: one camera.
        samples: rays per pixel on average, at random places of the picture; a multiple of `times`.
        times: instants while the shutter is open, even parts of it.
        seed: of the places.
    """
    generator = np.random.default_rng(seed)
    sphere, faces = unit_sphere()
    turn = unitquat_to_rotmat(quat_wxyz_to_xyzw(quat_normalize(bodies.quats))).double()
    shape = (torch.from_numpy(sphere) * bodies.axes[:, None].double()) @ turn.transpose(1, 2)
    triangles = (faces + len(sphere) * np.arange(len(shape))[:, None, None]).reshape(-1, 3)
    taken = np.append(bodies.opacities.double().numpy(), 0.0)
    sums, squares, count = 0.0, 0.0, 0
    for instant in range(times):
        places = bodies.centers + ((instant + 0.5) / times - 0.5) * bodies.displacements
        scene = raycasting((shape + places[:, None]).reshape(-1, 3).numpy(), triangles)
        for start in range(0, samples // times * camera.width * camera.height, RAYS):
            rays = min(RAYS, samples // times * camera.width * camera.height - start)
            hit = scene.cast_rays(_rays(camera, rays, generator))["primitive_ids"].numpy().astype(np.int64)
            found = taken[np.where(hit == scene.INVALID_ID, len(shape), hit // len(faces))]
            sums, squares, count = sums + found.sum(), squares + (found**2).sum(), count + rays
    mean = sums / count
    return float(mean), float(np.sqrt(max(squares / count - mean**2, 0.0) / count))


def unit_sphere() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of a ball whose shadow is on average that of the unit ball.

    The mean shadow of a convex body is a quarter of its surface (Cauchy 1841), so its surface is 4 pi.
    """
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_icosahedron().subdivide_midpoint(1)
    vertices, faces = np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return vertices * np.sqrt(4 * np.pi / (0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)).sum()), faces


def _rays(camera: Cameras, count: int, generator: np.random.Generator) -> o3d.core.Tensor:
    """Rays through random places of the picture."""
    K, pose = camera.Ks[0].double().numpy(), np.linalg.inv(camera.viewmats[0].double().numpy())
    u, v = camera.width * generator.random(count), camera.height * generator.random(count)
    local = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(count)], axis=1)
    rays = np.concatenate([np.broadcast_to(pose[:3, 3], (count, 3)), local @ pose[:3, :3].T], axis=1)
    return as_tensor(rays)
