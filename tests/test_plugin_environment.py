"""What nerfstudio needs of the process."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.plugin import environment


def test_an_ffmpeg_is_offered_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "cache"))
    environment._offer_ffmpeg()
    found = shutil.which("ffmpeg")
    assert found is not None
    assert b"ffmpeg version" in subprocess.run([found, "-version"], capture_output=True, check=True).stdout


def test_the_users_own_ffmpeg_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    environment._offer_ffmpeg()
    assert os.environ["PATH"] == str(tmp_path)


def test_checkpoints_with_numpy_scalars_can_be_loaded(tmp_path: Path):
    environment.allow_numpy_scalars()
    torch.save({"lr": np.float64(0.25)}, tmp_path / "step.ckpt")
    assert torch.load(tmp_path / "step.ckpt")["lr"] == 0.25
