"""Draws docs/images/architecture.svg: the rooms of the house, what each does, and which room imports which, read in the code.

python scripts/draw_architecture.py
"""

from __future__ import annotations

import ast
import json
import re
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pgsd_nerfstudio"
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
HOUSE = (
    "scene",
    "rendering",
    "surface",
    "effects",
    "physics",
    "response",
    "dynamics",
    "guidance",
    "weather",
    "plugin",
    "laboratory",
    "cli",
)
"""The rooms in the order in which data walks through them."""

BOX, HIGH, GAP, MARGIN, HEAD = 490, 60, 12, 24, 84  # pixels: width and height of a room, between rooms, around, title
RAIL = 30  # pixels between the lines that lead to rooms
COLOURS = ("#3b6ea5", "#b4552d", "#4b8b3b", "#8a5aa8", "#b08a1e", "#2f8f8f", "#a8476b", "#5d6b7a", "#6b7f1e", "#7a4a2a")
AGAINST = "#cc2222"  # a room that imports one after it


@dataclass(frozen=True)
class Room:
    """One room of the house."""

    name: str
    does: str
    """First paragraph of its package docstring."""
    lines: int
    """Lines of its Python files that are not blank."""
    uses: tuple[str, ...]
    """Rooms that it imports when it runs, in the order of the house."""


def rooms(package: Path = PACKAGE) -> list[Room]:
    """The rooms of a package in the order of the house.

    Args:
        package: folder of the package.

    Raises:
        ValueError: a folder is no room of the house, a room is missing, or a room does not say what it does.
    """
    found = sorted(path.parent.name for path in package.glob("*/__init__.py"))
    if found != sorted(HOUSE):
        raise ValueError(f"the house has the rooms {', '.join(sorted(HOUSE))}, found {', '.join(found)}: correct HOUSE")
    return [_room(package / name) for name in HOUSE]


def below(package: Path = PACKAGE) -> list[str]:
    """Modules that belong to no room and may be used by all.

    Args:
        package: folder of the package.
    """
    return sorted(file.stem for file in package.glob("*.py") if file.stem != "__init__")


def _room(folder: Path) -> Room:
    files = sorted(folder.rglob("*.py"))
    lines = sum(1 for file in files for line in file.read_text("utf-8").splitlines() if line.strip())
    used = {name.split(".")[1] for file in files for name in imported(file) if name.startswith(f"{PACKAGE.name}.")}
    does = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8")))
    if not does:
        raise ValueError(f"the room {folder.name} must say in the docstring of its __init__.py what it does, found none")
    uses = tuple(name for name in HOUSE if name in used and name != folder.name)
    return Room(folder.name, " ".join(does.split("\n\n")[0].split()), lines, uses)


