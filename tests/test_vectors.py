"""The width of vectors in compiled kernels."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pgsd_nerfstudio.vectors import NEW_ENOUGH, widest


def test_only_cpus_that_keep_their_clock_take_wide_vectors():
    new = {name: True for name in NEW_ENOUGH} | {"amx-tile": False}
    assert widest(new) == "-amx-tile,+avx512f,+avx512vl,+avx512vpopcntdq,-prefer-256-bit"
    assert widest({**new, "avx512vpopcntdq": False}) is None  # Skylake
    assert widest({"avx2": True, "fma": True}) is None
    assert widest({"neon": True}) is None


@pytest.mark.parametrize("first", ["rendering.blending", "physics.air.airborne", "surface.mesh", "dynamics.in_sight"])
def test_whichever_room_comes_first_the_width_is_set_before_its_kernels(first):
    """Fewer bits would be kept under another key, and all kernels compiled twice."""
    code = (
        f"import pgsd_nerfstudio.{first}\n"
        "import llvmlite.binding as llvm\n"
        "from numba.core.registry import cpu_target\n"
        "from pgsd_nerfstudio.vectors import widest\n"
        "found, wanted = cpu_target.target_context.codegen()._tm_features, widest(llvm.get_host_cpu_features())\n"
        "print(wanted is None or found == wanted)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_CPU")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_what_the_user_says_is_left_alone():
    code = "import pgsd_nerfstudio.vectors; from numba.core import config; print(config.CPU_FEATURES)"
    environment = {**os.environ, "NUMBA_CPU_FEATURES": "+sse2"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "+sse2"
