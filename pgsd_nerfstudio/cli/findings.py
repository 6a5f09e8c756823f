"""What `pgsd doctor` examines, one function a subject.

A finding is `missing` where something that this machine needs does not work, `slow` where it works but costs time, memory or
room that could be had; a GPU is needed only where there is one.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from pgsd_nerfstudio.cli.cache import kept, size_of
from pgsd_nerfstudio.storage import cache_dir, header_of
from pgsd_nerfstudio.version import __version__

PATIENCE = 60.0
"""Seconds that a library may take to be loaded and tried."""
MEMORY, LITTLE_MEMORY = 2e9, 6e9
"""Bytes of free memory without which nothing runs, and with which large scenes do."""
DISK, LITTLE_DISK = 0.5e9, 5e9
"""Bytes of free disk without which no result can be stored, and with which many can."""
AGAIN = "run scripts/test in the clone, which repairs the environment; by hand: pip install -c constraints.txt -e ."
PACKAGES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
}
"""Debian's packages of the system libraries that Open3D and Taichi load."""


@dataclass(frozen=True)
class Finding:
    """One subject, its state, and what to do about it."""

    name: str
    state: Literal["ok", "missing", "slow"]
    found: str
    todo: str = ""


class Broken(Exception):
    """A library cannot be used; the message is the last that it said."""


def examine() -> list[Finding]:
    """All findings; takes seconds, most of which libraries need to be loaded, each in a process of its own."""
    gpu = has_nvidia()
    names = ["torch", "open3d", "taichi", "numba", *(["gsplat"] if gpu else [])]
    with ThreadPoolExecutor(max(2, (os.cpu_count() or 2) - 1)) as pool:
        tried = dict(zip(names, pool.map(_tried, names), strict=True))
    return [
        *_python(),
        *_torch(tried["torch"], gpu),
        *(_gsplat(tried["gsplat"]) if gpu else ()),
        *_library("open3d", tried["open3d"]),
        *_library("taichi", tried["taichi"]),
        *_numba(tried["numba"]),
        *_ffmpeg(),
        *_prior(),
        *_cache(),
        *_room(),
    ]


def has_nvidia() -> bool:
    """Whether this machine has an NVIDIA GPU: its device is there, or its driver's program."""
    return Path("/dev/nvidiactl").exists() or Path("/dev/dxg").exists() or shutil.which("nvidia-smi") is not None


