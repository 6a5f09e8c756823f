"""Every way to run the dynamics: untrained it is the simulation, with any weights bounded, and its gradient is what it says."""

from collections import deque
from copy import deepcopy
from dataclasses import replace
from itertools import product

import pytest
import torch
from dynamics_particles import double, falling, looks, rollout
from test_dynamics_rollout import FIELDS, assert_is_simulation

from pgsd_nerfstudio.dynamics import (
    DynamicsField,
    FieldConfig,
    LearnedLook,
    RegularizationWeights,
    Rollout,
    drift,
    gaps,
    regularization,
)
from pgsd_nerfstudio.dynamics.state import advance, simulated

APPEARANCES = ("per particle", "shared", "fixed")
OPTIONS = [
    (motion, FieldConfig(rotation=rotation, appearance=appearance))
    for motion, rotation, appearance in product(("particle", "field"), (True, False), APPEARANCES)
]
NAMES = [f"{motion}, {config.rotation}, {config.appearance}" for motion, config in OPTIONS]


def with_options(history, motion="particle", config=None, *, weights=0.0, stride=7) -> Rollout:
    """As `rollout`, with options; random heads of size `weights`."""
    torch.manual_seed(3)
    field = DynamicsField.for_history(history, config=config)
    if weights:
        with torch.no_grad():
            for head in field.heads():
                for parameter in head.parameters():
                    parameter.normal_(0.0, weights)
    return Rollout(history, looks(len(history)), field, LearnedLook(), stride=stride, motion=motion)


def test_the_defaults_are_the_papers_and_have_its_weights():
    plain, options = rollout(falling(), weights=0.3), with_options(falling(), weights=0.3)
    state = options.field.state_dict()
    assert set(state) == set(plain.field.state_dict())
    for name, value in plain.field.state_dict().items():
        assert torch.equal(value, state[name])
    for a, b in zip(plain.window(12, 9, gradient_frames=None), options.window(12, 9), strict=True):
        assert all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in FIELDS)


@pytest.mark.parametrize(("motion", "config"), OPTIONS, ids=NAMES)
def test_untrained_is_the_simulation_bit_for_bit_under_every_option(motion, config):
    roll = with_options(falling(), motion, config)
    assert roll.field.still()
    for frame in (0, 17, 39):
        assert_is_simulation(roll, roll.gaussians(frame), frame)
    for begin, gradient_frames in (("rollout", None), ("simulation", 1), ("rollout", 3)):
        # With gradient nothing is skipped: networks and grid are evaluated, and their zeros must change no bit.
        clip = roll.window(8, 12, begin=begin, gradient_frames=gradient_frames)
        for instant in clip:
            assert_is_simulation(roll, instant.gaussians, instant.frame)
        terms = regularization(clip, roll.learned_look)
        assert all(abs(float(value.detach())) < 1e-6 for value in terms.values())
        assert drift(clip) == 0.0
    gradients = torch.autograd.grad(
        RegularizationWeights().total(terms, 1e6), list(roll.field.parameters()), allow_unused=True, materialize_grads=True
    )
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def enduring(count=30, frames=40, landing=0):
    """Particles in the air from the first frame to the last, faster along x the higher; the first ones land half way."""
    history = falling(count=count)
    start = history.positions[history.offsets[:-1]]
    step = torch.stack([0.01 * start[:, 2], torch.zeros(count), torch.full((count,), -0.04)], 1)
    ends = torch.full_like(history.ends, frames)
    ends[:landing] = frames // 2
    paths = [start[i] + torch.arange(int(ends[i]))[:, None] * step[i] for i in range(count)]
    return replace(
        history,
        births=torch.zeros_like(history.births),
        ends=ends,
        collided=ends < frames,
        offsets=torch.cat([torch.zeros(1, dtype=torch.int64), ends.cumsum(0)]),
        positions=torch.cat(paths),
        rest_positions=torch.stack([path[-1] for path in paths]),
        frames=frames,
    )


