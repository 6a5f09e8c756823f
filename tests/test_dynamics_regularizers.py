"""The terms of the joint loss: values by hand, and gradients that are finite where the textbook formula's are not."""

import math

import pytest
import roma
import torch
from dynamics_particles import falling, rollout

from pgsd_nerfstudio.dynamics import RegularizationWeights, drift, regularization
from pgsd_nerfstudio.dynamics.look import OPACITY_UNIT
from pgsd_nerfstudio.dynamics.regularizers import APPEARANCE, quaternion_difference, rotation_angle, safe_norm


def quaternions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1
    )


def test_rotation_angle_is_the_papers_arccos():
    a, b = quaternions(200), quaternions(400)[200:]
    torch.testing.assert_close(rotation_angle(a, b), 2 * torch.arccos((a * b).sum(1).abs()), rtol=0, atol=2e-6)


def test_rotation_angle_is_that_of_the_turn_between():
    a = quaternions(50)
    turn = (
        torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1) * torch.linspace(0, math.pi, 50)[:, None]
    )
    b = roma.quat_xyzw_to_wxyz(roma.quat_product(roma.quat_wxyz_to_xyzw(a), roma.rotvec_to_unitquat(turn)))
    torch.testing.assert_close(rotation_angle(a, b), torch.linspace(0, math.pi, 50).double(), rtol=0, atol=2e-6)


@pytest.mark.parametrize("case", ["identity", "antipodal", "half_turn"])
def test_rotation_gradient_is_finite(case):
    b = quaternions(30).float()
    half = roma.quat_xyzw_to_wxyz(roma.quat_product(roma.quat_wxyz_to_xyzw(b), torch.tensor([1.0, 0, 0, 0]).expand(30, 4)))
    a = {"identity": b, "antipodal": -b, "half_turn": half}[case].clone().requires_grad_()
    angle = rotation_angle(a, b)
    truth = math.pi if case == "half_turn" else 0.0
    torch.testing.assert_close(angle, torch.full((30,), truth), rtol=0, atol=1e-5)
    (gradient,) = torch.autograd.grad(angle.sum(), a)
    assert torch.isfinite(gradient).all() and gradient.norm(dim=1).max() < 2.5


def test_quaternion_difference_is_that_of_the_nearer_sign_and_a_quarter_of_the_squared_angle():
    a, b = quaternions(200), quaternions(400)[200:]
    nearer = torch.minimum((a - b).square().sum(1), (a + b).square().sum(1))
    torch.testing.assert_close(quaternion_difference(a, b), nearer, rtol=0, atol=1e-14)
    slightly = roma.quat_xyzw_to_wxyz(
        roma.quat_product(roma.quat_wxyz_to_xyzw(a), roma.rotvec_to_unitquat(0.01 * torch.randn(200, 3, dtype=torch.float64)))
    )
    torch.testing.assert_close(
        quaternion_difference(slightly, a), rotation_angle(slightly, a).square() / 4, rtol=1e-3, atol=1e-8
    )


def test_norm_is_the_norm_and_smooth_at_zero():
    x = torch.tensor([[3.0, 4.0], [0.0, 0.0], [0.0, 0.01]], requires_grad=True)
    torch.testing.assert_close(safe_norm(x), torch.tensor([5.0, 0.0, 0.01]), rtol=0, atol=2e-6)
    (gradient,) = torch.autograd.grad(safe_norm(x).sum(), x)
    torch.testing.assert_close(gradient, torch.tensor([[0.6, 0.8], [0.0, 0.0], [0.0, 1.0]]), rtol=0, atol=1e-6)


def test_untrained_clip_has_nothing_to_regularize_but_a_finite_gradient():
    roll = rollout(falling())
    terms = regularization(roll.window(10, 9), roll.learned_look)
    assert all(abs(float(value.detach())) < 1e-6 for value in terms.values())
    RegularizationWeights().total(terms, 1e6).backward()
    gradients = [p.grad for p in [*roll.field.parameters(), *roll.learned_look.parameters()] if p.grad is not None]
    assert gradients and all(torch.isfinite(g).all() for g in gradients)


def test_terms_are_means_over_gaussians_and_frames():
    """A field whose heads are constant: every step adds the same, so that each term is known."""
    history = falling()
    roll = rollout(history)
    field, bounds = roll.field, roll.field.bounds
    with torch.no_grad():
        for net in (field.active_net, field.collided_net):
            for name, head in net.heads.items():
                head.bias[0] = 0.1 if name != "rgb" else -0.2
        assert roll.learned_look is not None
        roll.learned_look.collided[1:4] = torch.tensor([0.0, 0.3, 0.4])
        # What growing thins is thickened again, so that the size alone is left.
        roll.learned_look.collided[0] = 2 * 0.7 / 3 / OPACITY_UNIT
    clip = roll.window(10, 5)
    terms = {name: float(value.detach()) for name, value in regularization(clip, roll.learned_look).items()}
    small, large = math.tanh(0.1), math.tanh(0.2)
    assert terms["vel"] == pytest.approx(bounds.velocity * small, rel=1e-3)
    for state in ("active", "collided"):
        assert terms[f"{state}_opacity"] == pytest.approx(bounds.opacity * small, rel=1e-3)
        assert terms[f"{state}_scale"] == pytest.approx(bounds.log_scale * small, rel=1e-3)
        assert terms[f"{state}_rgb"] == pytest.approx(bounds.rgb * large, rel=1e-3)
    ages = [instant.frame - history.births[instant.active] for instant in clip]
    every = torch.cat(ages).float()
    assert terms["rot"] == pytest.approx(float((every * bounds.rotation * small).mean()), rel=1e-3)
    assert terms["xyz"] == pytest.approx(
        float(torch.cat([instant.offset.detach().norm(dim=1) for instant in clip]).mean()), rel=1e-3
    )
    assert terms["look"] == pytest.approx(0.5, rel=0.05)


