"""The simulated velocity by place: analytic flows, and particles that go with the flow where they are, not where they were."""

import math
from dataclasses import replace

import pytest
import torch
from dynamics_particles import double, falling, looks, rollout

from pgsd_nerfstudio.dynamics import DynamicsField, LearnedLook, Rollout, VelocityField
from pgsd_nerfstudio.dynamics import velocity_field as velocity_field_module
from pgsd_nerfstudio.dynamics.state import advance, simulated
from pgsd_nerfstudio.dynamics.velocity_field import MOST_BYTES

WIND = torch.tensor([0.03, -0.01, -0.04], dtype=torch.float64)  # m per frame
SHEAR = 0.02  # per frame: x grows by this times the height


def carried(velocity, count=400, frames=20, land=False):
    """Particles from all over a box of 4 m that follow a flow exactly: metres per frame at places [n, 3] and a frame."""
    rng = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(count, 3, generator=rng, dtype=torch.float64)
    x[0] = torch.tensor([1.5, 2.0, 1.2])
    path = [x]
    for frame in range(1, frames):
        path.append(path[-1] + velocity(path[-1], frame))
    positions = torch.stack(path, 1)
    history = double(rollout(falling(count=count))).history
    last = torch.full((count,), frames - 1 if land else frames)
    history = replace(
        history,
        births=torch.zeros_like(history.births),
        ends=last.int(),
        collided=torch.full((count,), land),
        offsets=torch.arange(count + 1) * last[0],
        positions=positions[:, : int(last[0])].flatten(0, 1),
        rest_positions=positions[:, int(last[0]) - 1],
        frames=frames,
    )
    return history


def displaced(history, motion, by=0.3):
    """States of all frames, of particles that begin `by` metres above where they were simulated; the network adds nothing."""
    field = DynamicsField.for_history(history).double()
    look = double(rollout(history)).look
    roll = Rollout(history, look, field, motion=motion)
    state = simulated(history, 0)
    state = replace(state, offset=state.offset + torch.tensor([0.0, 0.0, by], dtype=torch.float64))
    states = [state]
    while state.frame < history.frames - 2:
        state, _ = advance(state, history, look, field, None, roll._flow)
        states.append(state)
    return states


def shear(place, frame):
    """Wind along x that grows with height, and fall: a flow in which a place's height decides where one ends up."""
    x = torch.zeros_like(place)
    x[:, 0], x[:, 2] = SHEAR * place[:, 2], -0.01
    return x


def test_uniform_wind_is_exact_at_every_place_even_outside():
    history = carried(lambda place, frame: WIND.expand_as(place) * (1 + 0.1 * frame))
    field = VelocityField.of(history)
    everywhere = 10 * torch.rand(500, 3, dtype=torch.float64) - 3
    for frame in (1, 7, 19):
        truth = WIND.expand(500, 3) * (1 + 0.1 * frame)
        torch.testing.assert_close(field.at(frame, everywhere), truth, rtol=1e-12, atol=0)


def test_in_a_uniform_wind_both_motions_are_the_same():
    history = carried(lambda place, frame: WIND.expand_as(place))
    for a, b in zip(displaced(history, "field"), displaced(history, "particle"), strict=True):
        torch.testing.assert_close(a.offset, b.offset, rtol=0, atol=1e-13)


def test_a_shear_flow_is_read_as_it_is():
    history = carried(shear, count=4000)
    field = VelocityField.of(history)
    places = 0.5 + 3 * torch.rand(300, 3, dtype=torch.float64)
    error = (field.at(3, places) - shear(places, 3)).norm(dim=1)
    assert error.mean() < 0.01 * SHEAR * 4 and error.max() < 0.05 * SHEAR * 4


def test_a_displaced_particle_follows_the_shear_at_its_own_place_and_by_particle_does_not():
    """0.3 m higher, so SHEAR x 0.3 m further along x in every frame: the solution of dx/dt = SHEAR z, dz/dt = -0.01."""
    history = carried(shear, count=4000)
    by_field, by_particle = displaced(history, "field"), displaced(history, "particle")
    for state, other in zip(by_field, by_particle, strict=True):
        truth = torch.tensor([SHEAR * 0.3 * state.frame, 0.0, 0.3], dtype=torch.float64)
        torch.testing.assert_close(state.offset[0], truth, rtol=0, atol=0.06 * SHEAR * 0.3 * max(state.frame, 1))
        assert torch.equal(other.offset[0], by_field[0].offset[0])
    assert by_field[-1].offset[0, 0] > 0.09


