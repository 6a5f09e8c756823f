"""Figures: what `pgsd bench` measures and `pgsd verify` compares, as a table for people and JSON for the docs.

A room offers `rows/<room>.py` with `bench(quick) -> list[Record]`, `verify(quick) -> list[Record]`, or both.
"""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pgsd_nerfstudio.storage import atomic_write

_TARGET = re.compile(r"(<=|>=|<|>|==)\s*([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)", re.IGNORECASE)
_COMPARE = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt, "==": operator.eq}
_RUN = " | run: "  # separates a row's own source from the run that printed it


def meets(value: float, target: str) -> bool:
    """Whether a value satisfies a target such as "<= 0.5".

    Raises:
        ValueError: the target is not a comparison with one number.
    """
    found = _TARGET.fullmatch(target.strip())
    if found is None:
        raise ValueError(f'a target reads like "<= 0.5" (one of <= >= < > == and a number), found "{target}"')
    return bool(_COMPARE[found[1]](value, float(found[2])))


@dataclass(frozen=True)
class Record:
    """One row: a figure beside its error, and whether it holds what was promised."""

    name: str
    value: float | None
    """None where it could not be measured; `source` then says why."""
    unit: str
    error: float | None = None
    """Error that was paid for the value: speed is never reported alone."""
    error_unit: str | None = None
    target: str | None = None
    """What the value must satisfy, like "<= 0.5"."""
    holds: bool | None = None
    """None where nothing was promised, or where it cannot be measured on this machine (the reason is in `source`)."""
    source: str = ""
    """Where the target or the truth comes from."""

    def __post_init__(self) -> None:
        for name in ("value", "error"):
            number = getattr(self, name)
            if number is None:
                continue
            number = float(number)  # also takes numpy scalars and one-element tensors
            if not math.isfinite(number):
                raise ValueError(f'row "{self.name}": {name} is {number}, a figure must be finite')
            object.__setattr__(self, name, number)
        if self.holds is not None:
            object.__setattr__(self, "holds", bool(self.holds))
        if self.target is not None:
            meets(0.0, self.target)
        if self.holds is None and (self.value is None or self.target is not None) and not self.source:
            raise ValueError(f'row "{self.name}" was not measured or not judged; its source must say why')

    @classmethod
    def judged(cls, name: str, value: float, unit: str, target: str, **rest: Any) -> Record:
        """A row whose `holds` follows from its value and target."""
        return cls(name, value, unit, target=target, holds=meets(float(value), target), **rest)


def stamped(rows: Iterable[Record], run: str) -> list[Record]:
    """The rows with the run that printed them (command and machine) at the end of their source."""
    return [replace(row, source=f"{row.source}{_RUN}{run}") for row in rows]


def split_source(source: str) -> tuple[str, str]:
    """A stamped source as (the row's own source, the run); the run is empty where the row was not stamped."""
    own, _, run = source.partition(_RUN)
    return own, run


def write_records(path: Path, rows: Sequence[Record]) -> None:
    """Write the rows as a JSON list, beside first and then renamed.

    Raises:
        OSError: the file could not be written; nothing is left behind.
    """
    with atomic_write(path) as beside:
        beside.write_text(json.dumps([asdict(row) for row in rows], indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_records(path: Path) -> list[Record]:
    """Rows of a file of `write_records`.

    Raises:
        ValueError: the file is not a list of records.
    """
    names = [f.name for f in fields(Record)]
    try:
        rows = json.loads(path.read_text())
        if any(sorted(row) != sorted(names) for row in rows):
            raise ValueError(f"a record has exactly the keys {', '.join(names)}")
        return [Record(**row) for row in rows]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} does not hold records of pgsd bench or pgsd verify: {error}") from error


def figure(number: float | None, unit: str | None) -> str:
    """A number with its unit in four significant digits, or a dash."""
    if number is None:
        return "-"
    plain = f"{number:,.0f}" if number == int(number) and abs(number) < 1e9 else f"{number:.4g}"
    return f"{plain} {unit}" if unit else plain


def verdict(row: Record) -> str:
    """One word: "holds", "fails", or "-" where nothing was judged."""
    return {True: "holds", False: "fails", None: "-"}[row.holds]


def print_records(title: str, rows: Sequence[Record], console: Console) -> None:
    """A table with one line per row, and the sources of those that do not hold or were not measured."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for column, justify in (("figure", "left"), ("value", "right"), ("error", "right"), ("target", "right"), ("", "left")):
        table.add_column(column, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for row in rows:
        colour = {True: "green", False: "red", None: "dim"}[row.holds]
        error = figure(row.error, row.error_unit)
        table.add_row(row.name, figure(row.value, row.unit), error, row.target or "-", f"[{colour}]{verdict(row)}[/{colour}]")
    console.print(table)
    for row in rows:
        if row.holds is False or (row.holds is None and (row.value is None or row.target)):
            console.print(f"  {row.name}: {split_source(row.source)[0]}", style="dim", markup=False)
