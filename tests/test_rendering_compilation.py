"""Compiled kernels follow their sources, all of them; work is shared out completely."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import pgsd_nerfstudio
from pgsd_nerfstudio.rendering.compilation import aligned, room_stamp, share_out, small_steps, workers

PACKAGE = Path(pgsd_nerfstudio.__file__).parent
COUNT = """
import numpy as np
from pgsd_nerfstudio.rendering import binning
binning.visible_by_depth(np.zeros((4, 16), np.float32))
print(sum(binning.visible_by_depth.stats.cache_hits.values()))
"""


def hits(folder: Path) -> int:
    """How many kernels a new process found compiled."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "kernels")}
    command = [sys.executable, "-c", COUNT]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_a_change_in_another_file_of_the_room_compiles_anew(tmp_path: Path):
    shutil.copytree(PACKAGE, tmp_path / "pgsd_nerfstudio", ignore=shutil.ignore_patterns("__pycache__", "bundled"))
    assert [hits(tmp_path), hits(tmp_path)] == [0, 1]
    with (tmp_path / "pgsd_nerfstudio" / "rendering" / "projection.py").open("a") as source:
        source.write("# changed\n")
    assert [hits(tmp_path), hits(tmp_path)] == [0, 1]


def test_the_stamp_tells_sources_apart(tmp_path: Path):
    (tmp_path / "a.py").write_text("one")
    before = room_stamp(tmp_path)
    assert before == room_stamp(tmp_path)
    (tmp_path / "a.py").write_text("longer")
    assert room_stamp(tmp_path) != before


@pytest.mark.parametrize("count", [1, 2, 7])
def test_every_worker_works_once(count: int):
    seen: list[tuple[int, int]] = []
    share_out(lambda worker, workers, offset: seen.append((worker + offset, workers)), count, 10)
    assert sorted(seen) == [(10 + k, count) for k in range(count)]


def test_what_fails_in_a_worker_is_raised():
    def fail(worker: int, workers: int) -> None:
        if worker == 1:
            raise ValueError("of the second")

    with pytest.raises(ValueError, match="of the second"):
        share_out(fail, 3)


def test_scratch_begins_with_a_cache_line():
    for shape in ((1, 3), (2, 16, 80), (5, 160)):
        made = aligned(*shape)
        assert made.shape == shape and made.ctypes.data % 64 == 0 and not made.any()


def test_the_number_of_threads_does_not_change_the_picture():
    from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
    from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians

    usual, pictures = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            rasterizer = CpuRasterizer(random_gaussians(300, 1), layers=None)
            pictures.append(rasterizer.render(random_cameras(1, 50, 70), random_gaussians(200, 2)).rgb)
    finally:
        torch.set_num_threads(usual)
    assert torch.equal(pictures[0], pictures[1]) and torch.equal(pictures[0], pictures[2])


def test_short_steps_get_one_thread_and_kernels_keep_theirs():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with small_steps(1000):
            assert (torch.get_num_threads(), workers()) == (1, 3)
            with small_steps(1000):
                assert (torch.get_num_threads(), workers()) == (1, 3)
            assert (torch.get_num_threads(), workers()) == (1, 3)
        assert (torch.get_num_threads(), workers()) == (3, 3)
        with small_steps(10_000_000):
            assert (torch.get_num_threads(), workers()) == (3, 3)
        with pytest.raises(ValueError, match="inside"), small_steps(1000):
            raise ValueError("inside")
        assert (torch.get_num_threads(), workers()) == (3, 3)
    finally:
        torch.set_num_threads(before)
