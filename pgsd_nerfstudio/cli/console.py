"""What a command says on stderr while it works; stdout holds only the paths of what was made."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def console() -> Console:
    """Where progress goes."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def say(line: str) -> None:
    """Print one line of progress."""
    console().print(line, style="dim", markup=False)
