"""The state that the recurrence carries from frame to frame, and one step of it.

The paper's x(t) = x(t-1) + v_sim(t) + dv is carried as the learned offset alone, d(t) = d(t-1) + dv with x = x_sim + d: the
same sum, but a field that adds nothing reproduces the simulation bit for bit, however many frames it runs.

A particle that has drifted goes on with the simulated motion of a place where it no longer is. With a velocity field V the step
gains V(x) - V(x_sim), the difference between the simulated motion at the rendered and at the simulated place. The particle's
own part, such as the fall speed of its size, stays with it, and without drift nothing is added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgsd_nerfstudio.dynamics.field import ActiveDelta, DynamicsField
from pgsd_nerfstudio.dynamics.look import Change, accumulate, changed
from pgsd_nerfstudio.dynamics.velocity_field import VelocityField
from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.scene import rotations

LANDING_FRAMES = 5
"""Frames before contact over which all learned changes of an active particle fade out: it lands where and as the simulation
says, without a jump. (The paper does not say how an offset ends on landing; dropping it there makes the particle jump.)"""


@dataclass(frozen=True)
class RolloutState:
    """All particles at one frame."""

    frame: int
    active: Int[Tensor, " n"]
    """Ids of the active particles, ascending."""
    offset: Float[Tensor, "n 3"]
    """Learned part of the position, metres, before it fades for landing."""
    quats: Float[Tensor, "n 4"]
    active_change: Change
    collided: Int[Tensor, " m"]
    """Ids of the collided particles, ascending."""
    collided_change: Change

    def select(self, visible: Bool[Tensor, " p"] | None) -> RolloutState:
        """The state of the visible particles alone.

        Args:
            visible: mask over all particles; None means all.
        """
        if visible is None:
            return self
        active, collided = visible[self.active], visible[self.collided]
        return RolloutState(
            self.frame,
            self.active[active],
            self.offset[active],
            self.quats[active],
            Change(*(x[active] for x in self.active_change)),
            self.collided[collided],
            Change(*(x[collided] for x in self.collided_change)),
        )

    def detach(self) -> RolloutState:
        """The same state, cut from the graph that led to it."""
        return replace(
            self,
            offset=self.offset.detach(),
            quats=self.quats.detach(),
            active_change=Change(*(x.detach() for x in self.active_change)),
            collided_change=Change(*(x.detach() for x in self.collided_change)),
        )


class Deltas(NamedTuple):
    """Changes that the field made in one step: of particles active before and after it, and of particles collided before it."""

    active: ActiveDelta
    collided: Change


def simulated(history: ParticleHistory, frame: int, visible: Bool[Tensor, " p"] | None = None) -> RolloutState:
    """The state in which nothing has been learned: simulated positions, initial look."""
    return simulated_of(history, frame, _seen(history.active(frame), visible), _seen(history.resting(frame), visible))


def simulated_of(history: ParticleHistory, frame: int, active: Int[Tensor, " n"], collided: Int[Tensor, " m"]) -> RolloutState:
    """`simulated` of chosen particles: ids of some that are active at the frame and of some that are collided, ascending."""
    like = history.positions
    return RolloutState(
        frame,
        active,
        like.new_zeros(len(active), 3),
        history.quats[active],
        Change.none(len(active), like),
        collided,
        Change.none(len(collided), like),
    )


def advance(
    state: RolloutState,
    history: ParticleHistory,
    look: InitialLook,
    field: DynamicsField,
    visible: Bool[Tensor, " p"] | None = None,
    flow: VelocityField | None = None,
) -> tuple[RolloutState, Deltas]:
    """The state one frame later.

    Args:
        state: state of the visible particles; `visible` must be the mask it was selected with.
        history: the simulated motion.
        look: initial look of all particles.
        field: the learned corrections.
        visible: particles to follow; None means all.
        flow: simulated velocities by place; None: every particle keeps to its own trajectory's.
    """
    fresh = simulated(history, state.frame + 1, visible)
    frame, ids = fresh.frame, fresh.active
    # Ids ascend in both states, so particles that stay active are in the same order in both.
    stay, stayed = history.births[ids] < frame, history.ends[state.active] > frame
    ids = ids[stay]
    change, offset, quats = state.active_change, state.offset, state.quats
    if not bool(stayed.all()):
        kept = stayed.nonzero()[:, 0]
        change, offset, quats = Change(*(x[kept] for x in change)), offset[kept], quats[kept]
    fade = fading(history, state.frame, ids)
    before, now = history.positions_at(state.frame, ids), history.positions_at(frame, ids)
    here, motion = before + offset * fade[:, None], now - before
    if flow is not None:
        elsewhere = flow.at(frame, here) - flow.at(frame, before)
        offset, motion = offset + elsewhere, motion + elsewhere
    initial = look.active.select(ids)
    delta = field.active(here, motion, frame, changed(initial, change.times(fade)))

    was_collided = history.ends[fresh.collided] < frame
    rest = fresh.collided[was_collided]
    collided_change = collided_delta = state.collided_change
    if len(rest):
        before_step = changed(look.collided_at(history, state.frame, rest), state.collided_change)
        collided_delta = field.collided(history.rest_positions[rest], frame, before_step)
        collided_change = accumulate(look.collided_at(history, frame, rest), state.collided_change, collided_delta)

    return RolloutState(
        frame,
        fresh.active,
        _placed(fresh.offset, stay, offset + delta.velocity),
        _placed(fresh.quats, stay, turned(quats, delta.rotation)),
        _placed_change(fresh.active_change, stay, accumulate(initial, change, delta.change)),
        fresh.collided,
        _placed_change(fresh.collided_change, was_collided, collided_change),
    ), Deltas(delta, collided_delta)


def turned(quats: Float[Tensor, "n 4"], rotation: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """R o dR(omega): wxyz quaternions turned by rotation vectors in their own axes; exactly the same where those are zero."""
    step = rotations.rotvec_to_unitquat(rotation)
    return rotations.quat_xyzw_to_wxyz(rotations.quat_product(rotations.quat_wxyz_to_xyzw(quats), step))


def fading(history: ParticleHistory, frame: int, ids: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Factor on the learned changes of active particles: 1 in free flight, falling to 0 at the frame of contact."""
    left = (history.ends[ids] - 1 - frame).to(history.positions) / LANDING_FRAMES
    return torch.where(history.collided[ids], left.clamp(0, 1), 1.0)


def _seen(ids: Int[Tensor, " n"], visible: Bool[Tensor, " p"] | None) -> Int[Tensor, " k"]:
    return ids if visible is None else ids[visible[ids]]


def _placed(into: Tensor, where: Bool[Tensor, " n"], values: Tensor) -> Tensor:
    if values.shape[0] == into.shape[0]:
        return values
    return into.index_copy(0, where.nonzero()[:, 0], values)


def _placed_change(into: Change, where: Bool[Tensor, " n"], values: Change) -> Change:
    return Change(*(_placed(a, where, b) for a, b in zip(into, values, strict=True)))
