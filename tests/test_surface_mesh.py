"""The fused surface against shapes whose rays and nearest points are known in closed form: a ball over a floor."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rounds import pixel_rays, round_of

import pgsd_nerfstudio.surface.mesh as mesh_module
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.fusion import Fusion, fuse
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_from_depths, surface_of
from pgsd_nerfstudio.weather.loading import load_scene

VOXEL = 0.04  # m
CENTER, RADIUS = torch.tensor([0.1, 0.0, 0.7]), 0.5


def depth_of_ball_and_floor(cameras: Cameras) -> list[torch.Tensor]:
    """Exact depth along the optical axis; inf above the horizon."""
    centers, directions = pixel_rays(cameras)
    origins = centers[:, None, None, :].expand_as(directions)
    return list(torch.minimum(to_ball(origins, directions), to_floor(origins, directions)).float())


def to_ball(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Ray parameters of the first hits; inf for misses."""
    from_center = origins - CENTER.to(origins)
    a, b = directions.square().sum(-1), (directions * from_center).sum(-1)
    discriminant = b.square() - a * (from_center.square().sum(-1) - RADIUS**2)
    t = (-b - discriminant.clamp_min(0).sqrt()) / a
    return torch.where((discriminant > 0) & (t > 0), t, torch.inf)


def to_floor(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    t = -origins[..., 2] / directions[..., 2]
    return torch.where(t > 0, t, torch.inf)


@pytest.fixture(scope="module")
def ball_and_floor() -> SurfaceMesh:
    # The floor is moved off the voxel grid by the cameras' heights being none of its multiples; VOXEL / 2 would be worst.
    cameras = round_of(16, 2.5, 1.6, target=0.4, size=160, wave=0.7)
    return surface_from_depths(depth_of_ball_and_floor(cameras), cameras, torch.tensor([0.0, 0.0, 0.4]), 2.5, VOXEL)


def falling(count: int, within: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays down from 2.5 m, slanting as snow in wind does."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.cat([within * (2 * torch.rand(count, 2, generator=generator) - 1), torch.full((count, 1), 2.5)], dim=1)
    directions = torch.tensor([0.2, -0.1, -1.0]) + 0.1 * torch.randn(count, 3, generator=generator)
    return origins, torch.nn.functional.normalize(directions, dim=1)


def test_rays_end_where_geometry_says(ball_and_floor):
    origins, directions = falling(4000, 1.2)
    ball, floor = to_ball(origins.double(), directions.double()), to_floor(origins.double(), directions.double())
    truth = torch.minimum(ball, floor)
    hits = ball_and_floor.cast(origins, directions)
    assert hits.distance.dtype == hits.normal.dtype == torch.float32
    # Rays that graze the ball, or end in the crease below it where no camera looks, may end on either surface.
    points = origins + truth[:, None] * directions
    clear = torch.where(
        torch.isfinite(ball), (points - CENTER)[:, 2] > 0.2 * RADIUS, (points[:, :2] - CENTER[:2]).norm(dim=1) > 0.7
    )
    error = (hits.distance - truth)[clear].abs() / VOXEL
    assert clear.sum() > 2000 and torch.isfinite(error).all()
    assert error.median() < 0.1 and error.quantile(0.99) < 0.5
    normals = torch.where(torch.isfinite(ball)[:, None], (points - CENTER) / RADIUS, torch.tensor([0.0, 0.0, 1.0]).double())
    cosine = (hits.normal * normals)[clear].sum(1)
    assert cosine.median() > math.cos(math.radians(3)) and cosine.quantile(0.01) > math.cos(math.radians(15))
    assert torch.allclose(hits.normal.norm(dim=1), torch.ones(4000), atol=1e-4)


def test_closest_points_lie_on_the_surface_and_normals_face_the_cameras(ball_and_floor):
    generator = torch.Generator().manual_seed(1)
    outward = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator).abs() * torch.tensor([1.0, -1, 1]), dim=1)
    for offset in (-0.1, 0.05, 0.3):  # from within and from without: the normal is that of the surface, not of the query
        found = ball_and_floor.closest(CENTER + (RADIUS + offset) * outward)
        for error in ((found.points - CENTER).norm(dim=1) - RADIUS, found.distance - abs(offset)):
            assert error.abs().median() < 0.3 * VOXEL and error.abs().quantile(0.95) < 0.5 * VOXEL
            assert error.abs().max() < 0.75 * VOXEL
        cosine = (found.normals * outward).sum(1)
        assert cosine.quantile(0.05) > math.cos(math.radians(20)) and cosine.min() > math.cos(math.radians(35))
    floor = torch.tensor([[1.5, 0.0, 0.2], [0.0, -1.5, -0.1], [-1.4, 0.3, 0.0]])
    found = ball_and_floor.closest(floor)
    assert found.points[:, 2].abs().max() < 0.5 * VOXEL and found.normals[:, 2].min() > 0.99


