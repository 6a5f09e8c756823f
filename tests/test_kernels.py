"""Compiled kernels follow the kernels that they call and the constants that they read, in whatever file these are written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

INNER = """
from pgsd_nerfstudio.kernels import kernel

FACTOR = 2.0


@kernel({options})
def inner(x):
    return {term}
"""
OUTER = """
from {factors} import FACTOR
from inner import inner
from pgsd_nerfstudio.kernels import kernel


@kernel()
def outer(x):
    return FACTOR * inner(x)


print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""


def write(folder: Path, *, term: str = "x + 1.0", options: str = "", factor: str | None = None) -> None:
    (folder / "inner.py").write_text(INNER.format(options=options, term=term))
    if factor is not None:
        (folder / "factors.py").write_text(f"FACTOR = {factor}\n")
    if not (folder / "outer.py").exists():
        (folder / "outer.py").write_text(OUTER.format(factors="inner" if factor is None else "factors"))


def run(folder: Path) -> tuple[float, int]:
    """What a new process computes, and how many kernels it found compiled."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "NUMBA_CACHE_DIR": str(folder / "kept")}
    command = [sys.executable, "-B", "outer.py"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    value, hits = done.stdout.split()
    return float(value), int(hits)


@pytest.mark.parametrize("options", ["", 'inline="always"'], ids=["called", "inlined"])
def test_a_kernel_in_another_file_that_changes_is_compiled_anew(tmp_path: Path, options: str):
    write(tmp_path, options=options)
    assert [run(tmp_path), run(tmp_path)] == [(4.0, 0), (4.0, 1)]
    (tmp_path / "unrelated.py").write_text("# a file that no kernel imports\n")
    assert run(tmp_path) == (4.0, 1)
    write(tmp_path, options=options, term="x + 10.0")
    assert [run(tmp_path), run(tmp_path)] == [(22.0, 0), (22.0, 1)]


def test_a_constant_of_another_file_that_changes_is_read_anew(tmp_path: Path):
    write(tmp_path, factor="2.0")
    assert [run(tmp_path), run(tmp_path)] == [(4.0, 0), (4.0, 1)]
    write(tmp_path, factor="3.0")
    assert run(tmp_path)[0] == 6.0
