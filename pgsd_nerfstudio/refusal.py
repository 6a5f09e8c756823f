"""How a command ends that cannot do what was asked: one sentence on stderr, exit code 1; or that Ctrl-C ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

INTERRUPTED = 130
"""The exit code of a process that Ctrl-C ended: 128 and the number of the signal, as shells have it."""


class Refusal(Exception):
    """The input cannot be used; the message says what was expected, what was found and what to do."""


@contextmanager
def refusing(*errors: type[Exception]) -> Iterator[None]:
    """Turn the errors that mean bad input here into a Refusal; anything else stays a crash with its traceback."""
    try:
        yield
    except errors as error:
        sentence = " ".join(str(error).split())
        raise Refusal(sentence or f"{type(error).__name__} without a message") from error
