"""The container of a .ply: its header, and the rows of an element as a structured array.

G. Turk, "The PLY Polygon File Format" (1994). Nothing is allocated before the file's size has confirmed what its header says.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgsd_nerfstudio.scene.errors import SceneError

LONGEST_HEADER = 1 << 16  # bytes; that of a splat has 2,000
FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{
        "int8": "i1",
        "uint8": "u1",
        "int16": "i2",
        "uint16": "u2",
        "int32": "i4",
        "uint32": "u4",
        "float32": "f4",
        "float64": "f8",
    },
}


@dataclass(frozen=True)
class Element:
    """One table of the file: its name, rows and columns."""

    name: str
    count: int
    columns: dict[str, str]
    """Type of each column as numpy writes it, without byte order."""
    lists: tuple[str, ...]
    """Columns that are lists of any length, as the corners of faces."""


@dataclass(frozen=True)
class PlyFile:
    """A .ply whose header was read."""

    path: Path
    order: str
    """Byte order, "<" or ">"; empty for text."""
    comments: tuple[str, ...]
    elements: tuple[Element, ...]
    start: int
    """Bytes of the header."""

    def element(self, name: str) -> Element | None:
        return next((element for element in self.elements if element.name == name), None)

    def table(self, name: str) -> np.ndarray:
        """All rows of the element of that name, which must exist, with one field for each column.

        Raises:
            SceneError: it or an element before it holds lists, the file is shorter or longer than its header says, or its text
                is not of numbers.
        """
        before = next(i for i, element in enumerate(self.elements) if element.name == name)
        wanted = self.elements[: before + 1]
        if listed := next((element for element in wanted if element.lists), None):
            raise unreadable(self.path, f"{listed.name} holds the list {listed.lists[0]}, as meshes do")
        types = [self._type(element) for element in self.elements]
        length = self.path.stat().st_size - self.start
        if self.order == "":
            return self._text(wanted, types[before], length)
        needed = sum(element.count * kind.itemsize for element, kind in zip(wanted, types, strict=False))
        described = sum(element.count * kind.itemsize for element, kind in zip(self.elements, types, strict=True))
        if needed > length or (described < length and not any(element.lists for element in self.elements)):
            raise unreadable(self.path, f"its header describes {described:,} bytes of data, it holds {length:,}")
        if wanted[-1].count == 0:
            return np.empty(0, types[before])
        offset = self.start + needed - wanted[-1].count * types[before].itemsize
        return np.memmap(self.path, types[before], "r", offset, shape=(wanted[-1].count,))

    def _type(self, element: Element) -> np.dtype:
        return np.dtype([(name, self.order + kind) for name, kind in element.columns.items()])

    def _text(self, elements: tuple[Element, ...], kind: np.dtype, length: int) -> np.ndarray:
        numbers = sum(element.count * len(element.columns) for element in elements)
        described = sum(element.count * len(element.columns) for element in self.elements)
        if 2 * numbers > length + 1:  # each number has a digit and a gap
            raise unreadable(self.path, f"its header describes {numbers:,} numbers, it holds {length:,} characters")
        with self.path.open("rb") as file, warnings.catch_warnings():
            file.seek(self.start)
            warnings.simplefilter("error", DeprecationWarning)  # numpy warns where the text is not of numbers
            try:
                values = np.fromstring(file.read().decode("ascii"), np.float64, sep=" ")
            except (DeprecationWarning, ValueError) as error:
                raise unreadable(self.path, "its text holds something else than numbers") from error
        if len(values) < numbers or (len(values) > described and not any(element.lists for element in self.elements)):
            raise unreadable(self.path, f"its header describes {numbers:,} numbers, it holds {len(values):,}")
        rows, columns = elements[-1].count, list(elements[-1].columns)
        values = values[numbers - rows * len(columns) : numbers].reshape(rows, len(columns))
        table = np.empty(rows, kind)
        for i, name in enumerate(columns):
            table[name] = values[:, i]
        return table


def open_ply(path: Path) -> PlyFile:
    """Read the header of a .ply.

    Raises:
        SceneError: there is no readable header.
    """
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEADER)
    except OSError as error:
        raise SceneError(f"{path} cannot be opened ({error.strerror})") from error
    end = head.find(b"\nend_header")
    if not head.startswith(b"ply") or end < 0:
        raise unreadable(path, "a header from ply to end_header is missing")
    start = head.find(b"\n", end + 1) + 1
    if start == 0 or head[end + 11 : start].strip():
        raise unreadable(path, "its header does not end in a line of its own")
    try:
        lines = [line.split() for line in head[:end].decode("utf-8").splitlines()[1:]]
        order, comments, elements = _parsed(lines)
    except (ValueError, KeyError, IndexError) as error:  # UnicodeDecodeError is a ValueError
        raise unreadable(path, f"its header is not understood: {error}") from error
    return PlyFile(path, order, comments, elements, start)


def unreadable(path: Path, why: str) -> SceneError:
    """The error that says why a .ply is not read."""
    return SceneError(f"{path} cannot be read as a .ply of a splat ({why}): write or download it again")


def _parsed(lines: list[list[str]]) -> tuple[str, tuple[str, ...], tuple[Element, ...]]:
    """Byte order, comments and elements of the header's lines; ValueError, KeyError or IndexError where one is wrong."""
    order, comments, elements = None, [], []
    for words in filter(None, lines):
        match words:
            case ["comment" | "obj_info", *said]:
                comments.append(" ".join(said))
            case ["format", name, "1.0"]:
                order = FORMATS[name]
            case ["element", name, count]:
                if not (count.isascii() and count.isdigit() and len(count) < 19):
                    raise ValueError(f"{name} has the count {count[:40]}")
                elements.append(Element(name, int(count), {}, ()))
            case ["property", "list", _, _, name]:
                elements[-1] = Element(elements[-1].name, elements[-1].count, elements[-1].columns, (*elements[-1].lists, name))
            case ["property", kind, name] if name not in elements[-1].columns:
                elements[-1].columns[name] = TYPES[kind]
            case _:
                raise ValueError(" ".join(words)[:80])
    if order is None:
        raise ValueError("the line of its format is missing")
    if len({element.name for element in elements}) < len(elements):
        raise ValueError("two elements have one name")
    return order, tuple(comments), tuple(elements)
