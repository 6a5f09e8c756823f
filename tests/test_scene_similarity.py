"""A scene that is moved as a whole looks the same from a camera that is moved with it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from splat_files import a_cloud, covariances

from pgsd_nerfstudio.scene.similarity import moved
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


def a_transform(seed: int, mirrored: bool = False, scale: float = 1.7) -> torch.Tensor:
    torch.manual_seed(seed)
    transform = torch.eye(4, dtype=torch.float64)
    turn = roma.random_rotmat(dtype=torch.float64)
    transform[:3, :3] = scale * turn @ torch.diag(torch.tensor([1.0, 1.0, -1.0 if mirrored else 1.0], dtype=torch.float64))
    transform[:3, 3] = torch.tensor([3.0, -2.0, 0.5])
    return transform


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_colours_seen_from_a_moved_camera_stay(degree, mirrored):
    cloud, transform = a_cloud(degree=degree), a_transform(degree, mirrored)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.3, 5.0, 1.0])
    seen = view_colors(cloud.colors, cloud.means, viewmat)
    after = moved(cloud, transform)
    torch.testing.assert_close(view_colors(after.colors, after.means, viewmat @ torch.linalg.inv(transform)), seen)


@pytest.mark.parametrize("mirrored", [False, True])
def test_centres_and_ellipsoids_are_those_of_linear_algebra(mirrored):
    cloud, transform = a_cloud(), a_transform(9, mirrored)
    cloud = replace(cloud, displacements=cloud.means * 0.1, antialiased=True)
    after, linear = moved(cloud, transform), transform[:3, :3]
    torch.testing.assert_close(after.means, cloud.means @ linear.T + transform[:3, 3])
    torch.testing.assert_close(covariances(after), linear @ covariances(cloud) @ linear.T)
    torch.testing.assert_close(after.displacements, 0.1 * cloud.means @ linear.T)
    assert after.antialiased and torch.equal(after.opacities, cloud.opacities)


def test_there_and_back_is_where_it_was():
    cloud, transform = a_cloud(), a_transform(3, mirrored=True)
    back = moved(moved(cloud, transform), torch.linalg.inv(transform))
    for name in ("means", "scales", "colors"):
        torch.testing.assert_close(back.tensors[name], cloud.tensors[name])
    torch.testing.assert_close(covariances(back), covariances(cloud))


def test_what_is_no_similarity_is_refused():
    cloud = a_cloud()
    stretched = torch.diag(torch.tensor([1.0, 2.0, 1.0, 1.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="stretches or shears"):
        moved(cloud, stretched)
    for wrong in (0.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="of finite numbers"):
            moved(cloud, torch.diag(torch.tensor([wrong, wrong, wrong, 1.0], dtype=torch.float64)))
    bent = torch.eye(4, dtype=torch.float64)
    bent[3, 0] = 0.1
    with pytest.raises(ValueError, match="last row"):
        moved(cloud, bent)
