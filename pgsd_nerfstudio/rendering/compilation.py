"""Compilation of this room's numba kernels, and their work on several threads.

Kernels are compiled anew when any file of this room changes: a walk that numba chooses by the type of an argument (walk.py) is
not among the kernels that a module imports, which is all that `kernels` follows.

The threads are Python's own; they run in parallel since kernels release the interpreter's lock. numba's `parallel=True` would
do the same for twice the compilation, and its OpenMP threads spin while they wait for those of torch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial
from pathlib import Path

import numba
import numpy as np
import torch
from jaxtyping import Float

from pgsd_nerfstudio import kernels
from pgsd_nerfstudio.kernels import file_stamp

FEW = 1_000_000  # numbers up to which a step of torch is short

# Reordering and fused operations, but comparisons with NaN and infinity keep their meaning (no "nnan", no "ninf").
_MATH = {"reassoc", "contract", "arcp", "nsz", "afn"}


def room_stamp(folder: Path) -> tuple[tuple[str, float, int], ...]:
    """Stamps of all source files of a folder."""
    return tuple(map(file_stamp, sorted(folder.glob("*.py"))))


kernel = partial(kernels.kernel, also=room_stamp(Path(__file__).parent), error_model="numpy", fastmath=_MATH)
"""Decorator that compiles a function as a kernel for one thread; it takes further options of `numba.njit`."""

inlined = partial(numba.njit, inline="always")
"""Decorator of a function whose source numba puts into the kernels that call it, where their options hold for it."""


_held: ContextVar[int | None] = ContextVar("threads of the kernels while torch has one", default=None)


def workers() -> int:
    """Number of threads that kernels run on: as many as torch uses, or used before `small_steps`."""
    return _held.get() or torch.get_num_threads()


@contextmanager
def small_steps(numbers: int) -> Iterator[None]:
    """While many short steps of torch follow each other, give it one thread; kernels keep theirs.

    A picture is a hundred steps over some 100,000 numbers each. Threads that share such a step mostly wait for each other: they
    double its CPU time and hardly shorten it.

    Args:
        numbers: that the largest step works on; if they are many, torch keeps its threads.
    """
    threads = torch.get_num_threads()
    if threads == 1 or numbers > FEW:
        yield
        return
    before = _held.set(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _held.reset(before)


def share_out(work: Callable[..., None], count: int, *arguments: object) -> None:
    """Call `work(worker, count, *arguments)` for each worker 0 .. count - 1 on a thread of its own, and wait for all.

    Args:
        work: a kernel; it does the share of one worker.
        count: number of workers.
        *arguments: passed on to every worker.
    """
    others = [_pool().submit(work, worker, count, *arguments) for worker in range(1, count)]
    work(0, count, *arguments)
    for other in others:
        other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(os.cpu_count() or 1, workers()), thread_name_prefix="rasterizer")


def aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """Zeros in float32 that begin with a cache line, so that an aligned group of sixteen never spans two lines.

    Args:
        *shape: of the array; the last side is a multiple of 16 if each row is to be aligned.
    """
    size = int(np.prod(shape))
    buffer = np.zeros(size + 16, np.float32)
    start = -(buffer.ctypes.data // 4) % 16
    return buffer[start : start + size].reshape(shape)