def probe(name: str) -> dict[str, Any]:
    """What a probe of `probes.py` prints.

    Raises:
        Broken: the library cannot be used.
    """
    command = [sys.executable, "-m", "pgsd_nerfstudio.cli.probes", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        raise Broken(f"not ready after {PATIENCE:g} s") from None
    if done.returncode < 0:
        raise Broken(f"crashed with signal {-done.returncode}")
    try:
        if done.returncode == 0:
            return json.loads(done.stdout)
    except ValueError:
        pass
    said = done.stderr.strip().splitlines()
    raise Broken(said[-1] if said else f"ended with {done.returncode}")


def _tried(name: str) -> dict[str, Any] | Broken:
    try:
        return probe(name)
    except Broken as broken:
        return broken


def _python() -> Iterator[Finding]:
    tried = (3, 10) <= sys.version_info[:2] <= (3, 12)
    todo = "" if tried else "install Python 3.11 and build the environment with it: PYTHON=python3.11 scripts/test"
    found = f"{platform.python_version()}, {sys.executable}"
    yield Finding("python", "ok" if tried else "missing", found, todo)
    try:
        yield Finding("pgsd_nerfstudio", "ok", f"{__version__}, nerfstudio {version('nerfstudio')}")
    except PackageNotFoundError:
        yield Finding("pgsd_nerfstudio", "missing", f"{__version__}, without nerfstudio", AGAIN)


def _torch(tried: dict[str, Any] | Broken, gpu: bool) -> Iterator[Finding]:
    if isinstance(tried, Broken):
        yield Finding("torch", "missing", str(tried), AGAIN)
        return
    yield Finding("torch", "ok", f"{tried['version']}, {tried['threads']} threads of {os.cpu_count()} cores")
    for device in tried["devices"]:
        found = f"{device['name']}, {size_of(device['free'])} of {size_of(device['total'])} free, driver {_driver()}"
        little = device["free"] < 4e9
        yield Finding("CUDA", "slow" if little else "ok", found, "end what else uses the GPU" if little else "")
    if tried["devices"]:
        return
    if gpu:
        found = f"torch {tried['version']} cannot use the GPU of this machine, driver {_driver()}"
        todo = f"install a driver for CUDA {tried['cuda']} or newer, or a torch for this driver; look at nvidia-smi"
        yield Finding("CUDA", "missing", found, todo)
        return
    yield Finding("CUDA", "slow", "no NVIDIA GPU: everything runs on the CPU, with small defaults")
    spinning = _variable_at_start("OMP_WAIT_POLICY") != "passive"
    yield Finding(
        "threads",
        "slow" if spinning else "ok",
        "those of torch wait by spinning in ns-* commands" if spinning else "those of torch wait without spinning",
        "export OMP_WAIT_POLICY=passive before ns-train and the other ns-* commands" if spinning else "",
    )


def _driver() -> str:
    """Version of NVIDIA's driver."""
    try:
        first = Path("/proc/driver/nvidia/version").read_text("utf-8", "replace").splitlines()[0]
        return next((word for word in first.split() if word[:1].isdigit() and "." in word), "unknown")
    except (OSError, IndexError):
        return "unknown"


def _variable_at_start(name: str) -> str | None:
    """An environment variable as the shell gave it: this package sets some itself when it is imported."""
    try:
        given = Path("/proc/self/environ").read_bytes().split(b"\0")
    except OSError:
        return os.environ.get(name)
    return next((each.decode().partition("=")[2] for each in given if each.startswith(f"{name}=".encode())), None)


def _gsplat(tried: dict[str, Any] | Broken) -> Iterator[Finding]:
    if isinstance(tried, Broken):
        yield Finding("gsplat", "missing", str(tried), AGAIN)
        return
    if tried["compiled"]:
        yield Finding("gsplat", "ok", f"{tried['version']}, kernels are compiled")
    elif tried["lacks"]:
        found = f"{tried['version']}, kernels are not compiled and cannot be: without {', '.join(tried['lacks'])}"
        todo = "install the CUDA toolkit (nvcc) of torch's version, g++ and Python's headers (Debian: g++ python3-dev)"
        yield Finding("gsplat", "missing", found, todo)
    else:
        found = f"{tried['version']}, kernels will be compiled by the first command that renders, once: some minutes"
        yield Finding("gsplat", "slow", found)
    if not tried["triton"]:
        found = "what only a GPU uses was left out when the environment was made"
        yield Finding("CUDA libraries", "missing", found, "PGSD_CUDA=1 scripts/test installs it")


def _library(name: str, tried: dict[str, Any] | Broken) -> Iterator[Finding]:
    if not isinstance(tried, Broken):
        yield Finding(name, "ok", tried["version"])
        return
    lacks = next((package for library, package in PACKAGES.items() if library in str(tried)), None)
    todo = f"on Debian and Ubuntu: apt-get install {lacks}; scripts/test installs all that is missing" if lacks else AGAIN
    yield Finding(name, "missing", str(tried), todo)


def _numba(tried: dict[str, Any] | Broken) -> Iterator[Finding]:
    if isinstance(tried, Broken):
        yield Finding("numba", "missing", str(tried), AGAIN)
    elif tried["folder"] is None:
        found = f"{tried['version']}, compiled kernels cannot be kept: no folder can be written"
        yield Finding("numba", "slow", found, "name a folder for them: export NUMBA_CACHE_DIR=~/.cache/numba")
    elif not tried["kernels"]:
        found = f"{tried['version']}, kernels are compiled with the first picture, once: about a minute"
        yield Finding("numba", "slow", found)
    else:
        yield Finding("numba", "ok", f"{tried['version']}, {tried['kernels']} compiled kernels in {tried['folder']}")


def _ffmpeg() -> Iterator[Finding]:
    try:
        import imageio_ffmpeg

        program = imageio_ffmpeg.get_ffmpeg_exe()
        said = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, text=True, timeout=PATIENCE).stdout
        number = imageio_ffmpeg.get_ffmpeg_version()
    except (ImportError, OSError, RuntimeError, subprocess.SubprocessError) as error:
        yield Finding("ffmpeg", "missing", " ".join(str(error).split()) or type(error).__name__, AGAIN)
        return
    if "libx264" not in said:
        todo = "unset IMAGEIO_FFMPEG_EXE, so that the one of the package imageio-ffmpeg is used"
        yield Finding("ffmpeg", "missing", f"{number} without libx264, {program}", todo)
        return
    own = shutil.which("ffmpeg")
    yield Finding("ffmpeg", "ok", f"{number}; ns-render uses {own or 'the same'}")