def test_squares_are_means_of_the_squares_of_what_the_norms_measure():
    roll = rollout(falling(), weights=0.1)
    assert roll.learned_look is not None
    with torch.no_grad():
        roll.learned_look.active += 0.05
    clip = roll.window(10, 5)
    terms = regularization(clip, roll.learned_look, "squares")
    assert terms.keys() == regularization(clip, roll.learned_look).keys()
    stepped = [instant.deltas for instant in clip if instant.deltas is not None]

    def mean(parts):
        return float(torch.cat([part.detach().reshape(len(part), -1).square().sum(1) for part in parts]).mean())

    truth = {
        "xyz": mean(instant.offset for instant in clip),
        "vel": mean(deltas.active.velocity for deltas in stepped),
        "active_scale": mean(deltas.active.change.log_scale for deltas in stepped),
        "collided_rgb": mean(deltas.collided.rgb for deltas in stepped),
        "look": sum(float(x.detach().square().sum()) for shift in roll.learned_look.bounded() for x in shift),
    }
    for name, value in truth.items():
        assert value > 0 and float(terms[name].detach()) == pytest.approx(value, rel=1e-5), name


def test_weights_are_the_papers_and_scale_together():
    weights, one = RegularizationWeights(), torch.ones(())
    assert (weights.xyz, weights.vel, weights.rot) == (0.1, 0.1, 0.1)
    assert (weights.active_opacity, weights.active_scale, weights.active_rgb) == (1.0, 1.0, 35.0)
    assert (weights.collided_opacity, weights.collided_scale, weights.collided_rgb) == (35.0, 35.0, 35.0)
    assert float(weights.total({"xyz": one, "active_rgb": one}, 2.0)) == pytest.approx(70.2)


def test_clip_without_particles_gives_zero_not_nan():
    history = falling()
    clip = rollout(history, weights=0.1).window(5, 3, visible=torch.zeros(len(history), dtype=torch.bool))
    assert all(float(value.detach()) == 0.0 for value in regularization(clip).values())
    assert drift(clip) == 0.0


def test_drift_is_zero_untrained_and_the_mean_distance_otherwise():
    history = falling()
    assert drift(rollout(history).frames()) == 0.0
    roll = rollout(history, weights=0.3)
    means = []
    for frame in range(len(roll)):
        active = history.active(frame)
        if len(active):
            x = roll.gaussians(frame).means[: len(active)]
            means.append(float((x - history.positions_at(frame, active)).norm(dim=1).mean()))
    assert drift(roll.frames()) == pytest.approx(sum(means) / len(means), rel=1e-4)


ONES = {name: torch.ones(()) for name in ("xyz", "vel", "rot", *APPEARANCE, "look")}


@pytest.mark.parametrize("name", list(ONES))
def test_a_term_left_out_takes_its_weight_from_the_sum(name):
    full, less = RegularizationWeights(), RegularizationWeights(without=(name,))
    assert float(full.total(ONES) - less.total(ONES)) == pytest.approx(getattr(full, name), abs=2e-5)
    assert set(less.weighted(ONES)) == set(ONES) - {name}
    # What is left out may be anything: it is not multiplied by zero.
    assert math.isfinite(float(less.total({**ONES, name: torch.tensor(math.nan)})))


def test_without_app_leaves_motion_and_look():
    weights = RegularizationWeights(without=("app",))
    assert set(weights.weighted(ONES)) == {"xyz", "vel", "rot", "look"}
    assert float(weights.total(ONES)) == pytest.approx(0.301)


@pytest.mark.parametrize("times", [0.1, 10.0])
def test_the_factor_multiplies_every_term(times):
    full, scaled = RegularizationWeights(), RegularizationWeights(times=times)
    assert float(scaled.total(ONES, 3.0)) == pytest.approx(times * float(full.total(ONES, 3.0)), rel=1e-6)
    for name, value in scaled.weighted(ONES, 3.0).items():
        assert float(value) == pytest.approx(3.0 * times * getattr(full, name), rel=1e-6)


def test_nothing_left_is_a_sum_of_zero():
    assert float(RegularizationWeights(times=0.0).total(ONES)) == 0.0
    assert float(RegularizationWeights(without=("app", "xyz", "vel", "rot", "look")).total(ONES)) == 0.0


def test_terms_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match=r"must be among xyz, .*look, app; found position"):
        RegularizationWeights(without=("xyz", "position"))
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        RegularizationWeights(times=-1.0)
