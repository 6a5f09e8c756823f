"""Encodings, field and learned look: shapes of the paper, bounds, and that zero is exactly nothing."""

import math

import pytest
import torch
from dynamics_particles import falling, looks, rollout

from pgsd_nerfstudio.dynamics import DynamicsField, LearnedLook
from pgsd_nerfstudio.dynamics.encodings import fourier, sinusoidal
from pgsd_nerfstudio.dynamics.field import StateNet
from pgsd_nerfstudio.dynamics.look import clamp
from pgsd_nerfstudio.dynamics.state import turned


def test_each_embedding_has_24_dimensions_as_in_the_paper():
    assert fourier(torch.zeros(5, 3)).shape == (5, 24)
    assert sinusoidal(0.5, torch.zeros(())).shape == (1, 24)


def test_fourier_features_are_sin_and_cos_of_four_octaves():
    x = torch.tensor([[0.3, -0.7, 0.11]], dtype=torch.float64)
    angles = [math.pi * 2**k * c for c in x[0].tolist() for k in range(4)]
    truth = [math.sin(a) for a in angles] + [math.cos(a) for a in angles]
    torch.testing.assert_close(fourier(x)[0], torch.tensor(truth, dtype=torch.float64))


def test_every_frame_of_ten_seconds_has_its_own_time_encoding():
    times = torch.cat([sinusoidal(frame / 250, torch.zeros(())) for frame in range(250)])
    distances = torch.cdist(times, times) + 10 * torch.eye(250)
    assert distances.min() > 0.3


def test_architecture_is_the_papers():
    field = DynamicsField(torch.tensor([[0.0] * 3, [1.0] * 3]), 0.1, 250)
    for net, heads in ((field.active_net, 13), (field.collided_net, 7)):
        assert (net.first.in_features, net.first.out_features) == (3 * 24 + 7, 128)
        assert (net.second.in_features, net.second.out_features) == (128, 128)
        assert sum(head.out_features for head in net.heads.values()) == heads


def test_shared_inputs_give_what_the_plain_network_gives():
    net = StateNet({"velocity": 3})
    torch.nn.init.normal_(net.heads["velocity"].weight)
    own, shared = torch.randn(20, 50), torch.randn(1, 29)
    plain = torch.nn.Sequential(net.first, torch.nn.ReLU(), net.second, torch.nn.ReLU(), net.heads["velocity"], torch.nn.Tanh())
    torch.testing.assert_close(net(own, shared)["velocity"], plain(torch.cat([own, shared.expand(20, 29)], dim=1)))


def test_field_is_still_until_a_head_moves():
    field = DynamicsField(torch.tensor([[0.0] * 3, [1.0] * 3]), 0.1, 250)
    assert field.still()
    with torch.no_grad():
        field.collided_net.heads["rgb"].bias[1] = 1e-8
    assert not field.still()


def test_fastest_speed_ignores_the_gap_between_two_particles():
    history = falling()
    fastest = max(
        float((p[1:] - p[:-1]).norm(dim=1).max())
        for p in history.positions.split((history.ends - history.births).tolist())
        if len(p) > 1
    )
    assert float(DynamicsField.for_history(history).speed) == pytest.approx(fastest)


def test_turning_by_nothing_is_exact_and_has_a_gradient():
    quats = torch.nn.functional.normalize(torch.randn(50, 4), dim=1)
    omega = torch.zeros(50, 3, requires_grad=True)
    out = turned(quats, omega)
    assert torch.equal(out, quats)
    out.square().sum().backward()
    (gradient,) = torch.autograd.grad(turned(quats, omega)[:, 1].sum(), omega)
    assert torch.isfinite(gradient).all() and gradient.abs().max() > 0.1


def test_learned_look_of_zero_is_the_initial_look_bit_for_bit():
    look = looks(40)
    shifted = LearnedLook()(look)
    for state in ("active", "collided"):
        for name in ("opacity", "scales", "rgb"):
            assert torch.equal(getattr(getattr(shifted, state), name), getattr(getattr(look, state), name))


def test_learned_look_shifts_the_logit_the_logarithm_and_the_colour():
    look, learned = looks(40), LearnedLook()
    with torch.no_grad():
        learned.active.copy_(torch.tensor([0.5, 0.1, 0.2, -0.3, -0.05, -0.1, 0.02]))
    bounded = learned.bounded()[0]
    shifted = learned(look).active
    torch.testing.assert_close(shifted.opacity.logit(), look.active.opacity.logit() + bounded.opacity, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(shifted.scales.log(), look.active.scales.log() + bounded.log_scale)
    torch.testing.assert_close(shifted.rgb, (look.active.rgb + bounded.rgb).clamp(0, 1))
    assert torch.equal(learned(look).collided.rgb, look.collided.rgb)


def test_growing_thins_a_flake_as_its_matter_spreads():
    """Faint matter: opacity times area stays, while the size is learned and the opacity is not."""
    faint, learned = looks(40), LearnedLook()
    faint.active.opacity.fill_(1e-3)
    with torch.no_grad():
        learned.active[1:4] = 0.4
    grown = learned(faint).active
    area = (grown.scales / faint.active.scales).prod(dim=1) ** (2 / 3)
    assert (area > 1.5).all()
    torch.testing.assert_close(grown.opacity * area, faint.active.opacity, rtol=1e-2, atol=0)


def test_learned_look_is_bounded_for_any_weights():
    look, learned = looks(40), LearnedLook()
    with torch.no_grad():
        learned.active.fill_(1e6)
        learned.collided.fill_(-1e6)
    shifted = learned(look)
    torch.testing.assert_close(shifted.active.scales, 8 * look.active.scales)
    torch.testing.assert_close(shifted.collided.scales, look.collided.scales / 8)
    assert torch.isfinite(shifted.active.opacity).all() and (shifted.collided.opacity > 0).all()
    assert (shifted.active.rgb == 1).all() and (shifted.collided.rgb == 0).all()


def test_both_looks_get_gradients_from_a_clip():
    roll = rollout(falling())
    clip = roll.window(10, 4)
    sum(r.gaussians.opacities.sum() + r.gaussians.scales.log().sum() + r.gaussians.colors.sum() for r in clip).backward()
    assert roll.learned_look is not None
    assert (roll.learned_look.active.grad != 0).all() and (roll.learned_look.collided.grad != 0).all()


def test_what_is_saturated_can_come_back_but_not_go_further():
    x = torch.tensor([-0.5, -0.5, 0.5, 1.5, 1.5], requires_grad=True)
    y = clamp(x, 0.0, 1.0)
    assert torch.equal(y, torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0]))
    y.backward(torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0]))
    # A descent step goes against the gradient: below the range only a negative one leads back, above it only a positive one.
    assert torch.equal(x.grad, torch.tensor([0.0, -1.0, 1.0, 1.0, 0.0]))
