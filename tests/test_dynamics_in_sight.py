"""What a camera cannot show need not become Gaussians: no picture changes by it, and what is far fades in by its reach."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from dynamics_particles import falling, looks, rollout

from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
from pgsd_nerfstudio.dynamics.in_sight import Eye, faded_in, fading_in
from pgsd_nerfstudio.physics.air.reach import FADE
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.trial import random_cameras
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians


def rolling(history, exposure: float, size: float) -> Rollout:
    look = looks(len(history))
    active, collided = (replace(one, scales=size * one.scales) for one in (look.active, look.collided))
    return Rollout(
        history, replace(look, active=active, collided=collided), DynamicsField.for_history(history), exposure=exposure
    )


def eye_of(camera: Cameras) -> Eye:
    return Eye.of(camera, RasterConfig(), Frame(1.0, torch.eye(3), torch.zeros(3)))


@pytest.mark.parametrize("exposure", [0.0, 0.03])
@pytest.mark.parametrize("size", [0.3, 30.0])  # from specks to Gaussians that cover the picture
def test_pictures_of_what_is_in_sight_are_those_of_all(exposure, size):
    """Cameras inside the air: most particles lie behind or beside them, some cross the rim of the picture."""
    roll, scene = rolling(falling(3000), exposure, size), CpuRasterizer(Gaussians.empty())
    fewest = 1.0
    for seed in range(8):
        camera = random_cameras(1, 60, 44, seed)
        camera.viewmats[:, :3, 3] = -(camera.viewmats[:, :3, :3] @ torch.tensor([2.0, 2.0, 1.0]))
        frame = 4 * seed + 3
        # All of them, faded before the lens as the chosen ones are.
        whole = next(roll.frames(frame, frame + 1))
        seen, everything = roll.gaussians(frame, eye=eye_of(camera)), faded_in(whole, roll.history.reaches, eye_of(camera))
        fewest = min(fewest, len(seen) / len(everything))
        for found, expected in zip(scene.render(camera, seen), scene.render(camera, everything), strict=True):
            assert torch.equal(found, expected)
    assert fewest < 0.5  # otherwise nothing was left out


@pytest.mark.parametrize("frame", [0, 3, 6])  # of its birth, under way, and the last one
def test_a_streak_from_outside_of_the_picture_is_seen_in_it(frame):
    """Centred 12 pixels beside the picture, with a standard deviation of 12 pixels."""
    one = falling(300).select(torch.tensor([0]))
    steps = torch.arange(7.0)[:, None] - frame
    one = replace(
        one,
        births=torch.zeros(1, dtype=torch.int32),
        ends=torch.full((1,), 7, dtype=torch.int32),
        collided=torch.zeros(1, dtype=torch.bool),
        offsets=torch.tensor([0, 7]),
        positions=torch.tensor([4.2, 0.0, 5.0]) + steps * torch.tensor([4.0, 0.0, 0.0]),
    )
    roll, scene = rolling(one, 0.04, 10.0), CpuRasterizer(Gaussians.empty())
    K = torch.tensor([[[50.0, 0, 30], [0, 50, 22], [0, 0, 1]]])
    camera = Cameras(torch.eye(4)[None], K, 60, 44)
    pictures = [scene.render(camera, seen).rgb for seen in (roll.gaussians(frame, eye=eye_of(camera)), roll.gaussians(frame))]
    assert torch.equal(*pictures) and pictures[0].any()


def test_particles_fade_in_within_their_reach_and_are_missing_beyond():
    center, near = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 4.0, 4.0, 4.0, 1e9])
    distances = torch.tensor([4.1, 4.0, 4.0 / (1 + FADE / 2), 4.0 / (1 + FADE), 100.0])
    places = center + distances[:, None] * torch.tensor([0.0, 0.6, 0.8])
    small = torch.full((5,), 0.001)
    assert fading_in(places, near, small, center).tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0], abs=1e-5)
    lens = center + torch.tensor([0.2, 0.3, 0.45, 0.6, 1.5])[:, None] * torch.tensor([0.0, 0.6, 0.8])
    assert fading_in(lens, near, small, center).tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0], abs=1e-5)
    assert fading_in(lens, near, torch.full((5,), 0.5), center).tolist() == pytest.approx([0, 0, 0, 0, 0.5], abs=1e-5)

    history = falling(1500)
    roll = rolling(replace(history, reaches=torch.linspace(0.5, 3.0, 1500)), 0.0, 1.0)
    camera = random_cameras(1, 60, 44)
    camera.viewmats[:, :3, 3] = -(camera.viewmats[:, :3, :3] @ torch.tensor([2.0, 2.0, 1.0]))
    seen = roll.gaussians(10, eye=eye_of(camera))
    active = history.active(10)
    everything = rolling(history, 0.0, 1.0).gaussians(10)
    factor = torch.ones(len(everything))
    eye = torch.from_numpy(eye_of(camera).center).float()
    assert torch.allclose(eye, torch.tensor([2.0, 2.0, 1.0]), atol=1e-5)
    factor[: len(active)] = fading_in(
        everything.means[: len(active)],
        torch.linspace(0.5, 3.0, 1500)[active],
        everything.scales[: len(active)].amax(1),
        eye,
    )
    expected = replace(everything, opacities=everything.opacities * factor)
    scene = CpuRasterizer(Gaussians.empty())
    pictures = [scene.render(camera, one).rgb for one in (seen, expected, everything)]
    assert torch.equal(pictures[0], pictures[1]) and not torch.equal(pictures[0], pictures[2])
    assert len(seen) < len(everything)


def test_what_has_learned_to_move_is_shown_as_without_an_eye():
    """Its places are not those of the simulation, so none is left out; they fade in alike."""
    roll = rollout(falling(), weights=0.1)
    eye = eye_of(random_cameras(1, 60, 44))
    for name, expected in roll.gaussians(20).tensors.items():
        assert torch.equal(getattr(roll.gaussians(20, eye=eye), name), expected)
    with pytest.raises(ValueError, match="one camera, got 2"):
        eye_of(random_cameras(2, 60, 44))
