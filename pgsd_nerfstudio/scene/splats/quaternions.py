"""Unit quaternions that files pack as their three smaller parts."""

from __future__ import annotations

import numpy as np


def with_largest(small: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions of their three smaller parts.

    Args:
        small: [n, 3], in the order that they have in the quaternion.
        largest: [n], which of the four parts is missing, 0..3; it is positive.
    """
    out = np.empty((len(small), 4), np.float32)
    rows = np.arange(len(small))
    for i in range(3):
        out[rows, i + (i >= largest)] = small[:, i]
    out[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1)))
    return out
