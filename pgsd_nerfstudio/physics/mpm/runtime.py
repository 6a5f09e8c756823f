"""Taichi, started once per process and precision.

Kernels are compiled for the precision that Taichi was started with, since their literals take it. Another precision or device
means starting anew, which ends every solver that was made before; they say so when they are used again.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any, Literal

import taichi as ti
import torch

Precision = Literal["f32", "f64"]
Device = Literal["cpu", "cuda"]

_running: tuple[Device, Precision, int] | None = None
_starts = 0


def start(device: Device, precision: Precision, threads: int = 0) -> int:
    """Make sure that Taichi runs like this; returns a number that changes whenever it was started anew.

    Raises:
        ValueError: the device or precision is unknown, or there is no CUDA device.
    """
    global _running, _starts
    if device not in ("cpu", "cuda") or precision not in ("f32", "f64"):
        raise ValueError(f"MPM runs on cpu or cuda in f32 or f64, got {device!r} and {precision!r}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("MPM was asked to run on cuda, but torch finds no CUDA device; use device='cpu'")
    if _running != (device, precision, threads):
        options: dict[str, Any] = {"cpu_max_num_threads": threads} if threads else {}
        with contextlib.redirect_stdout(io.StringIO()):  # Taichi says hello, whatever the log level
            ti.init(
                arch=ti.cuda if device == "cuda" else ti.cpu,
                default_fp=ti.f64 if precision == "f64" else ti.f32,
                log_level=ti.WARN,
                **options,
            )
        _running = (device, precision, threads)
        _starts += 1
    return _starts


def started() -> int:
    """The number that the last `start` returned."""
    return _starts


def dtype_of(precision: Precision) -> torch.dtype:
    """Torch's name of the precision."""
    return torch.float64 if precision == "f64" else torch.float32
