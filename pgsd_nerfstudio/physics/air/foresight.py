"""Foresight: which particles will be seen, and when, so that nothing else is simulated.

The wind of a run is known in advance. Each particle that enters is led along its way by a few long steps; the exact drag of
`airborne` allows that. Where its way comes into a camera's view within its reach, the particle is simulated from shortly before
that until shortly after the last such moment; otherwise not at all. Until then it waits. Long steps pass through the turbulence
less finely than frames do: over the way of a flake through a box of some metres both end within some centimetres of each other,
and the views are widened by half a metre for it.
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from pgsd_nerfstudio.physics.air.airborne import Flutter, advance
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import NO_END, Bodies
from pgsd_nerfstudio.physics.clock import Domain

STRIDE = 1.2  # m; about the longest way of a step
MOST_FRAMES = 10  # of a step
HORIZON = 60.0  # s; particles that are still on their way then are simulated to the end


def foresee(bodies: Bodies, frame: int, *, step: float, wind: WindField, domain: Domain, sight: Sight) -> Bodies:
    """Lead particles along their way; those that will not be seen drop out.

    Args:
        bodies: particles that fly, in `frame`.
        frame: the present frame.
        step: seconds from frame to frame.
        wind: the moving air.
        domain: where it ends, so do they.
        sight: where cameras see, from which distance.

    Returns:
        The particles that will be seen, with `since` and `until`, and their positions and velocities in the frame `since`.
    """
    count = len(bodies)
    if count == 0:
        return bodies
    speed = float(np.linalg.norm(bodies.velocities, axis=1).max())
    frames = int(np.clip(STRIDE / max(speed * step, 1e-6), 1, MOST_FRAMES))
    first, last = np.full(count, NO_END, np.int32), np.full(count, -1, np.int32)
    began = bodies.positions.copy(), bodies.velocities.copy()
    under_way, moving, now = np.arange(count), Bodies.join([bodies]), frame
    while len(under_way) and (now - frame) * step < HORIZON:
        before, speeds = moving.positions.copy(), moving.velocities.copy()
        flutter = Flutter(moving.sways, moving.hertz, moving.phases)
        advance(moving.positions, moving.velocities, moving.speeds, flutter, wind, now * step, frames * step)
        seen = _watch(before, moving.positions, moving.reaches, sight.seen_distances, sight.lower, 1 / sight.cell)
        fresh = seen & (first[under_way] == NO_END)
        new = under_way[fresh]
        first[new], began[0][new], began[1][new] = now, before[fresh], speeds[fresh]
        last[under_way[seen]] = now + frames
        now += frames
        inside = domain.contains(moving.positions)
        under_way, moving = under_way[inside], moving.select(inside)
    last[under_way] = np.where(first[under_way] == NO_END, -1, NO_END)
    matters = last >= 0
    until = np.minimum(last.astype(np.int64) + frames, NO_END).astype(np.int32)
    return replace(bodies, positions=began[0], velocities=began[1], since=first, until=until).select(matters)


@numba.njit(cache=True, nogil=True)
def _watch(before, after, reaches, seen, lower, inverse):
    """Whether the straight way of each particle comes through a cell that a camera sees within its reach."""
    found = np.zeros(len(before), np.bool_)
    edge = 1.0 / max(inverse[0], inverse[1], inverse[2])
    for i in range(len(before)):
        x, y, z = before[i, 0], before[i, 1], before[i, 2]
        way_x, way_y, way_z = after[i, 0] - x, after[i, 1] - y, after[i, 2] - z
        pieces = int(np.sqrt(way_x * way_x + way_y * way_y + way_z * way_z) / edge) + 1
        for piece in range(pieces + 1):
            share = piece / pieces
            a = int(np.floor((x + share * way_x - lower[0]) * inverse[0]))
            b = int(np.floor((y + share * way_y - lower[1]) * inverse[1]))
            c = int(np.floor((z + share * way_z - lower[2]) * inverse[2]))
            a = min(max(a, 0), seen.shape[0] - 1)
            b = min(max(b, 0), seen.shape[1] - 1)
            c = min(max(c, 0), seen.shape[2] - 1)
            if seen[a, b, c] <= reaches[i]:
                found[i] = True
                break
    return found