def test_normals_turn_smoothly_from_corner_to_corner():
    """A roof: at the eaves the slopes' own normals, at the ridge the mean of both."""
    vertices = torch.tensor([[0.0, -1, 1], [0, 1, 1], [1, 0, 0], [-1, 0, 0]])
    roof = SurfaceMesh(vertices, torch.tensor([[0, 2, 1], [0, 1, 3]], dtype=torch.int32))
    slope = math.sqrt(0.5)
    for x, expected in [(0.999, (slope, 0, slope)), (0.0, (0, 0, 1)), (-0.999, (-slope, 0, slope))]:
        start = torch.tensor([[x, 0.0, 2.0]])
        found = (
            roof.cast(start, torch.tensor([[0.0, 0, -1]])).normal,
            roof.closest(torch.tensor([[x, 0.0, 1 - abs(x)]])).normals,
        )
        assert [normal[0].tolist() for normal in found] == [pytest.approx(expected, abs=2e-3)] * 2


def test_distances_count_in_lengths_of_the_direction(ball_and_floor):
    origin = torch.tensor([[1.5, 0.5, 1.0]])
    one, half = (ball_and_floor.cast(origin, torch.tensor([[0.0, 0.0, -length]])).distance.item() for length in (1.0, 2.0))
    assert one == pytest.approx(1.0, abs=0.02) and half == pytest.approx(one / 2, rel=1e-5)
    missed = ball_and_floor.cast(origin, torch.tensor([[0.0, 0.0, 1.0]]))
    assert math.isinf(missed.distance.item()) and missed.normal.norm() == 0


def test_arrays_of_numpy_and_float64_are_welcome(ball_and_floor):
    points = np.array([[1.5, 0.0, 0.2], [0.0, 1.5, 0.3]])
    found = ball_and_floor.closest(points)
    assert found.points.dtype == torch.float32 and found.distance.tolist() == pytest.approx([0.2, 0.3], abs=0.02)
    assert ball_and_floor.cast(points, np.array([[0, 0, -1.0]] * 2)).distance.tolist() == pytest.approx([0.2, 0.3], abs=0.02)
    assert len(ball_and_floor.cast(points[:0], points[:0]).distance) == len(ball_and_floor.closest(points[:0]).points) == 0


def test_the_mesh_is_compact_and_reaches_no_further_than_asked(ball_and_floor):
    triangles = ball_and_floor.triangles
    assert ball_and_floor.vertices.dtype == torch.float32 and triangles.dtype == torch.int32
    assert triangles.unique().numel() == len(ball_and_floor.vertices)
    assert len(triangles) <= 400_000
    low, high = ball_and_floor.bounds
    assert (
        high[:2].max() < 2.5 * (mesh_module.REACH + 1)
        and low[2] > -2 * 6.25 * VOXEL
        and high[2] == pytest.approx(1.2, abs=0.05)
    )


