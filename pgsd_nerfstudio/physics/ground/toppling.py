"""Toppling: cover runs down where it is too steep.

A level may rise above its neighbours only so far that the top of the cover is nowhere steeper than the angle of repose. The
slope is that of the steepest of the eight triangles between a level and two neighbours side by side (Tarboton, "A new method
for the determination of flow directions", 1997), so the highest allowed top is the update of the eikonal equation |grad z| =
tan(repose) on eight triangles (Tsitsiklis 1995; Sethian 1996): heaps become cones. The plain sandpile rule compares with one
neighbour at a time and makes octagons, 8 % wider along some directions.

The highest allowed top never falls when a neighbour rises. Levels can therefore be kept from becoming lower than they were at
rest without slopes becoming too steep.
"""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.ground.columns import BORDER, WALL

_ROOT = 1.4142135623730951


@kernel(inline="always")
def _limit_on_sheet(level, heights, columns, steep):
    """Highest top that the sheet's neighbours allow, the two neighbours that limit it, and the share of the second one."""
    limit, side, corner, share = np.inf, -1, -1, 0.0
    for k in range(4):
        for turn in range(2):
            d = 4 + k if turn == 0 else 4 + (k + 3) % 4
            beside, across = columns.neighbours[level, k], columns.neighbours[level, d]
            if beside < 0 and across < 0:
                continue
            first = columns.base[beside] + heights[beside] if beside >= 0 else np.inf
            second = columns.base[across] + heights[across] if across >= 0 else np.inf
            fall = first - second
            if fall >= steep / _ROOT:
                allowed, part = second + _ROOT * steep, 1.0
            elif fall <= 0.0:
                allowed, part = first + steep, 0.0
            else:
                rise = np.sqrt(steep * steep - fall * fall)
                allowed, part = first + rise, fall / rise
            if allowed < limit:
                limit, side, corner, share = allowed, beside, across, part
    return limit, side, corner, share


@kernel(inline="always")
def _limit_at_end(level, k, heights, columns, steep, film):
    """Highest top that the end of the sheet in direction k allows, and whether the cover beyond reaches up to the edge."""
    kind, beyond = columns.neighbours[level, k], columns.beyond[level, k]
    step = steep if k < 4 else _ROOT * steep
    if kind == BORDER:
        # Beyond the border the surface goes on with the same slope and cover, so cover runs out where the base is too steep.
        behind = columns.neighbours[level, (k + 2) % 4] if k < 4 else -1
        runs = behind >= 0 and columns.base[behind] - columns.base[level] > step
        return (columns.base[level] + film if runs else np.inf), False
    against = columns.base[beyond] + heights[beyond] + step if beyond >= 0 else (np.inf if kind == WALL else -np.inf)
    if kind == WALL:
        return against, True
    # Beyond a drop nothing supports the cover: it ends half a square away, with the film.
    edge = columns.base[level] + film + 0.5 * step
    return max(edge, against), against > edge


@kernel()
def _push(level, queue, queued, head, size):
    """Append a level to the ring `queue`; returns the new size."""
    queued[level] = True
    queue[(head + size) % len(queue)] = level
    return size + 1


@kernel()
def topple(start, heights, rested, columns, steep, film, slack, most):
    """Let cover run down.

    Args:
        start: [s] levels to examine first.
        heights: [l] thickness in metres, changed in place.
        rested: [l] thickness in metres when all cover was at rest; no level becomes thinner.
        columns: the levels.
        steep: rise in metres from square to square at the angle of repose.
        film: thickness in metres that does not move.
        slack: metres by which a top may be too high.
        most: largest number of moves.

    Returns:
        The levels [r] that remain to be examined, and the thickness in metres that fell where there is no level.
    """
    column, first = columns.column, columns.first
    nx, ny = columns.shape
    count = len(heights)
    queued = np.zeros(count, np.bool_)
    queue = np.empty(count, np.int32)
    head, size, moves, lost = 0, 0, 0, 0.0
    for level in start:
        size = _push(level, queue, queued, head, size)
    while size > 0 and moves < most:
        level = queue[head]
        head = head + 1 if head + 1 < count else 0
        size -= 1
        queued[level] = False
        if heights[level] - film <= slack:
            continue
        top, lowest, ended = columns.base[level] + heights[level], np.inf, False
        for k in range(8):
            near = columns.neighbours[level, k]
            if near >= 0:
                lowest = min(lowest, columns.base[near] + heights[near])
            else:
                ended = True
        if top - lowest <= steep + slack and not ended:
            continue  # the limit is never lower than this bound, which settles most visits
        limit, side, corner, share = _limit_on_sheet(level, heights, columns, steep)
        ending, leans, ends = np.inf, False, 0
        for k in range(8):
            if columns.neighbours[level, k] < 0:
                allowed, props = _limit_at_end(level, k, heights, columns, steep, film)
                if allowed < ending:
                    ending, leans, ends = allowed, props, 0
                ends += allowed == ending
        excess = top - min(limit, ending)
        loose = heights[level] - max(film, rested[level])
        if excess <= slack or loose <= 0.0:
            continue
        moves += 1
        if ending < limit:
            give = min(0.5 * excess if leans else excess, loose)
            for k in range(8):
                if columns.neighbours[level, k] < 0:
                    if _limit_at_end(level, k, heights, columns, steep, film)[0] != ending:
                        continue
                    onto = columns.beyond[level, k]
                    if onto >= 0:
                        heights[onto] += give / ends
                        if not queued[onto]:
                            size = _push(onto, queue, queued, head, size)
                    else:
                        lost += give / ends
        else:
            # To first order this brings the level onto the limit that its neighbours then set.
            give = min(excess / (1.0 + share * share + (1.0 - share) * (1.0 - share)), loose)
            if side >= 0:
                heights[side] += (1.0 - share) * give
            if corner >= 0:
                heights[corner] += share * give
            for onto in (side, corner):
                if onto >= 0 and not queued[onto]:
                    size = _push(onto, queue, queued, head, size)
        heights[level] = max(heights[level] - give, rested[level])  # the difference may be lower by round-off
        # Levels that this one supported may topple next, and so may the level itself.
        x, y = column[level] // ny, column[level] % ny
        for i in range(max(x - 1, 0), min(x + 2, nx)):
            for j in range(max(y - 1, 0), min(y + 2, ny)):
                for near in range(first[i * ny + j], first[i * ny + j + 1]):
                    if not queued[near] and heights[near] > film + slack:
                        size = _push(near, queue, queued, head, size)
    left = np.empty(size, np.int64)
    for n in range(size):
        left[n] = queue[(head + n) % count]
    return left, lost
