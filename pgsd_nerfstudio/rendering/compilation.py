"""How the numba kernels of this room are compiled, and run on several threads.

Compiled kernels are kept on disk and made anew when any file of this room changes: they are made of each other and of constants
from several files, where numba by itself looks only at the file that a kernel stands in.

Threads are Python's own, which run at once since kernels need no interpreter. numba's `parallel=True` would do the same for
twice the compilation, and its OpenMP threads spin while they wait for those of torch.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float

# Reordering and fused operations, but comparisons with NaN and infinity keep their meaning (no "nnan", no "ninf").
_MATH = {"reassoc", "contract", "arcp", "nsz", "afn"}


def room_stamp(folder: Path) -> tuple[tuple[str, float, int], ...]:
    """Name, time of the last change and size of every source file of a folder."""
    return tuple((path.name, path.stat().st_mtime, path.stat().st_size) for path in sorted(folder.glob("*.py")))


_STAMP = room_stamp(Path(__file__).parent)


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a kernel for one thread."""

    def decorate(function: Callable[..., Any]) -> Any:
        made: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_MATH, **options)(function)
        # What numba compares with the stamp in its index of compiled functions; it offers no public way to say more.
        made._cache._cache_file._source_stamp = _STAMP
        return made

    return decorate


inlined = partial(numba.njit, inline="always")
"""Decorator of a piece of a kernel."""


def workers() -> int:
    """How many threads kernels run on: as many as torch uses."""
    return torch.get_num_threads()


def share_out(work: Callable[..., None], count: int, *arguments: object) -> None:
    """Run `work(worker, count, *arguments)` for the workers 0 .. count - 1, each on a thread of its own."""
    others = [_pool().submit(work, worker, count, *arguments) for worker in range(1, count)]
    work(0, count, *arguments)
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(os.cpu_count() or 1, workers()), thread_name_prefix="rasterizer")


def aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """Zeros in float32 that begin with a cache line, so that sixteen of them never lie across two."""
    size = int(np.prod(shape))
    buffer = np.zeros(size + 16, np.float32)
    start = -(buffer.ctypes.data // 4) % 16
    return buffer[start : start + size].reshape(shape)