def test_without_offset_the_field_moves_as_the_particle_within_the_error_of_the_grid():
    """The step in use has no error at all; what the grid alone would give lies within the error that is reported."""
    history = carried(shear, count=4000)
    field = VelocityField.of(history)
    ids = history.active(5)
    before, own = history.positions_at(4, ids), history.positions_at(5, ids) - history.positions_at(4, ids)
    away = (field.at(5, before) - own).norm(dim=1).mean()
    assert 0 < float(away) < 2 * field.error(history) < 0.02 * SHEAR * 4
    state = displaced(history, "field", by=0.0)[-1]
    assert not state.offset.any()


def test_own_fall_speed_stays_with_a_particle():
    """Two kinds that fall at 1 and 3 cm a frame through a wind that does not depend on place: each keeps its speed."""
    fast = torch.arange(400) % 2 == 0

    def velocity(place, frame):
        return torch.stack([torch.full((400,), 0.02), torch.zeros(400), torch.where(fast, -0.03, -0.01)], 1).double()

    # Without what the grid takes for flow: noise of the mixture in a cell, which is less than the speeds differ.
    last = displaced(carried(velocity), "field")[-1]
    assert (last.offset[:, 2] - 0.3).abs().mean() < 0.25 * 0.02 * last.frame


def test_by_field_a_particle_still_lands_where_the_simulation_lands():
    history = carried(shear, count=400, land=True)
    roll = double(Rollout(history, looks(400), DynamicsField.for_history(history), LearnedLook()))
    roll.motion = "field"
    with torch.no_grad():
        roll.field.active_net.heads["velocity"].bias.fill_(1.0)
    *_, before, contact = roll.window(1, history.frames - 2)
    assert before.offset.abs().max() > 0.01 and not contact.offset.any()
    assert torch.equal(contact.gaussians.means, history.rest_positions)


def test_reading_has_the_gradient_of_central_differences():
    field = VelocityField.of(carried(lambda place, frame: 0.01 * (2 * place).sin()))
    place = 1 + 2 * torch.rand(40, 3, dtype=torch.float64)
    place.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: field.at(4, x), place, eps=1e-7, atol=1e-6)


def test_empty_cells_take_the_nearest_particles_velocity():
    """Two flocks at the ends of the box that go different ways: between them each place goes with the nearer flock."""
    here = torch.arange(400)[:, None] % 2 == 0
    history = carried(lambda place, frame: torch.where(here, WIND, -WIND))
    paths = history.positions.view(400, 20, 3)
    start = torch.where(here, 0.1 * paths[:, 0], 4 - 0.1 * paths[:, 0])
    history = replace(history, positions=(paths - paths[:, :1] + start[:, None]).flatten(0, 1))
    field = VelocityField.of(history, 0.15)
    middle = torch.tensor([[1.2, 0.2, 0.2], [2.8, 3.8, 3.8]], dtype=torch.float64)
    torch.testing.assert_close(field.at(2, middle), torch.stack([WIND, -WIND]), rtol=1e-9, atol=0)


def test_memory_stays_below_50_megabytes_for_250_frames_however_many_particles(monkeypatch):
    """As if there were a million times as many: the cells grow until the memory suffices."""
    history = replace(falling(count=60), frames=250)
    monkeypatch.setattr(velocity_field_module, "PER_CELL", velocity_field_module.PER_CELL / 1e6)
    monkeypatch.setattr(VelocityField, "_fitted", lambda field, around, step: 0.0)
    field = VelocityField.of(history)
    assert 0.5 * MOST_BYTES < field.nbytes <= MOST_BYTES
    with pytest.raises(ValueError, match=r"below 50 MB; cells of 0.05 m take \d+ MB for 249 steps"):
        VelocityField.of(history, 0.05)


def test_a_place_that_is_not_a_number_stays_one():
    field = VelocityField.of(carried(shear))
    found = field.at(3, torch.tensor([[1.0, 1.0, math.nan], [1.0, 1.0, 1.0]], dtype=torch.float64))
    assert found[0].isnan().any() and found[1].isfinite().all()


def test_frames_that_no_step_leads_to_are_refused_and_no_particles_are_no_error():
    field = VelocityField.of(carried(shear))
    for frame in (0, 20):
        with pytest.raises(IndexError, match=f"frames 1 to 19, asked for frame {frame}"):
            field.at(frame, torch.zeros(1, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="positive size, got 0 m"):
        VelocityField.of(carried(shear), 0)
    nobody = falling().select(torch.zeros(0, dtype=torch.int64))
    assert not VelocityField.of(nobody).at(1, torch.ones(3, 3)).any()


@pytest.mark.mistyped
def test_there_are_two_motions():
    with pytest.raises(ValueError, match='"particle" or "field", got "grid"'):
        Rollout(falling(), looks(60), DynamicsField.for_history(falling()), motion="grid")
