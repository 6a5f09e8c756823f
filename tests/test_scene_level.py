"""A splat without cameras: which way is up is seen from its largest plane, and cameras are made around its middle."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import roma
import torch

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import estimate_frame
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.level import middle_of, upright
from pgsd_nerfstudio.scene.loading import read_scene
from pgsd_nerfstudio.scene.orbit import VIEWS, orbit
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.splats.reading import read_splat


def sheet(count: int, size: float, seed: int) -> Gaussians:
    """A square of flat Gaussians in the plane z = 0, with some noise."""
    draw = torch.Generator().manual_seed(seed)
    means = torch.cat(
        [(torch.rand(count, 2, generator=draw) - 0.5) * size, 0.01 * torch.randn(count, 1, generator=draw)], dim=1
    )
    noise = torch.nn.functional.normalize(torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(count, 4, generator=draw), dim=1)
    scales = torch.tensor([1.5, 1.5, 0.1]) * size / math.sqrt(count)
    return Gaussians(means, noise, scales.repeat(count, 1), torch.full((count,), 0.9), torch.zeros(count, 1, 3))


def turned(gaussians: Gaussians, rotation: torch.Tensor, shift: torch.Tensor, size: float = 1.0) -> Gaussians:
    quats = roma.quat_product(
        roma.rotmat_to_unitquat(rotation).expand(len(gaussians), 4), roma.quat_wxyz_to_xyzw(gaussians.quats)
    )
    means = size * (gaussians.means @ rotation.T + shift)
    return replace(gaussians, means=means, quats=roma.quat_xyzw_to_wxyz(quats), scales=size * gaussians.scales)


def courtyard() -> Gaussians:
    """A floor of 6 x 6, a table, a smaller wall on one side, and blobs of plants above the floor."""
    upended = roma.rotvec_to_rotmat(torch.tensor([math.pi / 2, 0.0, 0.0]))
    draw = torch.Generator().manual_seed(9)
    plants = Gaussians(
        torch.rand(400, 3, generator=draw) * torch.tensor([5.0, 5.0, 1.5]) - torch.tensor([2.5, 2.5, 0.0]),
        torch.nn.functional.normalize(torch.randn(400, 4, generator=draw), dim=1),
        0.05 + 0.05 * torch.rand(400, 3, generator=draw),
        torch.full((400,), 0.9),
        torch.zeros(400, 1, 3),
    )
    wall = turned(sheet(500, 2.0, 2), upended, torch.tensor([0.0, 3.0, 1.0]))
    table = turned(sheet(300, 1.2, 3), torch.eye(3), torch.tensor([0.0, 0.0, 0.8]))
    return concatenate([sheet(3000, 6.0, 1), table, wall, plants])


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (1.0, -0.7, 0.4), (-2.0, 1.0, 0.0), (3.1, 0.0, 0.0)])
@pytest.mark.parametrize("size", [0.01, 100.0])
def test_up_is_across_the_largest_plane_and_away_from_nothing(turn, size):
    rotation = roma.rotvec_to_rotmat(torch.tensor(turn))
    found = upright(turned(courtyard(), rotation, torch.tensor([3.0, -2.0, 5.0]), size))
    assert found is not None
    assert math.degrees(math.acos(min(1.0, float(found @ rotation[:, 2].double())))) < 2.0


def test_where_no_plane_stands_out_nothing_is_guessed(tmp_path):
    draw = torch.Generator().manual_seed(4)
    means = torch.nn.functional.normalize(torch.randn(3000, 3, generator=draw), dim=1)
    # Flat Gaussians on a sphere: every direction has as many normals.
    quats = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(roma.special_gramschmidt(torch.stack([means, means.roll(1, 1)], 2))))
    scales = torch.tensor([0.005, 0.05, 0.05]).repeat(3000, 1)
    ball = Gaussians(means, quats, scales, torch.full((3000,), 0.9), torch.zeros(3000, 1, 3))
    assert upright(ball) is None
    cube = [roma.rotvec_to_rotmat(torch.tensor(t)) for t in ([0.0, 0, 0], [math.pi / 2, 0, 0], [0, math.pi / 2, 0])]
    walls = [turned(sheet(800, 2.0, k), turn, turn[:, 2] * side) for k, turn in enumerate(cube) for side in (1, -1)]
    assert upright(concatenate(walls)) is None
    assert upright(sheet(20, 1.0, 0)) is None


@pytest.mark.parametrize("size", [0.05, 1.0, 40.0])
def test_an_orbit_looks_at_the_middle_from_above_the_ground(size):
    rotation = roma.rotvec_to_rotmat(torch.tensor([1.0, -0.7, 0.4]))
    splat = turned(courtyard(), rotation, torch.tensor([3.0, -2.0, 5.0]), size)
    up = rotation[:, 2].double()
    cameras = orbit(splat, up)
    assert isinstance(cameras, Cameras) and len(cameras) == VIEWS
    frame = estimate_frame(cameras, splat, up=tuple(up.tolist()))
    heights = frame.to_metric(cameras.centers)[:, 2]
    assert heights.numpy() == pytest.approx(1.5, rel=0.02)
    floor = frame.to_metric(splat.means[:3000])[:, 2]
    assert float(floor.median().abs()) < 0.05
    middle = cameras.centers.mean(0)
    seen = cameras.viewmats[:, :3, :3] @ (middle - 0.7 * (heights[0] / frame.metres_per_unit) * up.float())
    seen = seen + cameras.viewmats[:, :3, 3]
    assert (seen[:, 2] > 0).all() and (seen[:, :2].norm(dim=1) < 0.2 * seen[:, 2]).all()
    # Held level: the horizontal axis of each camera is across up.
    assert (cameras.viewmats[:, 0, :3] @ up.float()).abs().max() < 1e-5


def test_an_orbit_keeps_out_of_what_stands_in_its_way():
    """Thick bushes where the orbit would be: it becomes smaller."""
    ring = torch.arange(4000) * 2 * math.pi / 4000
    free = orbit(courtyard(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).centers
    far = float((free - free.mean(0)).norm(dim=1).mean())
    draw = torch.Generator().manual_seed(0)
    heights = 2.5 * torch.rand(4000, generator=draw)
    means = torch.stack([far * ring.cos(), far * ring.sin(), heights], dim=1) + 0.1 * torch.randn(4000, 3, generator=draw)
    shape = torch.tensor([[1.0, 0, 0, 0]]).repeat(4000, 1), torch.full((4000, 3), 0.1)
    bushes = Gaussians(means, *shape, torch.full((4000,), 0.9), torch.zeros(4000, 1, 3))
    scene = concatenate([courtyard(), bushes])
    centers = orbit(scene, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).centers
    nearest = torch.cdist(centers, bushes.means).amin(1)
    assert float(nearest.median()) > 0.15


def test_a_splat_without_cameras_says_what_was_made_of_it(tmp_path):
    from test_weather_agreement import write_splat

    ply = write_splat(tmp_path / "yard.ply", courtyard())
    guessed = read_scene(ply, camera="orbit")
    assert len(guessed.cameras) == VIEWS and not guessed.photographs
    assert guessed.frame.rotation[2].tolist() == pytest.approx([0, 0, 1], abs=0.03)
    (remark,) = guessed.remarks
    assert "there are no cameras: 24 are made" in remark and "across its largest plane (0.00, 0.00, 1.00)" in remark
    assert "pass up=" in remark and "pass metres_per_unit=" in remark
    given = read_scene(ply, camera="orbit", up="-z", metres_per_unit=0.5)
    assert given.frame.rotation[2].tolist() == pytest.approx([0, 0, -1], abs=1e-6) and given.frame.metres_per_unit == 0.5
    assert "up as given" in given.remarks[0]
    cloud = courtyard().select(torch.arange(len(courtyard())) >= 3800)
    with pytest.raises(SceneError, match=r"no plane in .* stands out as the ground: pass up= too"):
        read_scene(write_splat(tmp_path / "cloud.ply", cloud), camera="orbit")


def test_up_in_the_garden_is_that_of_its_cameras(garden_ply: Path, garden_data: Path):
    scene = read_scene(garden_ply, garden_data)
    found = upright(read_splat(garden_ply).gaussians)
    assert found is not None
    assert math.degrees(math.acos(float(found @ scene.frame.rotation[2].double()))) < 3.0
    middle, _ = middle_of(scene.gaussians)
    assert scene.frame.to_metric(middle.float()).norm() < 1.0