@pytest.mark.parametrize(
    ("times", "motion", "appearance"),
    [
        (1, "particle", "per particle"),
        (10, "particle", "per particle"),
        (100, "particle", "shared"),
        (10, "field", "shared"),
        (100, "field", "per particle"),
    ],
)
def test_random_weights_stay_bounded_for_500_frames(times, motion, appearance):
    history = enduring(count=30, frames=500, landing=10)
    roll = with_options(history, motion, FieldConfig(appearance=appearance), weights=0.1 * times, stride=100)
    bounds, first = roll.field.bounds, roll.look
    # What the flow may add to the learned velocity: no more than it differs between two places at one time.
    elsewhere = 0.0
    if motion == "field":
        assert roll._flow is not None
        elsewhere = (roll._flow.values.amax(dim=1) - roll._flow.values.amin(dim=1)).amax(dim=0)
        assert elsewhere[0] > 0.01
    for instant in roll.afresh([*range(0, 500, 20), 249, 499]):
        g = instant.gaussians
        g.check_finite()
        ids = torch.cat([instant.active, instant.collided])
        largest = torch.cat([first.active.scales[instant.active], first.collided.scales[instant.collided]])
        assert (g.scales <= 8.001 * largest.maximum(first.active.scales[ids])).all() and (g.scales > 0).all()
        assert (g.opacities >= 0).all() and (g.opacities <= 1).all() and (g.colors >= 0).all() and (g.colors <= 1).all()
        age = (instant.frame - history.births[instant.active])[:, None]
        assert (instant.offset.abs() <= 1.00001 * (bounds.velocity + elsewhere) * age + 1e-6).all()
        torch.testing.assert_close(g.quats.norm(dim=1), torch.ones(len(g)), rtol=0, atol=1e-4)


def test_without_rotation_nothing_turns_and_there_is_no_head_for_it():
    roll = with_options(falling(), config=FieldConfig(rotation=False), weights=1.0)
    assert "rotation" not in roll.field.active_net.heads and "velocity" in roll.field.active_net.heads
    for instant in roll.window(8, 20):
        assert torch.equal(instant.quats, roll.history.quats[instant.active])
        assert instant.offset.abs().max() > 0
    assert abs(float(regularization(roll.window(8, 20))["rot"].detach())) < 1e-6


def test_shared_appearance_changes_all_particles_of_a_state_alike_and_differently_in_every_frame():
    roll = with_options(falling(), config=FieldConfig(appearance="shared"), weights=1.0)
    clip = roll.window(10, 5, begin="simulation")
    for state in ("active", "collided"):
        changes = [instant.deltas.active.change if state == "active" else instant.deltas.collided for instant in clip]
        for change in changes:
            for value in change:
                assert len(value) > 1 and torch.equal(value, value[:1].expand_as(value)) and value.abs().max() > 0
        assert len({float(change.opacity[0].detach()) for change in changes}) == len(changes)
    first = clip[0].deltas
    assert not torch.equal(first.active.change.rgb[0], first.collided.rgb[0])
    assert with_options(falling(), weights=1.0).window(10, 1)[0].deltas.active.change.opacity.std() > 0


def test_fixed_appearance_is_the_initial_look_whatever_is_learned():
    history = falling()
    roll = with_options(history, config=FieldConfig(appearance="fixed"), weights=1.0)
    assert roll.learned_look is not None
    with torch.no_grad():
        roll.learned_look.active.fill_(0.5)
    for instant in roll.window(10, 9):
        flying = roll.look.active.select(instant.active)
        n = len(instant.active)
        assert torch.equal(instant.gaussians.scales[:n], flying.scales)
        assert torch.equal(instant.gaussians.opacities[:n], flying.opacity)
        lying = roll.look.collided_at(history, instant.frame, instant.collided)
        assert torch.equal(instant.gaussians.colors[n:], lying.rgb)
        assert instant.offset.abs().max() > 0
    assert [name for name in roll.field.active_net.heads] == ["velocity", "rotation"]
    assert len(roll.field.collided_net.heads) == 0 and len(roll.field.shared_nets) == 0


