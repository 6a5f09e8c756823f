"""Foresight: which particles will be seen, and when, so that nothing else is simulated.

The wind of a run is known in advance. Each particle that enters is led along its way by a few long steps; the exact drag of
`airborne` allows that. Where its way comes into a camera's view within its reach, the particle is simulated from shortly before
that until shortly after the last such moment; otherwise not at all. Until then it waits. Long steps pass through the turbulence
less finely than frames do, and without the flutter, whose circles are small and would alias: over the way of a flake of some
metres both end within about a decimetre of each other (root mean square), and the views are widened by half a metre for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.air.airborne import Flutter, Instant, advance
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import NO_END, Bodies
from pgsd_nerfstudio.physics.clock import Domain

STRIDE = 1.2  # m; about the longest way of a step
MOST_FRAMES = 12  # of a step
_NEEDED = ("positions", "velocities", "speeds", "reaches")
HORIZON = 60.0  # s; particles that are still on their way then are simulated to the end


def foresee(
    bodies: Bodies,
    frame: int,
    *,
    step: float,
    wind: WindField,
    domain: Domain,
    sight: Sight,
    kept: dict[tuple[float, float], Instant] | None = None,
) -> Bodies:
    """Lead particles along their way; those that will not be seen drop out.

    Args:
        bodies: particles that fly, in `frame`.
        frame: the present frame.
        step: seconds from frame to frame.
        wind: the moving air.
        domain: where it ends, so do they.
        sight: where cameras see, from which distance.
        kept: of `airborne.advance`; steps of particles of different frames often take place at the same times.

    Returns:
        The particles that will be seen, with `since` and `until`, and their positions and velocities in the frame `since`.
    """
    count = len(bodies)
    if count == 0:
        return bodies
    speed = float(np.linalg.norm(bodies.velocities, axis=1).max())
    frames = int(np.clip(STRIDE / max(speed * step, 1e-6), 1, MOST_FRAMES))
    first, last = np.full(count, NO_END, np.int32), np.full(count, -1, np.int32)
    begins = bodies.positions.copy(), bodies.velocities.copy()
    under_way, now = np.arange(count, dtype=np.int32), frame
    moving = tuple(getattr(bodies, name).copy() for name in _NEEDED)
    box = np.asarray(domain.lower, np.float32), np.asarray(domain.upper, np.float32)
    distances = np.ascontiguousarray(sight.seen_distances), np.ascontiguousarray(sight.needed_distances)
    cells = *distances, sight.lower, 1 / sight.cell
    while count and (now - frame) * step < HORIZON:
        positions, velocities, speeds, _ = (values[:count] for values in moving)
        before = positions.copy(), velocities.copy()
        ahead = frames - now % frames  # to a frame at which steps of all particles end, so that the wind is needed at few times
        advance(positions, velocities, speeds, Flutter.none(count), wind, now * step, ahead * step, kept)
        notes = (under_way, first, last, *begins)
        count = _watch((count, now, ahead), moving, before, cells, box, notes)
        now += ahead
    still = under_way[:count]
    last[still] = np.where(first[still] == NO_END, -1, NO_END)
    matters = last >= 0
    until = np.minimum(last.astype(np.int64) + frames, NO_END).astype(np.int32)
    return replace(bodies, positions=begins[0], velocities=begins[1], since=first, until=until).select(matters)


@kernel(inline="always")
def _cell(place, count):
    """The nearest of the cells along an axis; the first for NaN."""
    return min(int(place), count - 1) if place > 0.0 else 0


@kernel()
def _watch(numbers, moving, before, cells, box, notes):
    """Note which particles come through a cell that a camera sees within their reach, on a straight way.

    Those that leave the domain, or cannot come into view any more, are taken out, in place; returns how many are left.
    """
    (count, now, frames), (positions, velocities, speeds, reaches), (start, had) = numbers, moving, before
    (seen, needed, corner, inverse), (lower, upper) = cells, box
    under_way, first, last, began, began_with = notes
    edge = 1.0 / max(inverse[0], inverse[1], inverse[2])
    nx, ny, nz = seen.shape
    stays = 0
    for i in range(count):
        x, y, z = start[i, 0], start[i, 1], start[i, 2]
        way_x, way_y, way_z = positions[i, 0] - x, positions[i, 1] - y, positions[i, 2] - z
        pieces = int(np.sqrt(way_x * way_x + way_y * way_y + way_z * way_z) / edge) + 1
        x, y, z = (x - corner[0]) * inverse[0], (y - corner[1]) * inverse[1], (z - corner[2]) * inverse[2]
        share = 1.0 / pieces
        way_x, way_y, way_z = share * way_x * inverse[0], share * way_y * inverse[1], share * way_z * inverse[2]
        for piece in range(pieces + 1):
            a, b, c = _cell(x + piece * way_x, nx), _cell(y + piece * way_y, ny), _cell(z + piece * way_z, nz)
            if seen[a, b, c] <= reaches[i]:
                own = under_way[i]
                if first[own] == NO_END:
                    first[own] = now
                    for axis in range(3):
                        began[own, axis], began_with[own, axis] = start[i, axis], had[i, axis]
                last[own] = now + frames
                break
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        a, b = _cell((x - corner[0]) * inverse[0], nx), _cell((y - corner[1]) * inverse[1], ny)
        c = _cell((z - corner[2]) * inverse[2], nz)
        inside = x >= lower[0] and y >= lower[1] and z >= lower[2] and x <= upper[0] and y <= upper[1] and z <= upper[2]
        if inside and needed[a, b, c] <= reaches[i]:
            for axis in range(3):
                positions[stays, axis], velocities[stays, axis] = positions[i, axis], velocities[i, axis]
            speeds[stays], reaches[stays], under_way[stays] = speeds[i], reaches[i], under_way[i]
            stays += 1
    return stays
