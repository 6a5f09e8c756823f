"""Which moment of the weather each picture of a camera path shows.

nerfstudio's camera paths carry a `render_time` for each picture. Its viewer writes 0 to 1 over the whole weather; people also
have paths without times, drawn while the viewer's time stood still, or with times in seconds or frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pgsd_nerfstudio.scene.scene import SceneError

# The viewer lays a spline through the times of its keyframes, which swings a little past 0 and 1 and means neither.
OVERSHOOT = 0.25
SAME = 1e-6  # the rounding of that spline where all its times are the same
SLACK = 0.02  # by so much of its length may times in seconds or frames go beyond the end of the weather


@dataclass(frozen=True)
class PathTimes:
    """The moments of all pictures of a path."""

    times: tuple[float, ...]
    """From 0, the beginning of the weather, to 1, its end."""
    remark: str | None
    """What is to be said of them, where they were not simply given as 0 to 1."""


def path_times(given: Sequence[float | None], *, seconds: float, frames: int) -> PathTimes:
    """The moment of each picture of a path.

    Where all times are the same, or there are none, the whole weather passes along the path. A missing one is taken from those
    beside it. Times beyond 1 are seconds if none is later than the end of the weather, else numbers of frames.

    Args:
        given: render_time of each picture; None where there is none.
        seconds: length of the weather.
        frames: of the weather.

    Raises:
        SceneError: there are no pictures, or the times are no times within the weather.
    """
    count = len(given)
    if count == 0:
        raise SceneError("a camera path needs at least one camera, found none: draw it anew or write one with pgsd path")
    known = np.array([index for index, time in enumerate(given) if time is not None])
    values = np.array([time for time in given if time is not None], dtype=np.float64)
    if not np.isfinite(values).all():
        raise SceneError(
            f"render_time must be a number in each frame of a camera path, got {values[~np.isfinite(values)][0]:g}"
        )
    if count > 1 and (len(values) == 0 or np.ptp(values) < SAME):
        found = "no render_time" if len(values) == 0 else f"the same render_time, {values[0]:g}, in all of its {count} frames"
        remark = f"the camera path has {found}: the whole weather passes along it, from the beginning to the end"
        return PathTimes(tuple(np.linspace(0.0, 1.0, count).tolist()), remark)
    remarks = []
    if len(values) < count:
        remarks.append(
            f"{count - len(values)} of {count} frames of the camera path have no render_time: taken from those beside them"
        )
        values = np.interp(np.arange(count), known, values) if len(values) else np.zeros(count)
    low, high = float(values.min()), float(values.max())
    if low < -OVERSHOOT:
        raise SceneError(f"render_time must not be negative, got {low:g}: expected 0 to 1 over the whole weather")
    if high > 1.0 + OVERSHOOT:
        unit, whole = _unit(high, seconds, frames)
        remarks.append(f"render_time of the camera path reaches {high:g}: taken as {unit} of the weather's {whole:g}")
        values = values / whole
    return PathTimes(tuple(np.clip(values, 0.0, 1.0).tolist()), "; ".join(remarks) or None)


def _unit(latest: float, seconds: float, frames: int) -> tuple[str, float]:
    """What times beyond 1 count, and how many of them are the whole weather."""
    for unit, whole in (("seconds", seconds), ("frames", float(max(frames - 1, 1)))):
        if latest <= (1.0 + SLACK) * whole or math.isclose(latest, whole + 1):
            return unit, whole
    raise SceneError(
        f"render_time of the camera path reaches {latest:g}: expected 0 to 1 over the whole weather, seconds up to "
        f"{seconds:g}, or frames up to {frames - 1}"
    )