def test_an_appearance_that_is_shared_or_fixed_trains():
    for appearance in ("shared", "fixed"):
        roll = with_options(falling(), config=FieldConfig(appearance=appearance))
        value = torch.stack([getattr(r.gaussians, name).sum() for r in roll.window(10, 5) for name in FIELDS]).sum()
        value.backward()
        for head in roll.field.heads():
            assert all(bool((parameter.grad != 0).any()) for parameter in head.parameters())


def test_gradient_runs_as_many_frames_as_asked():
    """With zero heads, dx(t)/d(bias of the velocity head) is the bound times the steps since the gradient was cut."""
    history = falling(count=200)
    flyer = next(int(i) for i in history.active(25) if not history.collided[i] and history.births[i] < 17)
    for gradient_frames, steps in ((None, 9), (1, 1), (2, 1), (3, 3), (4, 1), (5, 4), (9, 9), (20, 9)):
        roll = rollout(history)
        last = roll.window(17, 9, gradient_frames=gradient_frames)[-1]
        last.gaussians.means[last.active.tolist().index(flyer), 2].backward()
        gradient = roll.field.active_net.heads["velocity"].bias.grad
        torch.testing.assert_close(gradient, torch.tensor([0.0, 0.0, steps * roll.field.bounds.velocity]))


