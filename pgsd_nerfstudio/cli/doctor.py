"""`pgsd doctor`: whether everything that this machine needs works, and what to do where it does not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pgsd_nerfstudio.cli.findings import Finding


@dataclass(frozen=True)
class Doctor:
    """Examine this machine and its installation: what works, what is missing, what is slow, and what to do about it.

    Exit code 0 if everything needed here works, 1 if something is missing."""

    json: bool = False
    """Print JSON: a list of name, state (ok, missing or slow), found, todo."""

    def run(self) -> int:
        from pgsd_nerfstudio.cli.findings import examine

        found = examine()
        if self.json:
            print(json.dumps([asdict(each) for each in found], indent=1))
        else:
            show(found)
        return int(any(each.state == "missing" for each in found))


def show(found: Sequence[Finding]) -> None:
    """Print findings as a table, and under it what to do."""
    from rich.console import Console
    from rich.table import Table

    colours = {"ok": "green", "missing": "bold red", "slow": "yellow"}
    table = Table("", "state", "found", box=None, pad_edge=False)
    for each in found:
        table.add_row(each.name, f"[{colours[each.state]}]{each.state}[/]", each.found)
    console = Console(highlight=False)
    console.print(table)
    for each in found:
        if each.todo:
            console.print(f"\n[{colours[each.state]}]{each.name}[/]: ", end="")
            console.print(each.todo, markup=False, soft_wrap=True)
    if not any(each.state == "missing" for each in found):
        console.print("\nEverything that this machine needs works.")
