"""How the numba kernels of this room are compiled and run.

Compiled kernels are kept on disk and made anew when the file they stand in changes, but not when a kernel or a constant from
another file does: after such a change, delete __pycache__.
"""

from __future__ import annotations

import threading
from functools import partial

import numba
import numpy as np

# GNU OpenMP comes with every numba wheel; TBB is refused beside Open3D's older one, and "workqueue" crashes when two Python
# threads render at once. Set before the first parallel kernel is compiled.
numba.config.THREADING_LAYER = "omp"  # type: ignore[attr-defined]

# Reordering and fused operations, but comparisons with NaN and infinity keep their meaning (no "nnan", no "ninf").
_MATH = {"reassoc", "contract", "arcp", "nsz", "afn"}

kernel = partial(numba.njit, cache=True, nogil=True, error_model="numpy", fastmath=_MATH)
"""Decorator of a kernel for one thread."""

parallel_kernel = partial(numba.njit, cache=True, nogil=True, error_model="numpy", fastmath=_MATH, parallel=True)
"""Decorator of a kernel that runs on all threads."""

inlined = partial(numba.njit, inline="always")
"""Decorator of a piece of a kernel."""

rendering_lock = threading.RLock()
"""Held while kernels run: several Python threads (a viewer beside a training) may render, one at a time."""


@kernel()
def aligned(rows, columns):
    """Uninitialised float32 [rows, columns] that begins with a cache line: 16 floats then never lie across two of them."""
    buffer = np.empty(rows * columns + 16, np.float32)
    start = (-(buffer.ctypes.data // 4)) % 16
    return buffer[start : start + rows * columns].reshape(rows, columns)