def imported(file: Path) -> Iterator[str]:
    """Modules that a file imports when it runs, also within functions; what only a type checker imports does not count."""

    def visit(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            # `from pgsd_nerfstudio import scene` names the room behind the word import.
            yield from (f"{node.module}.{alias.name}" for alias in node.names) if "." not in node.module else [node.module]
        for child in ast.iter_child_nodes(node):
            yield from visit(child)

    yield from visit(ast.parse(file.read_text("utf-8")))


def draw(house: list[Room]) -> str:
    """The picture as SVG; what it shows stands in its metadata as JSON."""
    places = {room.name: number for number, room in enumerate(house)}
    width = MARGIN + BOX + RAIL * (len(house) + 2) + MARGIN
    foot = HEAD + len(house) * (HIGH + GAP) + 10
    height = foot + HIGH + MARGIN
    against = any(places[used] > places[room.name] for room in house for used in room.uses)
    legend = "of that colour leads to." + (" A red dot: it comes later in the order." if against else "")
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="Helvetica, Arial, sans-serif">',
        f"<metadata>{escape(json.dumps([asdict(room) for room in house]))}</metadata>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
        _text(MARGIN, 34, "The rooms of pgsd_nerfstudio", 20, weight="bold"),
        _text(MARGIN, 56, "Data walks from top to bottom. A dot in a row: this room imports the room that the line", 13),
        _text(MARGIN, 73, legend, 13),
    ]
    for room in house:
        parts += _line_to(room.name, house, places)
    for room in house:
        parts += _box(room, places[room.name])
    parts += [
        f'<rect x="{MARGIN}" y="{foot}" width="{BOX}" height="{HIGH}" rx="6" fill="#f3f3f3" stroke="#999999"/>',
        _text(MARGIN + 18, foot + 20, "Below the rooms, for every room to use", 15, weight="bold"),
        *_wrapped(", ".join(below()), foot),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _top(place: int) -> int:
    return HEAD + place * (HIGH + GAP)


def _line_to(name: str, house: list[Room], places: dict[str, int]) -> list[str]:
    """The line of one room: an arrow into its box, and a dot in the row of each room that imports it."""
    here = places[name]
    users = [places[room.name] for room in house if name in room.uses]
    if not users:
        return []
    # Lines of later rooms lie nearer to the boxes, so that the arrows into boxes cross nothing.
    x, entry, right = MARGIN + BOX + RAIL * (len(house) - here + 1), _top(here) + 18, MARGIN + BOX
    colour = COLOURS[here % len(COLOURS)]
    ends = [_top(user) + 42 for user in users]
    parts = [
        f'<path d="M {x} {max([entry, *ends])} V {min([entry, *ends])}" fill="none" stroke="{colour}" stroke-width="2"/>',
        f'<path d="M {x} {entry} H {right + 8}" fill="none" stroke="{colour}" stroke-width="2"/>',
        f'<path d="M {right} {entry} l 10 -5 v 10 z" fill="{colour}"/>',
    ]
    for user, y in zip(users, ends, strict=True):
        shade = AGAINST if user < here else colour
        parts.append(f'<path d="M {right} {y} H {x}" fill="none" stroke="#bbbbbb" stroke-width="1"/>')
        parts.append(f'<circle cx="{x}" cy="{y}" r="5" fill="{shade}"/>')
    return parts


def _box(room: Room, place: int) -> list[str]:
    top, colour = _top(place), COLOURS[place % len(COLOURS)]
    return [
        f'<rect x="{MARGIN}" y="{top}" width="{BOX}" height="{HIGH}" rx="6" fill="#fafafa" stroke="{colour}"/>',
        f'<rect x="{MARGIN}" y="{top}" width="7" height="{HIGH}" rx="3" fill="{colour}"/>',
        _text(MARGIN + 18, top + 20, room.name, 15, weight="bold"),
        _text(MARGIN + BOX - 12, top + 20, f"{room.lines:,} lines", 12, colour="#666666", anchor="end"),
        *_wrapped(room.does, top),
    ]


def _wrapped(words: str, top: int) -> list[str]:
    """Words in at most two lines below the heading of a box."""
    lines = textwrap.wrap(words.replace("`", ""), 68, max_lines=2, placeholder=" ...")
    return [_text(MARGIN + 18, top + 37 + 15 * number, line, 12, colour="#333333") for number, line in enumerate(lines)]


def _text(
    x: float, y: float, words: str, size: int, *, weight: str = "normal", colour: str = "black", anchor: str = "start"
) -> str:
    style = f'font-size="{size}" font-weight="{weight}" fill="{colour}" text-anchor="{anchor}"'
    return f'<text x="{x}" y="{y}" {style}>{escape(words)}</text>'


def drawn(picture: Path = PICTURE) -> list[Room]:
    """The rooms that a picture shows."""
    found = re.search(r"<metadata>(.*?)</metadata>", picture.read_text("utf-8"), re.DOTALL)
    data = json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")) if found else []
    return [Room(**{**room, "uses": tuple(room["uses"])}) for room in data]


if __name__ == "__main__":
    PICTURE.write_text(draw(rooms()), "utf-8")
    print(PICTURE)
