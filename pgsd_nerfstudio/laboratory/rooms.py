"""Runs the rooms' rows for `pgsd bench` and `pgsd verify`."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import sys
import time
import traceback
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from rich.console import Console

from pgsd_nerfstudio.laboratory.records import Record, print_records, stamped, write_records
from pgsd_nerfstudio.refusal import Refusal

Kind = Literal["bench", "verify"]
ROOMS = ("rendering", "surface", "weather", "physics", "dynamics", "guidance", "plugin")

ALSO = {"rasterizer": "rendering"}
"""Other names that people look for."""


def module_of(room: str) -> str:
    """Name of the module that holds a room's rows."""
    return f"pgsd_nerfstudio.laboratory.rows.{room}"


def rooms_with_rows() -> list[str]:
    """Rooms that offer rows, in the order in which data walks through the house."""
    return [room for room in ROOMS if find_spec(module_of(room)) is not None]


def machine() -> str:
    """The machine and the versions that a figure depends on, in one line; nothing that identifies the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("torch", "numba", "gsplat")]
    gpu = ""
    if "torch" in sys.modules and sys.modules["torch"].cuda.is_available():
        gpu = sys.modules["torch"].cuda.get_device_name() + ", "
    return f"{platform.machine()}, {cores} cores, {gpu}Python {platform.python_version()}, {', '.join(versions)}"


def command_line(kind: Kind, room: str | None, quick: bool) -> str:
    """The command that prints these rows again."""
    return " ".join(["pgsd", kind, *([room] if room else []), *(["--quick"] if quick else [])])


def run_rooms(kind: Kind, room: str | None, *, quick: bool, json: Path | None, strict: bool) -> int:
    """Run one room's rows or all, print the tables and write the JSON.

    Returns the exit code: 0, 1 where a room crashed, 2 where a row fails and `strict` is set.

    A room that crashes becomes a row that does not hold, its traceback goes to stderr, and the code is 1.

    Raises:
        Refusal: there is no such room, or the JSON file cannot be written.
    """
    known = rooms_with_rows()
    command = command_line(kind, room, quick)
    room = ALSO.get(room, room) if room else None
    if room is not None and room not in known:
        raise Refusal(f'"{room}" offers no figures; expected one of: {", ".join(known) or "none yet"}')
    console, errors = Console(), Console(stderr=True)
    console.print(command, style="bold", highlight=False)
    rows: list[Record] = []
    crashed = False
    for name in [room] if room else known:
        start = time.perf_counter()
        try:
            offered = getattr(importlib.import_module(module_of(name)), kind, None)
            if offered is None:
                if room is not None:
                    raise Refusal(f'"{room}" has nothing to {kind}; try pgsd {"verify" if kind == "bench" else "bench"} {room}')
                continue
            with errors.status(f"{kind} {name}"):
                found = list(offered(quick))
        except Refusal:
            raise
        except Exception as error:
            crashed = True
            errors.print(traceback.format_exc(), style="red", markup=False, highlight=False)
            found = [Record(f"{name}: could not run", None, "", holds=False, source=f"{type(error).__name__}: {error}")]
        print_records(f"{name} ({time.perf_counter() - start:.0f} s)", found, console)
        rows += found
    if not rows:
        raise Refusal(f"no room offers anything to {kind} yet")
    run = f"{command} on {machine()}"
    console.print(run, style="dim", highlight=False)
    if json is not None:
        try:
            write_records(json, stamped(rows, run))
        except OSError as error:
            raise Refusal(f"could not write {json}: {error}; choose another --json path") from error
        console.print(f"written: {json}", highlight=False)
    if crashed:
        return 1
    return 2 if strict and any(row.holds is False for row in rows) else 0
