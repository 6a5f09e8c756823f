"""Which flying particles end in a frame without landing: outside of the domain, ahead of the weather's front, or unseen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain

_CONTACT, _OUT, _AHEAD, _UNSEEN = 1, 2, 3, 4


class Leaving(NamedTuple):
    """Indices of flying particles, ascending."""

    stays: Int[ndarray, " s"]
    """Those that fly on, uint32: without a contact and not among the three below."""
    out: Int[ndarray, " o"]
    """Outside of the domain."""
    ahead: Int[ndarray, " a"]
    """Ahead of the front."""
    unseen: Int[ndarray, " u"]
    """Where no camera shows them within their reach."""
    broken: int
    """Number of particles whose position or velocity is NaN or infinite."""

    @staticmethod
    def of(
        bodies: Bodies,
        contacts: Int[ndarray, " c"],
        domain: Domain,
        sight: Sight,
        passed: Bool[ndarray, " n"] | None,
        over: Bool[ndarray, " n"] | None = None,
    ) -> Leaving:
        """The particles that do not fly on.

        Args:
            bodies: all that fly.
            contacts: indices of those with a contact, ascending.
            domain: the simulated air.
            sight: the region of sight.
            passed: whether the front has passed each particle; None: it has passed all.
            over: whether each particle has been seen for the last time; None: none has.
        """
        lower, upper = np.asarray(domain.lower, np.float32), np.asarray(domain.upper, np.float32)
        passed, over = (np.ones(0, bool) if flags is None else flags for flags in (passed, over))
        places, distances = (sight.lower, sight.cell), np.ascontiguousarray(sight.needed_distances)
        stays, gone, why, broken = _leaving(
            bodies.positions, bodies.velocities, bodies.reaches, contacts, lower, upper, passed, over, *places, distances
        )
        out, ahead, unseen = (gone[why == reason] for reason in (_OUT, _AHEAD, _UNSEEN))
        return Leaving(stays, out, ahead, unseen, broken)


@kernel()
def _leaving(positions, velocities, reaches, contacts, lower, upper, passed, over, corner, cell, distances):
    count = len(positions)
    stays, gone, why = np.empty(count, np.uint32), np.empty(count, np.int64), np.empty(count, np.uint8)
    stay, found, broken, contact = 0, 0, 0, 0
    nx, ny, nz = distances.shape
    for n in range(count):
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        size = abs(x) + abs(y) + abs(z) + abs(velocities[n, 0]) + abs(velocities[n, 1]) + abs(velocities[n, 2])
        if not size < np.inf:
            broken += 1
            continue
        reason = 0
        if contact < len(contacts) and contacts[contact] == n:
            contact += 1
            reason = _CONTACT
        elif x < lower[0] or y < lower[1] or z < lower[2] or x > upper[0] or y > upper[1] or z > upper[2]:
            reason = _OUT
        elif len(passed) > 0 and not passed[n]:
            reason = _AHEAD
        elif len(over) > 0 and over[n]:
            reason = _UNSEEN
        elif nx > 0:
            i = min(max(int((x - corner[0]) / cell[0]), 0), nx - 1)
            j = min(max(int((y - corner[1]) / cell[1]), 0), ny - 1)
            k = min(max(int((z - corner[2]) / cell[2]), 0), nz - 1)
            if not distances[i, j, k] <= reaches[n]:
                reason = _UNSEEN
        if reason == 0:
            stays[stay] = n
            stay += 1
        else:
            gone[found], why[found] = n, reason
            found += 1
    return stays[:stay].copy(), gone[:found].copy(), why[:found].copy(), broken
