"""`pgsd`: everything around training that nerfstudio's own commands do not offer.

Exit codes: 0 done, 1 could not (one sentence on stderr), 2 wrong usage, or a figure that fails under --strict, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from pgsd_nerfstudio.cli.bench import Bench
from pgsd_nerfstudio.cli.cache import Cache
from pgsd_nerfstudio.cli.doctor import Doctor
from pgsd_nerfstudio.cli.path import PathCommand
from pgsd_nerfstudio.cli.preview import Preview
from pgsd_nerfstudio.cli.render import Render
from pgsd_nerfstudio.cli.simulate import Simulate
from pgsd_nerfstudio.cli.verify import Verify
from pgsd_nerfstudio.refusal import INTERRUPTED, Refusal
from pgsd_nerfstudio.version import __version__

Command = (
    Annotated[Preview, tyro.conf.subcommand("preview")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[PathCommand, tyro.conf.subcommand("path")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Cache, tyro.conf.subcommand("cache")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
)


def run(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments (of the process, if not given) and run the command; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if [*arguments] == ["--version"]:
        print(f"pgsd_nerfstudio {__version__}")
        return 0
    try:
        command = tyro.cli(
            Command,  # type: ignore[arg-type]
            args=arguments,
            prog="pgsd",
            description="Weather for 3D Gaussian scenes. Training, viewing and rendering are nerfstudio's: ns-train "
            "pgsd-weather. pgsd --version says which version this is.",
        )
        return command.run()
    except Refusal as refusal:
        print(f"pgsd: {refusal}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pgsd: interrupted; what was finished is cached, the same command goes on from there", file=sys.stderr)
        return INTERRUPTED


def main() -> None:
    """Entry point of the `pgsd` command."""
    try:
        code = run()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has seen enough, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
        code = 1
    sys.exit(code)


if __name__ == "__main__":
    main()
