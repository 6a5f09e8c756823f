"""Distance of rendered from simulated positions, and the share of it that training clips show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch

from pgsd_nerfstudio.dynamics.rollout import Rollout
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame
from pgsd_nerfstudio.dynamics.sequence import Begin


def drift(frames: Iterable[RolloutFrame]) -> float:
    """Mean distance in metres of rendered from simulated positions (paper, eq. drift_eq); empty frames do not count."""
    return _average(_distance(instant) for instant in frames)


class Gap(NamedTuple):
    """Drift of clips against that of the whole roll-out; metres."""

    clips: float
    """Drift of the clips as training sees them."""
    rollout: float
    """Drift of the whole roll-out with the present weights, at the same frames."""
    difference: float
    """The second minus the first: the drift that training does not see."""


@torch.no_grad()
def gaps(
    rollout: Rollout, windows: Sequence[tuple[int, int]], begins: Sequence[Begin] = ("simulation", "rollout")
) -> dict[Begin, Gap]:
    """Drift of training clips against that of the final roll-out, at the same frames.

    Clips that begin at the simulation (the paper's code) never drift further than their few frames allow. Clips that begin at
    the roll-out start from its states: their gap is zero.

    Args:
        rollout: the roll-out; its kept states are left as they are.
        windows: (first frame, number of frames) of each clip.
        begins: where the clips start from; each gets a gap.

    Raises:
        IndexError: a clip leaves the sequence.
    """
    wanted = {start + k for start, frames in windows for k in range(frames)}
    whole = {instant.frame: _distance(instant) for instant in rollout.afresh(wanted)}
    found: dict[Begin, Gap] = {}
    for begin in begins:
        clips = [instant for start, frames in windows for instant in rollout.window(start, frames, begin=begin)]
        seen, shown = _average(_distance(instant) for instant in clips), _average(whole[instant.frame] for instant in clips)
        found[begin] = Gap(seen, shown, shown - seen)
    return found


def _distance(instant: RolloutFrame) -> float | None:
    """Mean distance in metres of one frame; None without active particles."""
    return float(instant.offset.detach().norm(dim=1).mean()) if len(instant.active) else None


def _average(distances: Iterable[float | None]) -> float:
    found = [distance for distance in distances if distance is not None]
    return sum(found) / len(found) if found else 0.0