def _prior() -> Iterator[Finding]:
    folder = Path(__file__).resolve().parent.parent / "guidance" / "bundled"
    weights = [*folder.rglob("*.safetensors")]
    broken = [path for path in weights if not whole(path)]
    if len(weights) < 3 or broken:
        found = f"{broken[0].relative_to(folder)} is not whole" if broken else f"{len(weights)} of 3 files of weights"
        yield Finding(
            "bundled prior", "missing", found, "clone the repository again, or git checkout -- pgsd_nerfstudio/guidance"
        )
        return
    yield Finding("bundled prior", "ok", f"{len(weights)} parts, {size_of(sum(path.stat().st_size for path in weights))}")


def whole(path: Path) -> bool:
    """Whether a safetensors file has the length that its own header tells."""
    try:
        header, start = header_of(path)
        ends = [entry["data_offsets"][1] for name, entry in header.items() if name != "__metadata__"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
    return bool(ends) and path.stat().st_size == start + max(ends)


def _cache() -> Iterator[Finding]:
    folder = cache_dir()
    above = _existing(folder)
    if not (above.is_dir() and os.access(above, os.W_OK)):
        yield Finding("cache", "missing", f"{folder} cannot be written", "set PGSD_CACHE to a folder that you may write")
        return
    files = [*kept(folder)]
    size = sum(each.size for each in files)
    large = size > 20e9
    todo = "pgsd cache list shows it, pgsd cache clear --older-than 30 removes what is old" if large else ""
    yield Finding("cache", "slow" if large else "ok", f"{size_of(size)} in {len(files)} files, {folder}", todo)


def _existing(folder: Path) -> Path:
    """The folder, or the first one above it that is there."""
    return next(each for each in (folder, *folder.absolute().parents) if each.exists())


def _room() -> Iterator[Finding]:
    """Free memory and disk."""
    import psutil

    try:
        memory = psutil.virtual_memory()
    except OSError as error:  # a container without /proc
        yield Finding("memory", "slow", f"cannot be told: {error}", "mount /proc")
    else:
        state = "missing" if memory.available < MEMORY else "slow" if memory.available < LITTLE_MEMORY else "ok"
        todo = "" if state == "ok" else "end other programs, or take smaller scenes and fewer particles (--max-particles)"
        yield Finding("memory", state, f"{size_of(memory.available)} of {size_of(memory.total)} free", todo)
    for name, folder, way in (
        ("disk of the cache", cache_dir(), "free some, pgsd cache clear, or set PGSD_CACHE to another disk"),
        ("disk here", Path.cwd(), "free some, or write to another disk (--output, --output-dir)"),
    ):
        free = shutil.disk_usage(_existing(folder)).free
        state = "missing" if free < DISK else "slow" if free < LITTLE_DISK else "ok"
        yield Finding(name, state, f"{size_of(free)} free, {folder}", "" if state == "ok" else way)
