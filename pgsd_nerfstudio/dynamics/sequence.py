"""What moving Gaussians promise, however their motion comes about: any frame at random access, and windows with gradient."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from pgsd_nerfstudio.dynamics.in_sight import Eye
from pgsd_nerfstudio.dynamics.look import LearnedLook
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame, check_finite, check_frame, check_window
from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.scene.gaussians import Gaussians

Progress = Callable[[int, int], None]
Begin = Literal["rollout", "simulation"]


class GaussianSequence(ABC):
    """Particles over time, rendered as Gaussians. Everything is in metres. All parts must be on one device."""

    refreshed: dict[str, Tensor] | None = None
    """Weights that the kept states were made with; None before the first `refresh`, and where no states are kept."""

    def __init__(self, history: ParticleHistory, look: InitialLook, learned_look: LearnedLook | None) -> None:
        """Set up without evaluating anything.

        Args:
            history: the simulated motion.
            look: initial look of all particles.
            learned_look: the shift of the look that all particles share; None means none.
        """
        self.history, self.look, self.learned_look = history, look, learned_look

    def __len__(self) -> int:
        """Number of frames."""
        return self.history.frames

    @property
    @abstractmethod
    def stale(self) -> bool:
        """Whether weights have changed since `refresh`: then frames come from states that older weights reached."""

    @abstractmethod
    def refresh(self, progress: Progress | None = None) -> None:
        """Make the kept states anew with the present weights.

        Args:
            progress: is told (frames done, of how many).
        """

    @torch.no_grad()
    def gaussians(self, frame: int, visible: Bool[Tensor, " p"] | None = None, eye: Eye | None = None) -> Gaussians:
        """The Gaussians of any frame, without gradient; neighbouring frames in ascending order are cheapest.

        Args:
            frame: number of the frame.
            visible: mask over all particles; only these are evaluated. None means all.
            eye: the camera that will see them: particles within its reach, faded in; what it cannot show may be missing. None:
                all of them.

        Raises:
            IndexError: there is no such frame.
        """
        check_frame(frame, len(self))
        return self._at(frame, visible, self._present_look(), eye).gaussians

    @torch.no_grad()
    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[RolloutFrame]:
        """Frames start .. stop (exclusive) one after the other, without gradient; for rendering and measuring.

        Raises:
            IndexError: there is no such frame.
        """
        look = self._present_look()
        for frame in range(start, len(self) if stop is None else stop):
            check_frame(frame, len(self))
            yield self._at(frame, None, look)

    def window(
        self,
        start: int,
        frames: int,
        *,
        visible: Bool[Tensor, " p"] | None = None,
        begin: Begin = "rollout",
        gradient_frames: int | None = None,
    ) -> list[RolloutFrame]:
        """A clip with gradient to the network and to the learned look.

        Args:
            start: first frame of the clip.
            frames: length of the clip.
            visible: mask over all particles; only these are evaluated. None means all.
            begin: where a recurrence starts from: the state that the roll-out reaches at the frame before, or (the paper's
                code) the simulated one.
            gradient_frames: after so many steps of a recurrence the gradient is cut, as in truncated backpropagation through
                time; None lets it run through the whole clip, 1 cuts it after every frame, as the paper's code does.

        Raises:
            IndexError: the clip leaves the sequence.
            ValueError: `gradient_frames` is below one.
            FloatingPointError: a Gaussian is not finite; the message names quantity and frame.
        """
        check_window(start, frames, len(self))
        if gradient_frames is not None and gradient_frames < 1:
            raise ValueError(f"the gradient must run through at least one frame, got gradient_frames = {gradient_frames}")
        clip = self._clip(start, frames, visible, begin, gradient_frames)
        for instant in clip:
            check_finite(instant)
        return clip

    @abstractmethod
    def _at(self, frame: int, visible: Bool[Tensor, " p"] | None, look: InitialLook, eye: Eye | None = None) -> RolloutFrame:
        """One frame that exists, without gradient, of particles with this (learned) look, for a camera or for all."""

    @abstractmethod
    def _clip(
        self, start: int, frames: int, visible: Bool[Tensor, " p"] | None, begin: Begin, gradient_frames: int | None
    ) -> list[RolloutFrame]:
        """The frames of `window`, which checks its arguments and what comes back."""

    def _present_look(self) -> InitialLook:
        """The initial look with the learned shift."""
        if self.learned_look is None:
            return self.look
        if not torch.is_grad_enabled() and not any(bool(p.any()) for p in self.learned_look.parameters()):
            return self.look
        return self.learned_look(self.look)
