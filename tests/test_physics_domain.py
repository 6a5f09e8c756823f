"""The simulated air is where cameras see it: in the middle of a room, before the wall of a building, around a drone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rounds import round_of

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.physics.clock import Clock, Domain, domain_of
from pgsd_nerfstudio.physics.metric import simulate_metric
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


def seen_by(cameras: Cameras) -> Scene:
    return Scene("test", Gaussians.empty(), cameras, Frame(1.0, torch.eye(3), torch.zeros(3)))


def test_around_a_middle_the_air_reaches_a_little_beyond_the_cameras():
    domain = domain_of(seen_by(round_of(4, 3.0, 1.5, target=1.5)))  # on the axes; 5 m ahead of each is 2 m beyond the middle
    assert domain.lower == pytest.approx((-4.5, -4.5, -0.3), abs=1e-5)
    assert domain.upper == pytest.approx((4.5, 4.5, 3.5), abs=1e-5)


def test_cameras_that_look_into_the_widest_middle_have_their_air_there():
    domain = domain_of(seen_by(round_of(36, 13.0, 1.5, target=1.5)))
    assert domain.lower[:2] == pytest.approx((-10, -10), abs=1e-4) and domain.upper[:2] == pytest.approx((10, 10), abs=1e-4)


@pytest.mark.parametrize(("radius", "height"), [(30.0, 1.6), (50.0, 1.6), (60.0, 15.0), (120.0, 90.0), (400.0, 100.0)])
def test_far_around_a_building_and_from_a_drone_flakes_fall_where_the_preview_ends(radius, height):
    scene = seen_by(round_of(48, radius, height, target=1.0))
    domain, end = domain_of(scene), slow_path(scene, frames=250)[249].centers[0].numpy()
    assert domain.distances(end[None])[0] == 0
    assert max(domain.size) <= 25 and domain.lower[2] == pytest.approx(max(height - 20.0, 0.0) - 0.3)
    cameras = scene.frame.cameras_to_metric(scene.cameras)
    run = simulate_metric(
        SurfaceMesh.empty(), effect("snowfall"), Clock(frames=2), domain, max_particles=4000, cameras=cameras, progress=False
    )
    near = np.linalg.norm(run.positions_at(1, run.active(1)).numpy() - end, axis=1) < 10
    assert near.sum() > 200


def test_the_distance_from_a_box_is_that_to_its_nearest_point():
    box = Domain((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = np.array([[0.5, 1.0, 2.9], [4.0, 6.0, 3.0], [-1.0, -2.0, -2.0]])
    assert box.distances(points) == pytest.approx([0.0, 5.0, 3.0])


def test_cameras_high_and_low_keep_the_ground():
    high, low = round_of(12, 6.0, 80.0), round_of(12, 6.0, 1.5)
    both = Cameras(torch.cat([high.viewmats, low.viewmats]), torch.cat([high.Ks, low.Ks]), 128, 128)
    assert domain_of(seen_by(both)).lower[2] == pytest.approx(-0.3)


def test_one_camera_has_air_before_it():
    domain: Domain = domain_of(seen_by(round_of(1, 400.0, 1.5, target=1.5)))
    assert domain.lower[0] < 395 and domain.upper[0] > 400
