"""The roll-out: from simulated motion, initial look and learned field to the Gaussians of any frame.

Training windows start from states that the roll-out really reaches. (The paper's code restarts every training clip from
simulated positions, so that it never sees the drift it later shows; `begin="simulation"` does the same.) Active particles are
rolled out from their birth with the present weights: states of some steps ago would make the learned motion swing about its
goal. Collided particles have a longer past and only change their look: `refresh` rolls out the whole sequence once in a while
and keeps a state every `stride` frames.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pgsd_nerfstudio.dynamics.field import DynamicsField
from pgsd_nerfstudio.dynamics.in_sight import Extents, Eye, faded_in, in_sight
from pgsd_nerfstudio.dynamics.look import LearnedLook, changed
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame, check_frame
from pgsd_nerfstudio.dynamics.sequence import Begin, GaussianSequence, Progress
from pgsd_nerfstudio.dynamics.sparkle import Sparkle, sparkling
from pgsd_nerfstudio.dynamics.state import Deltas, RolloutState, advance, fading, simulated, simulated_of
from pgsd_nerfstudio.dynamics.velocity_field import VelocityField
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.scene.gaussians import Gaussians

Motion = Literal["particle", "field"]


class Rollout(GaussianSequence):
    """Particles that a field moves by recurrence, from frame to frame."""

    def __init__(
        self,
        history: ParticleHistory,
        look: InitialLook,
        field: DynamicsField,
        learned_look: LearnedLook | None = None,
        *,
        stride: int = 25,
        exposure: float = 0.0,
        motion: Motion = "particle",
        sparkle: Sparkle | None = None,
    ) -> None:
        """Set up; nothing is rolled out yet.

        Args:
            history: the simulated motion.
            look: initial look of all particles.
            field: the learned corrections.
            learned_look: the shift of the look that all particles share; None means none.
            stride: frames from one kept state to the next.
            exposure: seconds that the shutter is open. Active Gaussians carry how far the simulation moves them in that time.
            motion: a particle that has drifted follows the simulated motion of its own trajectory ("particle", the paper), or
                that of the place where it is ("field", see VelocityField); both lead to the simulated contact.
            sparkle: what active particles do with light over time, where a camera sees them; None: they shine evenly.

        Raises:
            ValueError: the stride is below one frame, or there is no such motion.
        """
        if stride < 1:
            raise ValueError(f"stride must be at least one frame, got {stride}")
        if motion not in ("particle", "field"):
            raise ValueError(f'motion must be "particle" or "field", got "{motion}"')
        super().__init__(history, look, learned_look)
        self.field, self.stride, self.exposure, self.motion, self.sparkle = field, stride, exposure, motion, sparkle
        self._keyframes: dict[int, RolloutState] = {}
        self._stamp: tuple[int, ...] = ()
        self._last: RolloutState | None = None
        self._initial_extents: Extents | None = None

    @property
    def stale(self) -> bool:
        """Whether weights have changed since `refresh`; frames then come from states that older weights reached."""
        return self._stamp != self._weights()

    @torch.no_grad()
    def refresh(self, progress: Progress | None = None) -> None:
        """Roll through the whole sequence with the present weights and keep a state every `stride` frames.

        This costs nothing before the field has learned anything.

        Args:
            progress: is told (frames done, of how many).
        """
        weights, keyframes = self._weights(), {}
        if not self.field.still():
            last = (len(self) - 1) // self.stride * self.stride
            for state in self._walk(last):
                if state.frame % self.stride == 0:
                    keyframes[state.frame] = state
                if progress and state.frame:
                    progress(state.frame, last)
        self._keyframes, self._stamp, self._last = keyframes, weights, None
        self.refreshed = self._copied()

    @torch.no_grad()
    def restore(self, refreshed: Mapping[str, Tensor]) -> None:
        """Make the kept states as an interrupted training had them; the weights in use stay as they are.

        Args:
            refreshed: weights of the training's last `refresh`, as the attribute `refreshed` held them.
        """
        learned = self._copied()
        self._load(refreshed)
        self.refresh()
        self._load(learned)

    def _modules(self) -> dict[str, nn.Module]:
        return {"field": self.field, **({"look": self.learned_look} if self.learned_look else {})}

    def _copied(self) -> dict[str, Tensor]:
        return {
            f"{name}.{k}": v.detach().clone() for name, part in self._modules().items() for k, v in part.state_dict().items()
        }

    def _load(self, weights: Mapping[str, Tensor]) -> None:
        for name, part in self._modules().items():
            part.load_state_dict({k.removeprefix(f"{name}."): v for k, v in weights.items() if k.startswith(f"{name}.")})

    @torch.no_grad()
    def afresh(self, frames: Collection[int]) -> Iterator[RolloutFrame]:
        """Some frames in ascending order, rolled out from frame 0 with the present weights; kept states stay as they are.

        Args:
            frames: numbers of the frames.

        Raises:
            IndexError: there is no such frame.
        """
        wanted = set(frames)
        for frame in wanted:
            check_frame(frame, len(self))
        look, last = self._present_look(), max(wanted, default=-1)
        still = self.field.still()
        for state in (simulated(self.history, frame) for frame in sorted(wanted)) if still else self._walk(last):
            if state.frame in wanted:
                yield self._rendered(state, look, None)

    def _clip(
        self, start: int, frames: int, visible: Bool[Tensor, " p"] | None, begin: Begin, gradient_frames: int | None
    ) -> list[RolloutFrame]:
        """True recurrence from the first frame to the last."""
        with torch.no_grad():
            before = max(start - 1, 0)
            reached = begin == "rollout" and start > 0
            state = self._under_way(before, visible) if reached else simulated(self.history, before, visible)
        look = self._present_look()
        clip = [self._rendered(state, look, None)] if start == 0 else []
        for step in range(frames - len(clip)):
            if gradient_frames is not None and step % gradient_frames == 0:
                state = state.detach()
            state, deltas = advance(state, self.history, look, self.field, visible, self._flow)
            clip.append(self._rendered(state, look, deltas))
        return clip

    @cached_property
    def _flow(self) -> VelocityField | None:
        return VelocityField.of(self.history) if self.motion == "field" else None

    def _walk(self, last: int) -> Iterator[RolloutState]:
        """The states of frames 0 .. last with the present weights."""
        look, state = self._present_look(), simulated(self.history, 0)
        yield state
        while state.frame < last:
            state, _ = advance(state, self.history, look, self.field, None, self._flow)
            yield state

    def _present_look(self) -> InitialLook:
        return self.look if self.field.config.appearance == "fixed" else super()._present_look()

    def _weights(self) -> tuple[int, ...]:
        """Changes with every in-place update of a weight, also by an optimizer or by loading a state dict."""
        return tuple(number for part in self._modules().values() for p in part.parameters() for number in (id(p), p._version))

    def _at(self, frame: int, visible: Bool[Tensor, " p"] | None, look: InitialLook, eye: Eye | None = None) -> RolloutFrame:
        if eye is None or visible is not None or not self.field.still() or self.history.device.type != "cpu":
            found = self._rendered(self._reach(frame, visible, look), look, None)
        else:
            chosen = in_sight(self.history, frame, self._extents(look), self.exposure, eye)
            found = self._rendered(simulated_of(self.history, frame, *chosen), look, None)
        if eye is None:
            return found
        seen = faded_in(found, self.history.reaches, eye)
        if self.sparkle is not None:
            center = torch.from_numpy(eye.center).to(seen.means)
            seen = sparkling(seen, found.active, frame / self.history.fps, center, self.sparkle)
        return replace(found, gaussians=seen)

    def _extents(self, look: InitialLook) -> Extents:
        """Sizes of the particles with their halos; those of the initial look are kept."""
        widening = 1.0 if self.sparkle is None else self.sparkle.widening
        if look is not self.look:
            return Extents.of(look, widening)
        if self._initial_extents is None:
            self._initial_extents = Extents.of(look, widening)
        return self._initial_extents

    def _reach(self, frame: int, visible: Bool[Tensor, " p"] | None, look: InitialLook) -> RolloutState:
        """The state at a frame, without gradient, from the kept state before it (of a first `refresh` if there is none yet)."""
        if self.field.still():
            return simulated(self.history, frame, visible)
        if not self._keyframes:
            self.refresh()
        state = self._keyframes[frame // self.stride * self.stride]
        last = self._last
        if visible is None and last is not None and not self.stale and state.frame <= last.frame <= frame:
            state = last
        state = state.select(visible)
        while state.frame < frame:
            state, _ = advance(state, self.history, look, self.field, visible, self._flow)
        if visible is None:
            self._last = state
        return state

    def _under_way(self, frame: int, visible: Bool[Tensor, " p"] | None) -> RolloutState:
        """The state from which a clip starts: active particles as the present weights have moved them since their birth,
        collided ones as the last `refresh` saw them."""
        if self.field.still():
            return simulated(self.history, frame, visible)
        active = self.history.active(frame)
        if visible is not None:
            active = active[visible[active]]
        is_active = torch.zeros(len(self.history), dtype=torch.bool, device=active.device)
        is_active[active] = True
        look = self._present_look()
        kept = self._reach(frame, ~is_active if visible is None else visible & ~is_active, look)
        if len(active) == 0:
            return kept
        few, look = self.history.select(active), look.select(active)
        state = simulated(few, int(few.births.min()))
        while state.frame < frame:
            state, _ = advance(state, few, look, self.field, None, self._flow)
        return replace(state, active=active, collided=kept.collided, collided_change=kept.collided_change)

    def _rendered(self, state: RolloutState, look: InitialLook, deltas: Deltas | None) -> RolloutFrame:
        history = self.history
        fade = fading(history, state.frame, state.active)
        offset = state.offset * fade[:, None]
        active = changed(look.active.select(state.active), state.active_change.times(fade))
        collided = changed(look.collided_at(history, state.frame, state.collided), state.collided_change)
        places = history.positions_at(state.frame, state.active) + offset
        looks = ParticleLook(*(torch.cat(pair) for pair in zip(_fields(active), _fields(collided), strict=True)))
        gaussians = Gaussians(
            torch.cat([places, history.rest_positions[state.collided]]),
            torch.cat([state.quats, history.rest_quats[state.collided]]),
            looks.scales,
            looks.opacity,
            looks.rgb,
            self._displacements(state),
            antialiased=True,
            whole=True,
        )
        simulated_quats = history.quats[state.active]
        return RolloutFrame(state.frame, gaussians, state.active, state.collided, offset, state.quats, simulated_quats, deltas)

    def _displacements(self, state: RolloutState) -> Float[Tensor, "k 3"] | None:
        """Metres while the shutter is open, of all that is rendered; collided particles do not move. None without exposure."""
        if self.exposure == 0.0:
            return None
        per_frame = self.history.displacement_at(state.frame, state.active)
        moved = per_frame * (self.exposure * self.history.fps)
        return torch.cat([moved, moved.new_zeros(len(state.collided), 3)])


def _fields(look: ParticleLook) -> tuple[Tensor, Tensor, Tensor]:
    return look.opacity, look.scales, look.rgb
