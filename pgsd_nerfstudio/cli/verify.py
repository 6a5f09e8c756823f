"""`pgsd verify`: correctness against analytic solutions, references and published measurements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Verify:
    """Compare with analytic solutions, independent references and published measurements."""

    room: Annotated[str | None, tyro.conf.Positional] = None
    """Which room to verify, for example physics; all of them if not given."""
    quick: bool = False
    """Small sizes that finish within 50 s on 2 cores."""
    json: Path | None = None
    """Also write the rows to this file, from which the tables in docs/ are made."""
    strict: bool = False
    """Exit with 2 if a row does not hold its target."""

    def run(self) -> int:
        from pgsd_nerfstudio.laboratory.rooms import run_rooms

        return run_rooms("verify", self.room, quick=self.quick, json=self.json, strict=self.strict)
