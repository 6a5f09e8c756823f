"""Order of points along a Morton curve (Morton 1966), on which points near each other in space are mostly near in memory."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel


def along_curve(points: Float[ndarray, "n 3"], lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]) -> Int[ndarray, " n"]:
    """Indices of points in their order along a curve through a box.

    Args:
        points: m.
        lower: corner of the box, m; it is divided into 32 cells along each axis.
        upper: opposite corner of the box, m.
    """
    # A stable sort of 16 bits is a radix sort.
    return np.argsort(_keys(points, lower, 32 / np.maximum(upper - lower, 1e-9)), kind="stable")


@kernel()
def _keys(points, lower, scale):
    keys = np.zeros(len(points), np.uint16)
    for n in range(len(points)):
        key = 0
        for axis in range(3):
            cell = int(min(max((points[n, axis] - lower[axis]) * scale[axis], 0.0), 31.0))
            for bit in range(5):
                key |= ((cell >> bit) & 1) << (3 * bit + axis)
        keys[n] = key
    return keys
