"""Vectors of 512 bits in the kernels that numba compiles, where the CPU runs them at its full speed.

LLVM takes 256 bits on Intel's CPUs, since the first that had AVX-512 lowered their clock for it. From Ice Lake on they hardly
do, and a row of a tile of the rasterizer is one vector of 16 floats. numba reads its options when its first kernel is declared,
so rooms with kernels import this module first; the width is a part of the key under which numba keeps compiled kernels.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import llvmlite.binding as llvm
from numba.core import config

NEW_ENOUGH = ("avx512f", "avx512vl", "avx512vpopcntdq")
"""Features that CPUs have together from Ice Lake and Zen 4 on."""


def widest(features: Mapping[str, bool]) -> str | None:
    """Features for numba that allow vectors of 512 bits; None where it should choose itself.

    Args:
        features: which features the CPU has, by LLVM's names.
    """
    if not all(features.get(name) for name in NEW_ENOUGH):
        return None
    return ",".join([*(f"{'+' if there else '-'}{name}" for name, there in sorted(features.items())), "-prefer-256-bit"])


# What the user has set with NUMBA_CPU_FEATURES, or for another CPU than this one, is left alone.
if not os.environ.get("NUMBA_CPU_FEATURES") and not os.environ.get("NUMBA_CPU_NAME"):
    config.CPU_FEATURES = widest(llvm.get_host_cpu_features())  # type: ignore[attr-defined]
