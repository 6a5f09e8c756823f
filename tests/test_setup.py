"""scripts/test and scripts/demo on machines where something is missing: they say what, before anything is downloaded.

scripts/prove_setup shows both in a bare Debian; here programs that they call are made up.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = (
    "bash",
    "sh",
    "cat",
    "cksum",
    "dirname",
    "uname",
    "id",
    "awk",
    "sed",
    "grep",
    "mktemp",
    "rm",
    "rmdir",
    "mkdir",
    "ls",
)


@dataclass
class Machine:
    """A folder of programs, which are all that scripts/test finds."""

    folder: Path

    def has(self, name: str, script: str) -> None:
        program = self.folder / "bin" / name
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)

    def has_python(self, name: str, version: str, lacks: str = "") -> None:
        """An interpreter that tells its version and the system packages that it lacks, and can do nothing else."""
        self.has(
            name, f'case "$1" in -c) echo {version};; -) echo "{lacks}";; --version) echo Python {version};; *) exit 9;; esac'
        )

    def run(self, **environment: str) -> subprocess.CompletedProcess[str]:
        given = {"PATH": str(self.folder / "bin"), "HOME": str(self.folder), "PGSD_VENV": str(self.folder / "venv")}
        done = subprocess.run(
            ["bash", str(ROOT / "scripts" / "test"), "--version"],
            env={**given, **environment},
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert not (self.folder / "venv").exists() and not (self.folder / ".cache").exists()
        return done


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    (tmp_path / "bin").mkdir()
    for name in PROGRAMS:
        found = shutil.which(name)
        if found is None:
            pytest.skip(f"needs {name}")
        (tmp_path / "bin" / name).symlink_to(found)
    made = Machine(tmp_path)
    made.has("df", "echo Filesystem; echo /dev/x 999999999 1 999999999 1% /")
    return made


@pytest.mark.parametrize("version", ["3.9", "3.10", "3.13", "3.14"])
def test_another_python_is_refused_with_what_was_looked_for_and_found(machine: Machine, version: str):
    machine.has_python("python3", version)
    done = machine.run()
    assert done.returncode == 1
    assert f"looked for python3.11 python3.12 python3, found python3 is Python {version}" in done.stderr


def test_without_any_python_it_is_said(machine: Machine):
    done = machine.run()
    assert done.returncode == 1 and "Python 3.11 or 3.12 is needed" in done.stderr and "found none of them" in done.stderr
    done = machine.run(PYTHON="a place/python")
    assert done.returncode == 1 and "looked for a place/python, found none of them" in done.stderr


@pytest.mark.parametrize("name", ["python3.11", "python3.12", "python3"])
def test_a_missing_system_package_is_named_with_the_one_command_that_installs_it(machine: Machine, name: str):
    machine.has_python("python3", "3.13")
    machine.has_python(name, "3.12" if name == "python3.12" else "3.11", lacks="libgl1 libegl1")
    machine.has("sudo", "exit 1")
    done = machine.run()
    assert done.returncode == 1 and "PyPI does not have them: libgl1 libegl1" in done.stderr
    commands = [line.strip() for line in done.stderr.splitlines() if line.startswith("    ")]
    assert len(commands) == 1
    assert commands[0].endswith("'apt-get update && apt-get install -y --no-install-recommends libgl1 libegl1'")


def test_root_or_whoever_needs_no_password_gets_it_installed(machine: Machine):
    machine.has_python("python3", "3.11", lacks="libgl1")
    machine.has("sudo", 'test "$1" = -n || exec "$@"')
    machine.has("apt-get", f'echo "$@" >> {machine.folder}/asked')
    done = machine.run()
    assert (machine.folder / "asked").read_text() == "update\ninstall -y --no-install-recommends libgl1\n"
    assert "apt-get: libgl1" in done.stdout and done.returncode == 1  # it is still missing on this machine


def test_a_small_disk_is_refused(machine: Machine):
    machine.has_python("python3", "3.11")
    machine.has("df", "echo Filesystem; echo /dev/x 9 9 3000000 1% /")
    done = machine.run(PGSD_CUDA="1")
    assert done.returncode == 1 and "needs 8 GB, found 3 GB free" in done.stderr and "PGSD_VENV=/path" in done.stderr
    done = machine.run(PGSD_CUDA="0")
    assert "needs 7 GB, found 3 GB free" in done.stderr
    assert "PGSD_CUDA must be 1 or 0, got yes" in machine.run(PGSD_CUDA="yes").stderr


def test_a_folder_of_something_else_is_left_alone(machine: Machine):
    machine.has_python("python3", "3.11")
    mine = machine.folder / "mine"
    mine.mkdir()
    (mine / "thesis").write_text("precious")
    done = machine.run(PGSD_VENV=str(mine))
    assert done.returncode == 1 and "is no Python environment" in done.stderr
    assert [path.name for path in mine.iterdir()] == ["thesis"]


@pytest.mark.parametrize("built_for", ["cpu", "cuda"])
def test_a_built_environment_is_used_as_it_is(machine: Machine, built_for: str):
    venv = machine.folder / "built"
    (venv / "bin").mkdir(parents=True)
    (venv / "bin" / "python").write_text('#!/bin/sh\ntest "$1" = -c || echo run with "$@"\n')
    (venv / "bin" / "python").chmod(0o755)
    files = " ".join(str(ROOT / name) for name in ("pyproject.toml", "constraints.txt", "scripts/environment"))
    checksum = subprocess.run(f"cat {files} | cksum", shell=True, capture_output=True, text=True).stdout.strip()
    (venv / ".built-from").write_text(f"{checksum} {ROOT} {built_for}")
    done = machine.run(PGSD_VENV=str(venv), PGSD_CUDA="0")
    assert (done.returncode, done.stdout) == (0, "run with -m pytest --version\n")
    if built_for == "cpu":
        assert machine.run(PGSD_VENV=str(venv), PGSD_CUDA="1").returncode == 1  # there is no python to build it with


def test_an_nvidia_driver_is_looked_for_by_its_device_and_its_program():
    from pgsd_nerfstudio.cli.findings import has_nvidia

    source = f'source <(sed -n "/^has_gpu/p" {ROOT}/scripts/environment); has_gpu'
    done = subprocess.run(["bash", "-c", source], env=os.environ)
    assert (done.returncode == 0) == has_nvidia()


@pytest.mark.parametrize(
    ("told", "given", "index"),
    [
        ("global.index-url='https://mirror.example/simple'", {}, "https://mirror.example/simple"),
        ("global.index-url='https://a.example'\n:env:.index-url='https://b.example'", {}, "https://b.example"),
        ("global.index-url='https://a.example'\ninstall.index-url='https://c.example'", {}, "https://c.example"),
        ("global.index-url='https://a.example'", {"UV_DEFAULT_INDEX": "https://d.example"}, "https://d.example"),
        ("global.timeout='60'", {}, ""),
        ("", {}, ""),
    ],
)
def test_a_mirror_that_pip_was_told_of_is_told_to_uv(tmp_path: Path, told: str, given: dict[str, str], index: str):
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text(f'#!/bin/sh\ntest "$*" = "-m pip config list" && cat <<END\n{told}\nEND\n')
    python.chmod(0o755)
    function = f'source <(sed -n "/^as_pip_is_told/,/^}}/p" {ROOT}/scripts/environment)'
    program = f'set -euo pipefail; VENV={tmp_path}; {function}; as_pip_is_told; echo "${{UV_DEFAULT_INDEX:-}} $UV_SYSTEM_CERTS"'
    environment = {"PATH": os.environ["PATH"], **given}
    done = subprocess.run(["bash", "-c", program], env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == (f"{index} true\n", "")
