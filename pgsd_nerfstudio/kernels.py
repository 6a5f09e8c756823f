"""Kernels for one thread: numba's, kept on disk in compiled form, and compiled anew when anything changes that they contain.

A compiled kernel contains the kernels that it calls and the constants that it reads, wherever these are written. numba looks at
the kernel's own file only, and would go on running what it has compiled after a change in another file. So what it keeps is
stamped here with the files of all kernels that a module imports, and with the values of all constants that it sees.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba.core.registry import CPUDispatcher

from pgsd_nerfstudio import vectors as vectors  # before the first kernel

Stamp = tuple[Any, ...]


def kernel(*, also: Stamp = (), **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator that compiles a function as a kernel, which releases the interpreter's lock.

    Args:
        also: stamp of what the kernel contains besides, which its module does not show.
        **options: further options of `numba.njit`.
    """

    def decorate(function: FunctionType) -> Any:
        made: Any = numba.njit(cache=True, nogil=True, **options)(function)
        # numba compares this with the stamp in its index of compiled functions; there is no public way to set it.
        made._cache._cache_file._source_stamp = (*also, *stamp(function.__globals__))
        return made

    return decorate


def stamp(names: Mapping[str, Any]) -> Stamp:
    """What the kernels of a module contain: its file, the files of the kernels that it has imported, and its constants.

    Args:
        names: of the module, all of whose imports are done.
    """
    own = names["__name__"]
    called = sorted({value.py_func.__module__ for value in names.values() if isinstance(value, CPUDispatcher)} - {own})
    constants = sorted((name, repr(value)) for name, value in _constants(names))
    return file_stamp(Path(names["__file__"])), *map(_of_module, called), *constants


@cache
def _of_module(name: str) -> Stamp:
    return stamp(vars(sys.modules[name]))


def file_stamp(path: Path) -> tuple[str, float, int]:
    """Name of a file, time of its last change and size in bytes."""
    return path.name, path.stat().st_mtime, path.stat().st_size


def _constants(names: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in names.items():
        if not name.startswith("__") and _is_plain(value):
            yield name, value


def _is_plain(value: object) -> bool:
    """Whether a value is a number, a word, or a tuple of such: what reads the same in every process."""
    return isinstance(value, int | float | str | np.generic) or (isinstance(value, tuple) and all(map(_is_plain, value)))
