"""The built-in scene: a courtyard in the late afternoon, whose geometry and light are exactly known.

The surfaces are modelled in metres and lit once (`courtyard/`). The scene units are two metres long, turned and shifted against
the metric frame, as those of a real capture are, so that code that mixes up units fails at once. The ground truth is the
triangle mesh, and the depth found by casting rays on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.courtyard import courtyard
from pgsd_nerfstudio.scene.courtyard.baking import as_tensor, backdrop, bake, develop, raycasting
from pgsd_nerfstudio.scene.courtyard.surfels import Part, gaussians_of, join
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.storage import cache_dir, content_key, load_tensors, save_tensors

SEED = 20
WIDTH, HEIGHT, FOCAL = 960, 640, 1.1 * 960
TURN = math.radians(25)
RINGS = ((20, 3.55, 1.38, 0.98), (20, 4.75, 1.85, 0.92))  # number of cameras; radius, eye height, height looked at in metres


@dataclass(frozen=True)
class Model:
    """The Gaussians and the mesh of the courtyard in scene units, as they are stored in the cache."""

    gaussians: Gaussians
    vertices: Float[Tensor, "v 3"]
    triangles: Int[Tensor, "f 3"]
    foliage: Tensor
    """[f] bool: the triangle belongs to foliage, where a pixel has no single depth."""


def demo_scene() -> Scene:
    """The courtyard. It is built on first use, which takes about ten seconds, and then read from the cache.

    >>> scene = demo_scene()
    >>> scene.frame.metres_per_unit
    2.0
    """
    model = _model()
    return Scene(
        name="demo",
        gaussians=model.gaussians,
        cameras=demo_cameras(),
        frame=demo_frame(),
        description="a courtyard with a table with a vase on it, a bench and a tree",
        mesh=(model.vertices, model.triangles),
    )


def demo_mesh() -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    """Vertices (scene units) and triangles of all solid surfaces, branches and leaves, without grass, ivy and sky."""
    model = _model()
    return model.vertices, model.triangles


def demo_depth(cameras: Cameras) -> Float[Tensor, "t h w"]:
    """Depth along the optical axis at the pixel centres, in scene units, by casting rays on the mesh; inf if a ray misses."""
    return demo_hits(cameras)[0]


def demo_hits(cameras: Cameras) -> tuple[Float[Tensor, "t h w"], Tensor]:
    """`demo_depth`, and whether each ray met a solid surface, neither sky nor foliage ([T, H, W] bool)."""
    model = _model()
    scene = raycasting(model.vertices.numpy(), model.triangles.numpy())
    # The last entry stands for rays without a hit, whose index is -1.
    solid = torch.cat([~model.foliage, torch.tensor([False])])
    depths, solids = [], []
    v, u = torch.meshgrid(
        torch.arange(cameras.height).double() + 0.5, torch.arange(cameras.width).double() + 0.5, indexing="ij"
    )
    for K, c2w in zip(cameras.Ks.double(), torch.linalg.inv(cameras.viewmats.double()), strict=True):
        # The direction's z is 1 in the camera, so the distance along the ray is the depth.
        local = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1)
        rays = torch.cat([c2w[:3, 3].expand(local.shape), local @ c2w[:3, :3].T], dim=-1)
        hit = scene.cast_rays(as_tensor(rays.numpy()))
        met = hit["primitive_ids"].numpy().astype(np.int64)
        met[met == scene.INVALID_ID] = -1
        depths.append(torch.from_numpy(hit["t_hit"].numpy()))
        solids.append(solid[torch.from_numpy(met)])
    return torch.stack(depths), torch.stack(solids)


def demo_frame() -> Frame:
    """The metric frame: units of two metres, turned by 25 degrees about z; metric zero is on the ground below the table."""
    rotation = [[math.cos(TURN), -math.sin(TURN), 0.0], [math.sin(TURN), math.cos(TURN), 0.0], [0.0, 0.0, 1.0]]
    return Frame(
        2.0, torch.tensor(rotation), torch.tensor([0.10, -0.15, -0.60]), "the built-in courtyard is modelled in metres"
    )


def demo_cameras() -> Cameras:
    """Two rings of 20 views around the table at the eye height of a person, as in a capture on foot; in scene units."""
    frame, poses = demo_frame(), []
    for ring, (count, radius, height, look) in enumerate(RINGS):
        for k in range(count):
            angle = 2 * math.pi * (k + 0.5 * ring) / count
            # Nobody walks a perfect circle.
            r, z = radius + 0.12 * math.sin(5 * angle + ring), height + 0.10 * math.cos(3 * angle + 2 * ring)
            eye = torch.tensor([r * math.cos(angle), r * math.sin(angle), z])
            forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, look]) - eye, dim=0)
            right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
            pose = torch.stack([right, torch.linalg.cross(right, forward), -forward, eye], dim=1)
            pose[:, :3] = frame.rotation.T @ pose[:, :3]
            pose[:, 3] = frame.to_scene(eye)
            poses.append(pose)
    K = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Cameras.from_opengl(torch.stack(poses), K.repeat(len(poses), 1, 1), WIDTH, HEIGHT)


def build() -> Model:
    """Model, light and convert the courtyard without the cache."""
    rng = np.random.default_rng(SEED)
    parts = courtyard(rng)
    radiance = bake(parts)
    far, far_radiance = backdrop(rng)
    parts.append(Part("backdrop", far, far_radiance, opacity=0.995))
    everything = join([p.patch for p in parts])
    opacity = np.concatenate([np.full(len(p.patch), p.opacity) for p in parts])
    frame = demo_frame()
    return Model(
        gaussians=frame.gaussians_to_scene(
            gaussians_of(everything, develop(np.concatenate([radiance, far_radiance])), opacity)
        ),
        vertices=frame.to_scene(torch.from_numpy(everything.vertices).float()),
        triangles=torch.from_numpy(everything.triangles).int(),
        foliage=torch.cat([torch.full((len(p.patch.triangles),), p.leafy) for p in parts]),
    )


def _model() -> Model:
    # The scene depends on nothing but this code, so the hash of the code names the file.
    here = Path(__file__)
    sources = [source.read_bytes() for source in (here, *sorted(here.with_name("courtyard").glob("*.py")))]
    path = cache_dir() / f"demo-{content_key(sources)}.safetensors"
    if (stored := load_tensors(path)) is not None:
        tensors = stored[0]
        vertices, triangles, foliage = (tensors.pop(name) for name in ("vertices", "triangles", "foliage"))
        return Model(Gaussians(**tensors, antialiased=False, whole=False), vertices, triangles, foliage)
    model = build()
    mesh = {"vertices": model.vertices, "triangles": model.triangles, "foliage": model.foliage}
    save_tensors(path, {**model.gaussians.tensors, **mesh})
    return model
