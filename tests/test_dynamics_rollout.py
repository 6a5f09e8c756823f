"""The roll-out against the simulation, against a plain per-particle loop of the paper's equations, and against itself."""

import math
from dataclasses import replace

import pytest
import roma
import torch
from dynamics_particles import double, falling, rollout

from pgsd_nerfstudio.dynamics import Rollout
from pgsd_nerfstudio.dynamics import rollout as rollout_module
from pgsd_nerfstudio.dynamics.look import LOG_SCALE_BOUND
from pgsd_nerfstudio.dynamics.state import LANDING_FRAMES

STATES = ("active", "collided")
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def assert_is_simulation(roll, gaussians, frame):
    history, look = roll.history, roll.look
    active, collided = history.active(frame), history.resting(frame)
    flying, lying = look.active.select(active), look.collided_at(history, frame, collided)
    truth = {
        "means": torch.cat([history.positions_at(frame, active), history.rest_positions[collided]]),
        "quats": torch.cat([history.quats[active], history.rest_quats[collided]]),
        "scales": torch.cat([flying.scales, lying.scales]),
        "opacities": torch.cat([flying.opacity, lying.opacity]),
        "colors": torch.cat([flying.rgb, lying.rgb]),
    }
    for name, values in truth.items():
        assert torch.equal(getattr(gaussians, name), values), f"{name} at frame {frame}"


def test_untrained_field_reproduces_the_simulation_bit_for_bit():
    roll = rollout(falling())
    for frame in range(len(roll)):
        assert_is_simulation(roll, roll.gaussians(frame), frame)
    # With gradient nothing is skipped: the networks run, and their zeros must change no bit.
    for instant in roll.window(0, len(roll)):
        assert_is_simulation(roll, instant.gaussians, instant.frame)


def test_an_open_shutter_shows_how_far_each_particle_flies_in_that_time():
    """On straight lines: exposure times velocity, which is the step from frame to frame times the frame rate."""
    history = falling()
    still = rollout(history)
    assert still.gaussians(12).displacements is None
    open_shutter = Rollout(history, still.look, still.field, exposure=0.02)
    for frame in (0, 12, len(open_shutter) - 1):
        gaussians, active = open_shutter.gaussians(frame), history.active(frame)
        for k, particle in enumerate(active.tolist()):
            rows = history.positions[history.offsets[particle] : history.offsets[particle + 1]]
            velocity = (rows[1] - rows[0]) * history.fps if len(rows) > 1 else torch.zeros(3)
            assert torch.allclose(gaussians.displacements[k], 0.02 * velocity, atol=1e-5)
        assert not gaussians.displacements[len(active) :].any()
    assert torch.equal(open_shutter.gaussians(12).means, still.gaussians(12).means)


def test_untrained_field_costs_nothing_without_gradient(monkeypatch):
    roll = rollout(falling())
    monkeypatch.setattr(rollout_module, "advance", lambda *_: pytest.fail("the networks were evaluated"))
    roll.refresh()
    roll.gaussians(len(roll) - 1)


@torch.no_grad()
def plain_loop(roll, particle):
    """The paper's eq. residual_motion for one particle, frame by frame: {frame: (x, R, opacity, scales, rgb)}."""
    history, field, look = roll.history, roll.field, roll.look
    i, out = torch.tensor([particle]), {}
    birth, end, landed = int(history.births[i]), int(history.ends[i]), bool(history.collided[i])

    def shown(initial, change, fade):
        opacity, log_scale, rgb = (fade * c for c in change)
        return type(initial)(initial.opacity + opacity, initial.scales * log_scale.exp(), initial.rgb + rgb)

    def summed(initial, change, delta):
        a, s, c = (x + dx for x, dx in zip(change, delta, strict=True))
        return (
            (initial.opacity + a).clamp(0, 1) - initial.opacity,
            s.clamp(-LOG_SCALE_BOUND, LOG_SCALE_BOUND),
            (initial.rgb + c).clamp(0, 1) - initial.rgb,
        )

    nothing = (torch.zeros(1).double(), torch.zeros(1, 3).double(), torch.zeros(1, 3).double())
    learned, quat, change, initial = torch.zeros(1, 3).double(), history.quats[i], nothing, look.active.select(i)
    for frame in range(birth, end):
        fade = [min(1.0, (end - 1 - f) / LANDING_FRAMES) if landed else 1.0 for f in (frame - 1, frame)]
        x_sim = history.positions_at(frame, i)
        if frame > birth:
            before = history.positions_at(frame - 1, i)
            delta = field.active(before + fade[0] * learned, x_sim - before, frame, shown(initial, change, fade[0]))
            learned = learned + delta.velocity
            matrix = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(quat)) @ roma.rotvec_to_rotmat(delta.rotation)
            quat = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(matrix))
            change = summed(initial, change, delta.change)
        out[frame] = (x_sim + fade[1] * learned, quat, shown(initial, change, fade[1]))
    change = nothing
    for frame in range(end, history.frames if landed else end):
        if frame > end:
            lying = shown(look.collided_at(history, frame - 1, i), change, 1.0)
            delta = field.collided(history.rest_positions[i], frame, lying)
            change = summed(look.collided_at(history, frame, i), change, delta)
        out[frame] = (history.rest_positions[i], history.rest_quats[i], shown(look.collided_at(history, frame, i), change, 1.0))
    return out


