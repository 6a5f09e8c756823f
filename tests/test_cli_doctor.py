"""pgsd doctor: what works, what is missing and what to do, judged on machines that are made up here and on this one."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pgsd_nerfstudio.cli import findings, main
from pgsd_nerfstudio.cli.findings import PACKAGES, Broken, Finding, examine, probe, whole
from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.guidance.folder import BUNDLED
from pgsd_nerfstudio.version import __version__

GPU = {"name": "H200", "free": 100e9, "total": 140e9}
WORKS: dict[str, dict[str, Any]] = {
    "torch": {"version": "2.15.0", "cuda": "13.2", "threads": 2, "devices": []},
    "gsplat": {"version": "1.4.0", "compiled": True, "lacks": [], "triton": True},
    "open3d": {"version": "0.20.0"},
    "taichi": {"version": "1.7.4"},
    "numba": {"version": "0.68.1", "folder": "kernels", "kernels": 60},
}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """A machine on which all works, with what is told to be otherwise; returns its findings by name."""
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "cache"))

    def made(gpu: bool = False, broken: dict[str, str] | None = None, **otherwise: dict[str, Any]) -> dict[str, Finding]:
        def probed(name: str) -> dict[str, Any]:
            if broken and name in broken:
                raise Broken(broken[name])
            return {**WORKS[name], **otherwise.get(name, {})}

        monkeypatch.setattr(findings, "has_nvidia", lambda: gpu)
        monkeypatch.setattr(findings, "probe", probed)
        return {each.name: each for each in examine()}

    return made


def missing(found: dict[str, Finding]) -> list[str]:
    return [name for name, each in found.items() if each.state == "missing"]


def test_a_machine_without_a_gpu_needs_none(machine):
    found = machine()
    assert missing(found) == [] and "gsplat" not in found
    assert found["CUDA"].state == "slow" and "CPU" in found["CUDA"].found


def test_a_machine_with_a_gpu_needs_its_driver_and_kernels(machine):
    found = machine(gpu=True, torch={"devices": [GPU]})
    assert missing(found) == [] and "100 GB of 140 GB free" in found["CUDA"].found
    found = machine(gpu=True)
    assert missing(found) == ["CUDA"] and "driver" in found["CUDA"].todo
    found = machine(gpu=True, torch={"devices": [GPU]}, gsplat={"compiled": False, "lacks": ["nvcc"]})
    assert missing(found) == ["gsplat"] and "nvcc" in found["gsplat"].found and found["gsplat"].todo
    found = machine(gpu=True, torch={"devices": [GPU]}, gsplat={"compiled": False})
    assert missing(found) == [] and found["gsplat"].state == "slow"
    found = machine(gpu=True, torch={"devices": [GPU]}, gsplat={"triton": False})
    assert missing(found) == ["CUDA libraries"] and "PGSD_CUDA=1" in found["CUDA libraries"].todo


@pytest.mark.parametrize("library", PACKAGES)
def test_a_missing_system_library_is_named_by_its_package(machine, library: str):
    said = f"ImportError: {library}: cannot open shared object file: No such file or directory"
    found = machine(broken={"open3d": said})
    assert missing(found) == ["open3d"] and f"apt-get install {PACKAGES[library]}" in found["open3d"].todo


@pytest.mark.parametrize("name", [name for name in WORKS if name != "gsplat"])
def test_a_library_that_cannot_be_loaded_is_missing(machine, name: str):
    found = machine(broken={name: "ModuleNotFoundError: no such module"})
    assert missing(found) == [name] and found[name].todo


def test_kernels_that_are_compiled_later_are_slow(machine):
    assert machine(numba={"kernels": 0})["numba"].state == "slow"
    found = machine(numba={"folder": None})["numba"]
    assert found.state == "slow" and "NUMBA_CACHE_DIR" in found.todo


def test_little_memory_and_a_full_disk_are_said(machine, monkeypatch: pytest.MonkeyPatch):
    import psutil

    memory = psutil.virtual_memory()
    for available, state in ((1e9, "missing"), (4e9, "slow"), (20e9, "ok")):
        monkeypatch.setattr(psutil, "virtual_memory", lambda free=available: memory._replace(available=int(free)))
        assert machine()["memory"].state == state
    usage = shutil.disk_usage("/")
    for free, state in ((1e8, "missing"), (1e9, "slow"), (1e11, "ok")):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: usage._replace(free=int(free)))
        assert machine()["disk of the cache"].state == machine()["disk here"].state == state


def test_a_container_without_proc_is_examined_too(machine, monkeypatch: pytest.MonkeyPatch):
    import psutil

    def absent() -> None:
        raise FileNotFoundError("/proc/meminfo")

    monkeypatch.setattr(psutil, "virtual_memory", absent)
    assert "cannot be told" in machine()["memory"].found


def test_a_cache_that_cannot_be_written_is_missing(machine, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    found = machine()
    assert missing(found) == ["cache"] and "PGSD_CACHE" in found["cache"].todo


def test_weights_that_are_cut_short_are_noticed(machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = next(BUNDLED.rglob("*.safetensors"))
    assert whole(path)
    data = path.read_bytes()
    for damaged in (data[:-1], data[:5], b"version https://git-lfs.github.com/spec/v1\n", b"", data + b"\0"):
        (tmp_path / "cut.safetensors").write_bytes(damaged)
        assert not whole(tmp_path / "cut.safetensors")
    monkeypatch.setattr(findings, "whole", lambda _: False)
    assert missing(machine()) == ["bundled prior"]


def test_an_ffmpeg_that_is_not_there_is_missing(machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "ffmpeg"))
    assert missing(machine()) == ["ffmpeg"]


def test_the_exit_code_says_whether_something_is_missing(machine, capsys: pytest.CaptureFixture):
    machine()
    assert run(["doctor"]) == 0 and "Everything that this machine needs works." in capsys.readouterr().out
    machine(broken={"taichi": "ImportError: gone"})
    assert run(["doctor", "--json"]) == 1
    found = {each["name"]: each for each in json.loads(capsys.readouterr().out)}
    assert found["taichi"]["state"] == "missing" and found["taichi"]["found"] == "ImportError: gone"
    assert run(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "ImportError: gone" in said and "Everything" not in said


def test_a_library_that_takes_the_process_with_it_is_only_broken(monkeypatch: pytest.MonkeyPatch):
    def crash(*_: Any, **__: Any) -> subprocess.CompletedProcess:
        return subprocess.CompletedProcess([], -signal.SIGILL, "", "")

    monkeypatch.setattr(subprocess, "run", crash)
    with pytest.raises(Broken, match=f"crashed with signal {int(signal.SIGILL)}"):
        probe("torch")


def test_this_machine_is_examined_within_its_time():
    began = os.times().children_user
    done = subprocess.run(
        [sys.executable, "-m", "pgsd_nerfstudio.cli.main", "doctor", "--json"], capture_output=True, text=True
    )
    cpu = os.times().children_user - began
    found = {each["name"]: each for each in json.loads(done.stdout)}
    assert done.returncode == int(any(each["state"] == "missing" for each in found.values())), done.stderr
    assert {"python", "torch", "CUDA", "open3d", "taichi", "numba", "ffmpeg", "bundled prior", "cache", "memory"} <= {*found}
    assert all(found[name]["state"] == "ok" for name in ("python", "torch", "open3d", "taichi", "ffmpeg", "bundled prior"))
    assert cpu < 20, f"{cpu:.1f} s of two processors are more than 10 s"


def test_the_version_is_said(capsys: pytest.CaptureFixture):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"pgsd_nerfstudio {__version__}\n"


@pytest.mark.parametrize("moment", ["parsing", "running"])
def test_an_interrupted_command_ends_as_shells_have_it(
    moment: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(*((main.tyro, "cli") if moment == "parsing" else (findings, "examine")), interrupt)
    assert run(["doctor"]) == 128 + signal.SIGINT
    said = capsys.readouterr().err
    assert said.startswith("pgsd: interrupted") and "Traceback" not in said


def test_nothing_is_said_before_a_command_begins():
    """nerfstudio's import meets deprecations of torch, which its users can do nothing about."""
    program = "import sys; sys.argv = ['ns-train']; import nerfstudio.engine.trainer, torch.utils.flop_counter"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=clean)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_reader_that_has_seen_enough_is_no_error():
    program = "import pgsd_nerfstudio.cli.main as door; door.run = lambda: print('row\\n' * 100_000); door.main()"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "row\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1
