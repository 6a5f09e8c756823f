"""The cloud without simulation: still until it learns, bounded, without memory, and as easy to train as a roll-out."""

import math

import pytest
import torch
from dynamics_particles import falling, looks

from pgsd_nerfstudio.dynamics import (
    Deformation,
    DeformationConfig,
    DeformedCloud,
    LearnedLook,
    RegularizationWeights,
    regularization,
    scattered,
)

BOX = torch.tensor([[-1.0, 0.0, 0.5], [3.0, 2.0, 4.5]])
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def cloud(weights=0.0, count=50) -> DeformedCloud:
    history = scattered(BOX, falling(), count)
    torch.manual_seed(0)
    deformation = Deformation(BOX, history.frames)
    if weights:
        for parameter in deformation.net.heads.parameters():
            torch.nn.init.normal_(parameter, 0.0, weights)
    return DeformedCloud(history, looks(count), deformation, LearnedLook())


def test_particles_are_spread_evenly_over_the_box_and_fly_in_all_frames():
    history = scattered(BOX, falling(), 4000)
    start = history.positions_at(0, torch.arange(4000))
    share = (start - BOX[0]) / (BOX[1] - BOX[0])
    assert (share >= 0).all() and (share <= 1).all()
    # Mean, variance and independent axes of a uniform distribution, within five standard errors.
    assert (share.mean(0) - 0.5).abs().max() < 5 / math.sqrt(12 * 4000)
    assert (share.var(0) - 1 / 12).abs().max() < 5 * math.sqrt(1 / 180 / 4000)
    assert (torch.corrcoef(share.T) - torch.eye(3)).abs().max() < 5 / math.sqrt(4000)
    for frame in (0, 20, history.frames - 1):
        assert len(history.active(frame)) == 4000 and len(history.resting(frame)) == 0
        assert torch.equal(history.positions_at(frame, torch.arange(4000)), start)
    assert torch.equal(scattered(BOX, falling(), 9).positions, scattered(BOX, falling(), 9).positions)


def test_untrained_nothing_moves_and_the_look_is_the_initial_one_bit_for_bit():
    roll = cloud()
    active, every = roll.look.active, torch.arange(50)
    for instant in roll.window(0, len(roll)):
        g = instant.gaussians
        truth = (roll.history.positions_at(0, every), roll.history.quats, active.scales, active.opacity, active.rgb)
        assert all(torch.equal(getattr(g, name), value) for name, value in zip(FIELDS, truth, strict=True))


@pytest.mark.parametrize("weights", [0.1, 1.0, 10.0, 1e6])
def test_no_weights_lead_beyond_the_bounds(weights):
    roll = cloud(weights)
    largest = 0.5 * (BOX[1] - BOX[0]) + 1e-5
    for instant in roll.window(0, len(roll)):
        g = instant.gaussians
        g.check_finite()
        assert (instant.offset.abs() <= largest).all()
        assert (g.scales <= 8.001 * roll.look.active.scales).all() and (g.scales >= roll.look.active.scales / 8.001).all()
        assert (g.opacities >= 0).all() and (g.opacities <= 1).all() and (g.colors >= 0).all() and (g.colors <= 1).all()
        torch.testing.assert_close(g.quats.norm(dim=1), torch.ones(50), rtol=0, atol=1e-5)


def test_reach_is_a_share_of_the_box():
    deformation = Deformation(BOX, 40, DeformationConfig(reach=0.1))
    with torch.no_grad():
        deformation.net.heads["position"].bias.fill_(100.0)
    moved, _, _ = deformation(torch.zeros(3, 3), 5)
    torch.testing.assert_close(moved, torch.tensor([[0.4, 0.2, 0.4]]).expand(3, 3))


def test_a_frame_does_not_depend_on_how_it_is_reached():
    roll = cloud(0.3)
    visible = torch.arange(50) % 3 == 0
    for instant, some in zip(roll.window(17, 9), roll.window(17, 9, visible=visible), strict=True):
        for name in FIELDS:
            here = getattr(instant.gaussians, name)
            torch.testing.assert_close(getattr(roll.gaussians(instant.frame), name), here, rtol=0, atol=1e-6)
            torch.testing.assert_close(getattr(some.gaussians, name), here[visible], rtol=0, atol=1e-6)
        assert torch.equal(instant.gaussians.means, instant.offset + roll.history.positions_at(0, instant.active))
    assert roll.gaussians(17).means.sub(roll.gaussians(25).means).abs().max() > 0.01


def test_deltas_add_up_to_what_has_changed():
    roll = cloud(0.1)
    first, *rest = roll.window(10, 9)
    assert roll.window(0, 2)[0].deltas is None and first.deltas is not None
    moved = sum(instant.deltas.active.velocity for instant in rest)
    torch.testing.assert_close(rest[-1].offset - first.offset, moved, rtol=0, atol=1e-5)
    bright = sum(instant.deltas.active.change.rgb for instant in rest)
    torch.testing.assert_close(rest[-1].gaussians.colors - first.gaussians.colors, bright, rtol=0, atol=1e-5)


def test_it_trains_like_a_roll_out_from_zero():
    """A fall of 4 cm a frame, learned from clips alone: the mean error shrinks to a fraction."""
    roll = cloud(count=10)
    weights = RegularizationWeights(without=("xyz", "vel", "rot"))
    optimizer = torch.optim.Adam(roll.deformation.parameters(), lr=3e-3)
    errors = []
    for step in range(60):
        clip = roll.window(step * 7 % 36, 4)
        down = [r.offset[:, 2] + 0.04 * (r.frame - 20) for r in clip]
        loss = torch.cat(down).square().mean()
        errors.append(float(loss.detach()))
        optimizer.zero_grad()
        (loss + weights.total(regularization(clip, roll.learned_look), 1e-6)).backward()
        assert all(p.grad is None or torch.isfinite(p.grad).all() for p in roll.deformation.parameters())
        optimizer.step()
    assert sum(errors[-10:]) < 0.1 * sum(errors[:10])


def test_what_is_born_or_lands_is_no_cloud():
    history = falling()
    with pytest.raises(ValueError, match=r"neither births nor landings, but \d+ of 60 particles"):
        DeformedCloud(history, looks(60), Deformation(BOX, 40))
    with pytest.raises(ValueError, match="at least one particle and one to be like, got 0 like 60"):
        scattered(BOX, history, 0)


def test_clips_and_frames_outside_are_refused_and_nan_is_named():
    roll = cloud()
    with pytest.raises(IndexError, match="does not fit into 40 frames"):
        roll.window(35, 9)
    with pytest.raises(IndexError, match="frames 0 to 39, asked for 40"):
        roll.gaussians(40)
    with pytest.raises(IndexError, match="frames 0 to 39, asked for 40"):
        list(roll.frames(38, 41))
    with pytest.raises(ValueError, match="at least one frame, got gradient_frames = 0"):
        roll.window(5, 3, gradient_frames=0)
    with torch.no_grad():
        roll.deformation.net.heads["scale"].bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"frame 11 of the roll-out: \d+ values of the Gaussians' scales"):
        roll.window(11, 3)
