"""Mutations of valid files, and what became of each: taken, or refused in one sentence, within bounds of time and memory.

Mutations are drawn by hypothesis without its database and from a fixed seed, so that a run can be repeated; what fails is made
as small as possible and printed.
"""

from __future__ import annotations

import gc
import json
import re
import resource
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

SECONDS = 10.0
"""Longest that one small file may take, on a machine that does other things too."""
MEGABYTES = 600.0
"""By so much the memory of the process may grow over all mutations of a kind."""

NUMBERS = [
    "-1",
    "0",
    "1",
    "3",
    "255",
    "65536",
    "2147483648",
    "-9223372036854775808",
    "1e30",
    "-1e309",
    "1e-320",
    "nan",
    "inf",
    "0x7f",
]
VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 2, 0.5, -0.5, 1e-300, 1e9, 1e30, 1e300, float("nan"), float("inf"), 10**40, "", "x", "1",
    "-0.5", "../../x", "\u0000", [], {}, [[]], [1, 2, 3], [[1, 0, 0, 0]] * 4, {"a": {}}, [None] * 3, "9" * 400,
]  # fmt: skip
"""What stands in the place of a number, a text, a list or an object."""


@dataclass
class Tally:
    """What became of the mutations of one kind of file."""

    taken: int = 0
    refused: int = 0
    longest: float = 0.0
    before: float = field(default_factory=lambda: _peak())
    sentences: set[str] = field(default_factory=set)

    def __str__(self) -> str:
        return (
            f"{self.taken + self.refused:,} tried: {self.taken:,} taken, {self.refused:,} refused in {len(self.sentences):,} "
            f"different sentences, 0 anything else; longest {self.longest:.2f} s, memory grew by {_peak() - self.before:.0f} MB"
        )


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def changed_bytes(whole: bytes) -> st.SearchStrategy[bytes]:
    """One to five changes anywhere in a file: bits, whole bytes, pieces cut, doubled or moved, the end cut off."""
    place = st.integers(0, max(len(whole) - 1, 0))
    step = st.tuples(st.integers(0, 6), place, st.integers(1, 64), st.integers(0, 255))
    return st.lists(step, min_size=1, max_size=5).map(lambda steps: _changed(whole, steps))


def _changed(whole: bytes, steps: list[tuple[int, int, int, int]]) -> bytes:
    data = bytearray(whole)
    for kind, at, length, value in steps:
        if not data:
            break
        at = min(at, len(data) - 1)
        if kind == 0:
            data[at] ^= 1 << value % 8
        elif kind == 1:
            data[at : at + length % 9] = bytes([value]) * (length % 9)
        elif kind == 2:
            data[at : at + 4] = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\0\x80")[value % 5]
        elif kind == 3:
            del data[at : at + length]
        elif kind == 4:
            data[at:at] = data[at : at + length]
        elif kind == 5:
            data[at:at] = bytes([value]) * length
        else:
            del data[at:]
    return bytes(data)


def changed_text(text: str) -> st.SearchStrategy[str]:
    """One to three changes in the lines and numbers of a text."""
    lines = text.split("\n")
    step = st.tuples(st.integers(0, 4), st.integers(0, len(lines) - 1), st.sampled_from(NUMBERS))
    return st.lists(step, min_size=1, max_size=3).map(lambda steps: _rewritten(lines, steps))


def _rewritten(lines: list[str], steps: list[tuple[int, int, str]]) -> str:
    lines = list(lines)
    for kind, at, number in steps:
        at = min(at, len(lines) - 1)
        if kind <= 1:
            lines[at] = re.sub(r"-?\d+(\.\d+)?", number, lines[at], count=1)
        elif kind == 2:
            lines.insert(at, lines[at])
        elif kind == 3 and len(lines) > 1:
            del lines[at]
        else:
            lines[at] = f"{lines[at]} {number}"
    return "\n".join(lines)


def changed_json(document: Any) -> st.SearchStrategy[str]:
    """One to three values of a document replaced or taken out, whatever their type; or its text changed."""
    places = list(_places(document))
    step = st.tuples(st.sampled_from(places), st.sampled_from([*VALUES, _GONE]))
    replaced = st.lists(step, min_size=1, max_size=3).map(lambda steps: json.dumps(_replaced(document, steps)))
    text = json.dumps(document)
    broken = changed_bytes(text.encode()).map(lambda data: data.decode("utf-8", "replace"))
    deep = st.integers(1, 100_000).map(lambda depth: "[" * depth + "]" * depth)
    return st.one_of(replaced, replaced, replaced, broken, deep)


_GONE = object()


def _places(document: Any, place: tuple[Any, ...] = ()) -> Any:
    yield place
    inside = document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    for key, value in inside:
        yield from _places(value, (*place, key))


def _replaced(document: Any, steps: list[tuple[tuple[Any, ...], Any]]) -> Any:
    document = deepcopy(document)
    for place, value in steps:
        if not place:
            document = None if value is _GONE else deepcopy(value)
            continue
        owner = document
        try:
            for key in place[:-1]:
                owner = owner[key]
            if value is _GONE:
                del owner[place[-1]]
            else:
                owner[place[-1]] = deepcopy(value)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier step took away what this one would change
    return document


def survive(mutations: st.SearchStrategy[Any], use: Callable[[Any], None], error: type[Exception], examples: int) -> Tally:
    """Use each mutation; anything but an `error` whose message is one sentence fails, as does too much time or memory.

    Args:
        mutations: what is used.
        use: uses one of them and checks what it was given; its own assertions fail.
        error: what a refusal is.
        examples: how many mutations.
    """
    tally = Tally()

    @seed(20261129)
    @settings(
        max_examples=examples,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(mutations)
    def each(mutation: Any) -> None:
        began = time.perf_counter()
        try:
            use(mutation)
        except error as refusal:
            sentence = str(refusal)
            assert sentence.strip() and "\n" not in sentence and len(sentence) < 2000, sentence
            tally.refused += 1
            tally.sentences.add(re.sub(r"[\d.]+", "#", sentence))
        else:
            tally.taken += 1
        took = time.perf_counter() - began
        tally.longest = max(tally.longest, took)
        assert took < SECONDS, f"{took:.1f} s"

    each()
    gc.collect()
    assert _peak() - tally.before < MEGABYTES, str(tally)
    return tally