def test_rollout_follows_the_papers_equations_particle_by_particle():
    roll = double(rollout(falling(count=25), weights=0.3))
    truth = {particle: plain_loop(roll, particle) for particle in range(25)}
    for instant in roll.frames():
        ids = torch.cat([instant.active, instant.collided]).tolist()
        assert sorted(ids) == sorted(p for p in truth if instant.frame in truth[p])
        for row, particle in enumerate(ids):
            x, quat, look = truth[particle][instant.frame]
            g = instant.gaussians
            torch.testing.assert_close(g.means[row], x[0], rtol=0, atol=1e-10)
            assert abs(float((g.quats[row] * quat[0]).sum())) == pytest.approx(1.0, abs=1e-9)
            torch.testing.assert_close(g.opacities[row], look.opacity[0], rtol=0, atol=1e-10)
            torch.testing.assert_close(g.scales[row], look.scales[0], rtol=1e-9, atol=0)
            torch.testing.assert_close(g.colors[row], look.rgb[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("stride", [1, 7, 100])
def test_window_equals_random_access(stride):
    roll = rollout(falling(), weights=0.1, stride=stride)
    everything = list(roll.frames())
    for start in (0, 1, 13, len(roll) - 9):
        roll._last = None
        for instant in roll.window(start, 9):
            for name in FIELDS:
                there, here = getattr(everything[instant.frame].gaussians, name), getattr(instant.gaussians, name)
                torch.testing.assert_close(here, there, rtol=0, atol=2e-6)
            torch.testing.assert_close(roll.gaussians(instant.frame).means, instant.gaussians.means, rtol=0, atol=2e-6)


def test_only_visible_particles_are_evaluated_and_they_are_the_same():
    roll = rollout(falling(), weights=0.1)
    visible = torch.arange(len(roll.history)) % 3 == 0
    for some, every in zip(roll.window(12, 9, visible=visible), roll.window(12, 9), strict=True):
        ids = torch.cat([every.active, every.collided])
        assert torch.equal(torch.cat([some.active, some.collided]), ids[visible[ids]])
        for name in FIELDS:
            torch.testing.assert_close(
                getattr(some.gaussians, name), getattr(every.gaussians, name)[visible[ids]], rtol=0, atol=2e-6
            )


def test_gradient_is_that_of_central_differences():
    """Along a random direction of all weights, clear of kinks: white colours and walls of the domain, where values saturate."""
    roll = double(rollout(falling(count=30), weights=0.02))
    roll.look = replace(
        roll.look, **{name: replace(getattr(roll.look, name), rgb=torch.full((30, 3), 0.5).double()) for name in STATES}
    )
    roll.field.box += torch.tensor([[-1.0], [1.0]]).double()
    weights = list(roll.field.parameters())
    direction = [torch.randn(w.shape, generator=torch.Generator().manual_seed(i)).double() for i, w in enumerate(weights)]

    def value():
        return torch.stack(
            [getattr(r.gaussians, name).sin().sum() for r in roll.window(15, 9, begin="simulation") for name in FIELDS]
        ).sum()

    gradients = torch.autograd.grad(value(), weights)
    slope = float(sum((g * d).sum() for g, d in zip(gradients, direction, strict=True)))
    ends = []
    with torch.no_grad():
        for step in (1e-6, -2e-6):
            torch._foreach_add_(weights, direction, alpha=step)
            ends.append(float(value()))
    assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope, rel=1e-4)


def test_a_particle_lands_where_the_simulation_lands():
    history = falling()
    roll = rollout(history, weights=1.0)
    landed = history.collided.nonzero()[:, 0]
    assert len(landed) > 5
    for particle in landed.tolist():
        frame = int(history.ends[particle]) - 1
        gaussians = roll.gaussians(frame)
        row = history.active(frame).tolist().index(particle)
        assert torch.equal(gaussians.means[row], history.positions_at(frame, torch.tensor([particle]))[0])


def test_windows_begin_where_the_rollout_is_or_where_the_simulation_is():
    roll = rollout(falling(), weights=0.5)
    reached, fresh = roll.window(20, 1)[0], roll.window(20, 1, begin="simulation")[0]
    assert reached.offset.norm(dim=1).mean() > 2 * fresh.offset.norm(dim=1).mean() > 0
    bound = roll.field.bounds.velocity * math.sqrt(3)
    assert (fresh.offset.norm(dim=1) <= bound).all()


def test_rollout_knows_when_weights_have_changed():
    roll = rollout(falling(), weights=0.1)
    roll.refresh()
    assert not roll.stale
    before = roll.gaussians(20)
    with torch.no_grad():
        roll.field.active_net.heads["velocity"].bias.add_(1.0)
    assert roll.stale
    roll.refresh()
    assert not roll.stale and not torch.equal(before.means, roll.gaussians(20).means)


def test_refresh_tells_its_progress():
    told = []
    rollout(falling(), weights=0.1).refresh(lambda done, total: told.append((done, total)))
    assert told == [(n, 35) for n in range(1, 36)]


@pytest.mark.parametrize(("start", "frames"), [(-1, 9), (32, 9), (0, 0), (0, 41)])
def test_a_window_outside_the_sequence_is_refused(start, frames):
    with pytest.raises(IndexError, match="does not fit into 40 frames"):
        rollout(falling()).window(start, frames)


def test_a_frame_outside_the_sequence_is_refused():
    with pytest.raises(IndexError, match="frames 0 to 39, asked for 40"):
        rollout(falling()).gaussians(40)


def test_nan_weights_are_named_with_frame_and_quantity():
    roll = rollout(falling())
    with torch.no_grad():
        roll.field.active_net.heads["scale"].bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"frame 11 of the roll-out: \d+ values of the Gaussians' scales"):
        roll.window(11, 3, begin="simulation")


def test_no_particles_at_all_are_no_error():
    history = falling()
    visible = torch.zeros(len(history), dtype=torch.bool)
    clip = rollout(history, weights=0.1).window(5, 4, visible=visible)
    assert [len(instant.gaussians) for instant in clip] == [0, 0, 0, 0]
