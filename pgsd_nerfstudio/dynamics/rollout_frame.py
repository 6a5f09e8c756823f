"""One frame of a sequence of moving Gaussians, for rendering and regularization, and checks of frames and windows."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.dynamics.state import Deltas
from pgsd_nerfstudio.scene.gaussians import Gaussians


@dataclass(frozen=True)
class RolloutFrame:
    """One frame of a roll-out: Gaussians to render, and quantities to regularize."""

    frame: int
    gaussians: Gaussians
    """In metres, plain RGB: the active ones, then the collided ones."""
    active: Int[Tensor, " n"]
    """Ids of the first n Gaussians."""
    collided: Int[Tensor, " m"]
    """Ids of the other m."""
    offset: Float[Tensor, "n 3"]
    """Rendered minus simulated position, metres."""
    quats: Float[Tensor, "n 4"]
    """Rendered orientation, wxyz."""
    simulated_quats: Float[Tensor, "n 4"]
    deltas: Deltas | None
    """Changes that the field made in this frame; None in a roll-out without gradient."""


def check_frame(frame: int, total: int) -> None:
    """Raises IndexError: there is no such frame among `total`."""
    if not 0 <= frame < total:
        raise IndexError(f"there are frames 0 to {total - 1}, asked for {frame}")


def check_window(start: int, frames: int, total: int) -> None:
    """Raises IndexError: a clip of `frames` frames from `start` leaves a sequence of `total`."""
    if frames < 1 or not 0 <= start <= total - frames:
        raise IndexError(f"a clip of {frames} frames from frame {start} does not fit into {total} frames")


def check_finite(instant: RolloutFrame) -> None:
    """Raises FloatingPointError: a Gaussian is not finite; the message names quantity and frame."""
    try:
        instant.gaussians.check_finite()
    except ValueError as error:
        raise FloatingPointError(f"frame {instant.frame} of the roll-out: {error}") from error
