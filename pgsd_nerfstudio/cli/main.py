"""`pgsd`: everything around training that nerfstudio's own commands do not offer.

Exit codes: 0 done, 1 could not (one sentence on stderr), 2 wrong usage, or a figure that fails under --strict.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from pgsd_nerfstudio.cli.bench import Bench
from pgsd_nerfstudio.cli.preview import Preview
from pgsd_nerfstudio.cli.simulate import Simulate
from pgsd_nerfstudio.cli.verify import Verify
from pgsd_nerfstudio.refusal import Refusal

Command = (
    Annotated[Preview, tyro.conf.subcommand("preview")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
)


def run(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments (of the process, if not given) and run the command; returns the exit code."""
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        args=arguments,
        prog="pgsd",
        description="Weather for 3D Gaussian scenes. Training, viewing and rendering are nerfstudio's: ns-train pgsd-weather.",
    )
    try:
        return command.run()
    except Refusal as refusal:
        print(f"pgsd: {refusal}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pgsd: interrupted; what was finished is cached, the same command goes on from there", file=sys.stderr)
        return 130


def main() -> None:
    """Entry point of the `pgsd` command."""
    sys.exit(run())


if __name__ == "__main__":
    main()
