"""The built-in courtyard against its own ground truth: rays cast on the mesh it was sampled from."""

from __future__ import annotations

import math

import numpy as np
import open3d as o3d
import pytest
import torch

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import build, demo_depth, demo_hits, demo_mesh, demo_scene
from pgsd_nerfstudio.scene.scene import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return demo_scene()


@pytest.fixture(scope="module")
def rays() -> o3d.t.geometry.RaycastingScene:
    """The mesh in metres."""
    vertices, triangles = demo_mesh()
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(demo_scene().frame.to_metric(vertices).numpy(), triangles.numpy().astype(np.uint32))
    return caster


def test_two_builds_are_equal(scene: Scene):
    again = build()
    assert again.gaussians.tensors.keys() == scene.gaussians.tensors.keys()
    for name, tensor in scene.gaussians.tensors.items():
        assert torch.equal(again.gaussians.tensors[name], tensor), name
    assert torch.equal(again.vertices, scene.mesh[0])
    assert torch.equal(again.triangles, scene.mesh[1])


def test_size_and_values(scene: Scene):
    gaussians = scene.gaussians
    assert 70_000 <= len(gaussians) <= 90_000
    assert gaussians.sh_degree == 0
    gaussians.check_finite()
    assert gaussians.scales.min() > 0
    assert ((gaussians.opacities > 0) & (gaussians.opacities < 1)).all()
    torch.testing.assert_close(gaussians.quats.norm(dim=1), torch.ones(len(gaussians)))
    shown = gaussians.colors[:, 0] * 0.28209479177387814 + 0.5
    assert shown.min() > -1e-6
    assert shown.max() < 1 + 1e-6
    assert 36 <= len(scene.cameras) <= 44
    assert (scene.cameras.width, scene.cameras.height) == (960, 640)


def test_a_ruler_laid_in_the_courtyard_reads_metres(scene: Scene):
    """Straight down from 3 m above the ground: the table top is 0.75 m high, the terrace beside it lies at 0."""
    frame = scene.frame
    assert frame.metres_per_unit != 1.0
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # x right, y to -y, z down
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[:, :3, :3] = down @ frame.rotation
    for k, point in enumerate(([0.4, 0.0, 3.0], [1.5, 0.0, 3.0])):
        viewmats[k, :3, 3] = -viewmats[k, :3, :3] @ frame.to_scene(torch.tensor(point))
    straight_down = Cameras(viewmats, torch.tensor([[50.0, 0, 0.5], [0, 50.0, 0.5], [0, 0, 1.0]]).repeat(2, 1, 1), 1, 1)
    depth = frame.metres_per_unit * demo_depth(straight_down).flatten()
    torch.testing.assert_close(depth, torch.tensor([2.25, 3.0]), atol=1e-4, rtol=0)


def test_rendered_depth_is_the_depth_of_the_mesh(scene: Scene):
    cameras = scene.cameras[torch.tensor([0, 13, 26, 39])].resized(240, 160)
    rendering = choose_rasterizer(scene.gaussians, torch.device("cpu")).render(cameras)
    truth, solid = demo_hits(cameras)
    error = scene.frame.metres_per_unit * (rendering.depth - truth)[solid].abs()
    assert 0.5 < solid.float().mean() < 0.9
    assert error.median() < 0.05
    assert error.quantile(0.9) < 0.35
    # Everything is closed: behind what is modelled comes the dome of the sky.
    assert rendering.accumulation.min() > 0.97


def test_most_gaussians_lie_on_the_mesh(scene: Scene, rays: o3d.t.geometry.RaycastingScene):
    means = scene.frame.to_metric(scene.gaussians.means)
    distance = torch.from_numpy(rays.compute_distance(o3d.core.Tensor(means.numpy())).numpy())
    assert (distance < 0.003).float().mean() > 0.6
    near = means[:, :2].norm(dim=1) < 10
    assert (distance[near] < 0.10).float().mean() > 0.95


def test_no_camera_stands_in_something(scene: Scene, rays: o3d.t.geometry.RaycastingScene):
    """Clear of every surface, and whatever solid it sees, it sees from outside."""
    eyes = scene.frame.to_metric(scene.cameras.centers)
    assert rays.compute_distance(o3d.core.Tensor(eyes.contiguous().numpy())).numpy().min() > 0.25
    assert eyes[:, 2].min() > 1.2
    assert eyes[:, 2].max() < 2.0
    _, solid = demo_hits(small := scene.cameras.resized(48, 32))
    v, u = torch.meshgrid(torch.arange(32) + 0.5, torch.arange(48) + 0.5, indexing="ij")
    for eye, K, viewmat, is_solid in zip(eyes, small.Ks, scene.cameras.viewmats, solid, strict=True):
        local = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1)
        direction = local @ viewmat[:3, :3] @ scene.frame.rotation.T
        hit = rays.cast_rays(o3d.core.Tensor(torch.cat([eye.expand_as(direction), direction], dim=-1).numpy()))
        facing = (torch.from_numpy(hit["primitive_normals"].numpy()) * direction).sum(-1)
        assert (facing[is_solid] < 0).float().mean() > 0.999


def test_every_camera_sees_the_vase_and_most_see_sky(scene: Scene):
    vase = scene.frame.to_scene(torch.tensor([0.0, 0.0, 0.9]))
    at = (scene.cameras.viewmats[:, :3, :3] @ vase + scene.cameras.viewmats[:, :3, 3])[:, :, None]
    pixel = (scene.cameras.Ks @ at)[:, :2, 0] / at[:, 2]
    assert ((pixel > 0.2 * torch.tensor([960, 640])) & (pixel < 0.8 * torch.tensor([960, 640]))).all()
    depth = demo_depth(scene.cameras.resized(48, 32))
    distance = depth[torch.arange(len(depth)), (pixel[:, 1] / 20).long(), (pixel[:, 0] / 20).long()]
    # The vase is 0.24 m wide: its front lies nearer than its middle by its radius.
    assert (scene.frame.metres_per_unit * (distance - at[:, 2, 0])).abs().max() < 0.25
    assert (torch.isinf(depth).flatten(1).float().mean(1) > 0.05).float().mean() > 0.6


def test_depth_of_a_missed_pixel_is_infinite(scene: Scene):
    up = torch.eye(4)[None].clone()
    up[0, :3, 3] = -(scene.cameras.centers[0])
    sky = Cameras(up, torch.tensor([[[10.0, 0, 2], [0, 10.0, 2], [0, 0, 1]]]), 4, 4)
    depth, solid = demo_hits(sky)
    assert (depth == math.inf).all()
    assert not solid.any()