@pytest.mark.parametrize("motion", ["particle", "field"])
@pytest.mark.parametrize("k", [1, 2, 4, None])
def test_truncated_gradient_is_the_sum_of_the_paths_that_are_left(motion, k):
    """Twin in float64 that cuts nothing: each step has weights of its own, and the derivatives of each frame with respect to
    the steps of its own stretch are added."""
    roll = double(with_options(falling(count=30), motion, weights=0.05))
    roll.motion, start, frames = motion, 14, 6

    def value(instant):
        return torch.stack([getattr(instant.gaussians, name).sin().sum() for name in FIELDS]).sum()

    clip = roll.window(start, frames, begin="simulation", gradient_frames=k)
    found = torch.autograd.grad(torch.stack([value(r) for r in clip]).sum(), list(roll.field.parameters()))

    fields = [deepcopy(roll.field) for _ in range(frames)]
    state, look = simulated(roll.history, start - 1), roll._present_look()
    truth = [torch.zeros_like(p) for p in roll.field.parameters()]
    for t in range(frames):
        state, deltas = advance(state, roll.history, look, fields[t], None, roll._flow)
        of_this_frame = value(roll._rendered(state, look, deltas))
        for s in range(0 if k is None else t // k * k, t + 1):
            paths = torch.autograd.grad(
                of_this_frame, list(fields[s].parameters()), retain_graph=True, allow_unused=True, materialize_grads=True
            )
            truth = [a + b for a, b in zip(truth, paths, strict=True)]
    for a, b in zip(found, truth, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
    if k in (1, 2):
        whole = torch.autograd.grad(
            torch.stack([value(r) for r in roll.window(start, frames, begin="simulation")]).sum(), list(roll.field.parameters())
        )
        assert max(float((a - b).abs().max()) for a, b in zip(found, whole, strict=True)) > 1e-3


@pytest.mark.parametrize("frames", [0, -3])
def test_a_gradient_through_no_frame_is_refused(frames):
    with pytest.raises(ValueError, match=f"at least one frame, got gradient_frames = {frames}"):
        rollout(falling()).window(5, 3, gradient_frames=frames)


def steady() -> Rollout:
    """Particles that are all in the air in all 40 frames, with a velocity correction of 5 mm per frame along x."""
    roll = with_options(enduring())
    with torch.no_grad():
        roll.field.active_net.heads["velocity"].bias[0] = torch.atanh(torch.tensor(0.005 / roll.field.bounds.velocity))
    return roll


def test_gap_is_what_training_clips_do_not_see_of_a_steady_drift():
    """5 mm a frame: frame t of the roll-out has drifted by 5 t mm, frame k of a clip from the simulation by 5 (k + 1) mm."""
    roll = steady()
    found = gaps(roll, [(10, 4), (31, 9)])
    seen, shown, difference = found["simulation"]
    clips = [k + 1 for k in range(4)] + [k + 1 for k in range(9)]
    whole = [*range(10, 14), *range(31, 40)]
    assert seen == pytest.approx(0.005 * sum(clips) / 13, rel=1e-4)
    assert shown == pytest.approx(0.005 * sum(whole) / 13, rel=1e-4)
    assert difference == pytest.approx(shown - seen)
    assert found["rollout"].difference == pytest.approx(0.0, abs=1e-6)


def test_a_clip_starts_where_the_present_weights_have_led_what_flies_and_older_ones_what_lies():
    """Kept states of 5 mm a frame, weights of now 10 mm: a clip that starts at frame 16 is 16 times 10 mm off."""
    roll = steady()
    roll.refresh()
    with torch.no_grad():
        roll.field.active_net.heads["velocity"].bias[0] = torch.atanh(torch.tensor(0.01 / roll.field.bounds.velocity))
    kept = dict(roll._keyframes)
    assert gaps(roll, [(16, 1)])["rollout"] == (pytest.approx(0.16, rel=1e-4), pytest.approx(0.16, rel=1e-4), 0.0)
    assert roll.stale and roll._keyframes == kept

    roll = rollout(falling(), weights=0.3)
    roll.refresh()
    lying = roll.window(29, 1)[0].gaussians.colors[len(roll.history.active(29)) :].detach()
    with torch.no_grad():
        for head in roll.field.heads():
            head.bias += 0.3
    again = roll.window(29, 1)[0]
    assert not torch.equal(again.gaussians.colors[len(again.active) :], lying)  # its last frames are of now
    whole = next(roll.afresh([29]))
    torch.testing.assert_close(again.gaussians.means, whole.gaussians.means, rtol=0, atol=2e-6)
    torch.testing.assert_close(again.quats, whole.quats, rtol=0, atol=2e-6)
    flying = len(again.active)
    torch.testing.assert_close(again.gaussians.colors[:flying], whole.gaussians.colors[:flying], rtol=0, atol=2e-6)


def test_gap_is_zero_untrained_and_without_clips():
    assert gaps(rollout(falling()), [(0, 9), (20, 9)])["simulation"] == (0.0, 0.0, 0.0)
    assert gaps(rollout(falling(), weights=0.1), [])["simulation"] == (0.0, 0.0, 0.0)


def test_frames_afresh_are_those_of_a_roll_out_that_has_kept_nothing():
    roll, other = rollout(falling(), weights=0.3), rollout(falling(), weights=0.3)
    found = list(roll.afresh([30, 3, 17]))
    assert [instant.frame for instant in found] == [3, 17, 30] and not roll._keyframes
    for instant in found:
        torch.testing.assert_close(instant.gaussians.means, other.gaussians(instant.frame).means, rtol=0, atol=2e-6)
    with pytest.raises(IndexError, match="frames 0 to 39, asked for 40"):
        deque(roll.afresh([40]))


def test_by_field_a_frame_does_not_depend_on_how_it_is_reached():
    roll = with_options(enduring(), "field", weights=0.3)
    whole, other = list(roll.afresh(range(17, 26))), with_options(enduring(), weights=0.3)
    visible = torch.arange(30) % 3 == 0
    clips = zip(roll.window(17, 9), roll.window(17, 9, visible=visible), whole, strict=True)
    for instant, some, afresh in clips:
        here = instant.gaussians.means
        torch.testing.assert_close(roll.gaussians(instant.frame).means, here, rtol=0, atol=1e-5)
        torch.testing.assert_close(afresh.gaussians.means, here, rtol=0, atol=1e-5)
        torch.testing.assert_close(some.gaussians.means, here[visible], rtol=0, atol=1e-5)
        assert (other.gaussians(instant.frame).means - here).abs().max() > 0.01