def test_triangles_stay_within_their_budget(monkeypatch):
    cameras = round_of(6, 2.5, 1.6, target=0.4, size=64)
    monkeypatch.setattr(mesh_module, "MAX_TRIANGLES", {"near": 3000, "far": 1000})
    mesh = surface_from_depths(depth_of_ball_and_floor(cameras), cameras, torch.tensor([0.0, 0.0, 0.4]), 2.5, VOXEL)
    assert 1000 < len(mesh.triangles) <= 4000


def test_nothing_seen_is_an_empty_surface_that_nothing_hits():
    cameras = round_of(3, 2.5, 1.6, size=32)
    mesh = surface_from_depths([torch.full((32, 32), torch.inf)] * 3, cameras, torch.zeros(3), 2.5, VOXEL)
    assert len(mesh.triangles) == 0 and mesh.bounds.tolist() == [[0, 0, 0], [0, 0, 0]]
    points = torch.rand(4, 3)
    assert torch.isinf(mesh.cast(points, -torch.ones(4, 3)).distance).all()
    found = mesh.closest(points)
    assert torch.isinf(found.distance).all() and torch.equal(found.points, points)


@pytest.mark.parametrize("pixel", [(1, 2), (16, 16)])
def test_a_few_pixels_of_something_are_a_surface_or_none_but_no_error(pixel):
    cameras = round_of(3, 2.5, 1.6, size=32)
    depths = [torch.full((32, 32), torch.inf) for _ in range(3)]
    for depth in depths:
        depth[pixel] = 2.0
    fused = fuse(depths, cameras, Fusion(voxel=VOXEL, reach=10.0))
    assert len(fused[1]) == 0  # one pixel is a crumb


def floor_scene() -> Scene:
    """A floor of opaque discs at z = 0.3 scene units of half a metre each, under haze; seen from a ring."""
    x, y = torch.meshgrid(torch.linspace(-1.5, 1.5, 61), torch.linspace(-1.5, 1.5, 61), indexing="ij")
    floor = torch.stack([x.flatten(), y.flatten(), torch.full((61 * 61,), 0.3)], dim=1)
    haze = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([3.0, 3, 0.5]) + torch.tensor(
        [-1.5, -1.5, 0.4]
    )
    means, solid = torch.cat([floor, haze]), torch.arange(61 * 61 + 500) < 61 * 61
    scales = torch.where(solid[:, None], torch.tensor([0.025, 0.025, 0.001]), torch.full((3,), 0.05))
    opacities = torch.where(solid, 0.95, 0.05)
    gaussians = Gaussians(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1), scales, opacities, torch.zeros(len(means), 1, 3)
    )
    frame = Frame(0.5, torch.eye(3), torch.tensor([0.0, 0.0, 0.3]))
    return Scene("floor", gaussians, round_of(8, 2.5, 1.8, target=0.3, size=96), frame)


def test_a_scene_is_fused_in_metres_and_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path))
    scene = floor_scene()
    rasterizer = choose_rasterizer(scene.gaussians, "cpu")
    mesh = surface_of(scene, rasterizer, progress=False)
    origins = torch.cat(
        [torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) - 0.5, torch.full((200, 1), 1.0)], dim=1
    )
    down = torch.tensor([0.0, 0.0, -1.0]).expand(200, 3)
    error = mesh.cast(origins, down).distance - 1.0
    assert error.abs().quantile(0.95) < 0.0125 and error.abs().max() < 0.02  # m; discs of 1.25 cm, haze ignored

    (stored,) = Path(tmp_path / "surfaces").iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(mesh_module, "render_depths", lambda *_, **__: pytest.fail("the stored surface was not read"))
        again = surface_of(scene, rasterizer, progress=False)
    assert torch.equal(again.vertices, mesh.vertices) and torch.equal(again.triangles, mesh.triangles)

    stored.write_bytes(stored.read_bytes()[:1000])
    rebuilt = surface_of(scene, rasterizer, progress=False)
    assert torch.equal(rebuilt.vertices, mesh.vertices) and torch.equal(rebuilt.triangles, mesh.triangles)
    coarser = surface_of(scene, rasterizer, voxel=0.05, progress=False)
    assert len(coarser.triangles) < 0.5 * len(mesh.triangles)
    with pytest.raises(ValueError, match="positive number of metres"):
        surface_of(scene, rasterizer, voxel=0.0)


