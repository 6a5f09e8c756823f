"""The file of the video that a command writes: refused before anything costly is done, or while it is written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pgsd_nerfstudio.refusal import Refusal


def check_name(output: Path) -> None:
    """Refuse names of other files than videos.

    Raises:
        Refusal: the name does not end in .mp4.
    """
    if output.suffix.lower() != ".mp4":
        raise Refusal(f"--output must end in .mp4, got {output}")


def make_folder(output: Path) -> None:
    """Make the folder of the output where it is missing.

    Raises:
        Refusal: it cannot be made.
    """
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refusal(f"{output} cannot be written ({error.strerror}); choose another --output") from error


@contextmanager
def writing(output: Path) -> Iterator[None]:
    """Within this the output is written.

    Raises:
        Refusal: the disk is full, or the file may not be written.
    """
    try:
        yield
    except OSError as error:
        raise Refusal(f"{output} could not be written ({error}): free some space or choose another --output") from error
