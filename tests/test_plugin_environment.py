"""What nerfstudio needs of the process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.plugin import environment
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.scene.scene import SceneError


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


@pytest.mark.parametrize("error", [SceneError("no scene at x"), RunError("the motion prior is missing")])
def test_errors_that_are_sentences_leave_without_a_traceback(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    environment._show_sentences()
    sys.excepthook(type(error), error, None)
    assert capsys.readouterr().err == f"pgsd-weather: {error}\n"


def test_an_interrupted_command_ends_without_a_traceback_and_with_130():
    program = "import os, signal, time, pgsd_nerfstudio.plugin.environment as e; e._show_sentences()"
    waiting = f"{program}; os.kill(os.getpid(), signal.SIGINT); time.sleep(30)"
    done = subprocess.run(["bash", "-c", f"{sys.executable} -c '{waiting}'; exit $?"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_other_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch):
    shown = []
    monkeypatch.setattr(sys, "excepthook", lambda *found: shown.append(found))
    environment._show_sentences()
    environment._show_sentences()
    error = ValueError("a bug")
    sys.excepthook(ValueError, error, None)
    assert shown == [(ValueError, error, None)]