def under_a_sky(scene: Scene, radius: float, opacity: float = 0.95) -> Scene:
    """The scene in a sphere of large bright Gaussians; the radius is in scene units."""
    count, generator = 400, torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    sky = Gaussians(
        radius * directions,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 4 * radius / count**0.5),
        torch.full((count,), opacity),
        torch.ones(count, 1, 3),
    )
    return replace(scene, gaussians=concatenate([scene.gaussians, sky]))


@pytest.mark.parametrize("radius", [25.0, 300.0, 20_000.0])
def test_a_sphere_of_sky_changes_no_surface(radius):
    """The floor lets a thirtieth of the light through, which mixes the depth of the sky with its own."""
    scene = floor_scene()
    leaky = replace(scene, gaussians=replace(scene.gaussians, opacities=0.7 * scene.gaussians.opacities))
    bare, domed = (
        surface_of(one, choose_rasterizer(one.gaussians, "cpu"), cache=False, progress=False)
        for one in (leaky, under_a_sky(leaky, radius))
    )
    assert len(bare.triangles) > 1000
    assert torch.equal(domed.vertices, bare.vertices) and torch.equal(domed.triangles, bare.triangles)


def test_a_scene_that_is_all_sky_has_an_empty_surface():
    scene = floor_scene()
    nothing = replace(scene, gaussians=scene.gaussians.select(torch.zeros(len(scene.gaussians), dtype=torch.bool)))
    sky = under_a_sky(nothing, 1000.0)
    mesh = surface_of(sky, choose_rasterizer(sky.gaussians, "cpu"), cache=False, progress=False)
    assert len(mesh.triangles) == 0


@pytest.mark.slow
def test_the_garden_table_is_flat_and_its_ground_closed(garden_ply, garden_data):
    scene = load_scene(garden_ply, garden_data)
    mesh = surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), cache=False, progress=False)
    generator = torch.Generator().manual_seed(0)
    angle, down = 2 * math.pi * torch.rand(2000, generator=generator), torch.tensor([0.0, 0.0, -1.0]).expand(2000, 3)

    def heights(inner: float, outer: float, start: float) -> tuple[torch.Tensor, torch.Tensor]:
        radius = inner + (outer - inner) * torch.rand(2000, generator=generator)
        hits = mesh.cast(torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full((2000,), start)], dim=1), down)
        return start - hits.distance, hits.normal

    table, normals = heights(0.2, 0.45, 1.0)
    assert torch.isfinite(table).all() and 0.6 < table.median() < 0.75
    assert (table.quantile(0.84) - table.quantile(0.16)) / 2 < 0.02 and normals[:, 2].mean() > 0.95
    ground, normals = heights(1.15, 1.6, 0.5)
    hit = torch.isfinite(ground)
    assert hit.float().mean() > 0.9 and ground[hit].median().abs() < 0.08
    assert len(mesh.triangles) <= 400_000


@pytest.mark.slow
def test_snow_on_the_demo_lands_where_its_exact_mesh_is():
    scene = load_scene("demo")
    mesh = surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), cache=False, progress=False)
    exact = SurfaceMesh(scene.frame.to_metric(scene.mesh[0].float()), scene.mesh[1].int())
    origins, directions = falling(20_000, 2.5)
    truth, found = exact.cast(origins, directions).distance, mesh.cast(origins, directions).distance
    hit = torch.isfinite(truth)
    assert torch.isfinite(found[hit]).float().mean() > 0.99
    error = (found - truth)[hit & torch.isfinite(found)].abs()
    assert error.median() < 0.02 and (error < 0.04).float().mean() > 0.85  # m; voxels of 4 cm
