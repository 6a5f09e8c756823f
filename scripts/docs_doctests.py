"""Tells griffe, which reads the docstrings, that examples behind >>> are code, wherever they stand. See mkdocs.yml."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

DOCTEST = re.compile(r"(?:^>>> .*\n?(?:^(?!>>> )[^\n]+\n?)*)+", re.MULTILINE)
"""Lines that begin with >>>, each with what follows up to an empty line."""


class Doctests(Extension):
    """Puts examples into fences."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Called by griffe for each object of the package."""
        if obj.docstring is not None:
            obj.docstring.value = DOCTEST.sub(_fenced, obj.docstring.value)


def _fenced(example: re.Match[str]) -> str:
    lines = re.sub(r" *# doctest:.*", "", example[0]).rstrip("\n")
    return f"```pycon\n{lines}\n```\n"
