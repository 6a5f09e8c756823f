"""How figures are timed on a machine that others disturb: several calls, of which the fastest counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


def best(call: Callable[[], object], times: int) -> float:
    """Seconds by the clock of the fastest of several calls, after one that is not counted."""
    seconds = []
    for _ in range(times + 1):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return min(seconds[1:])


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    usual = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(usual)


def least(work: Callable[[], object], tries: int, *, threads: int = 1, wall: bool = False, warm: bool = True) -> float:
    """Milliseconds of CPU time, or of the clock: the least of several tries, since what others do on the machine only adds."""
    clock = time.perf_counter if wall else time.process_time
    times = []
    with on_threads(threads):
        if warm:
            work()
        for _ in range(tries):
            began = clock()
            work()
            times.append(clock() - began)
    return 1e3 * min(times)
