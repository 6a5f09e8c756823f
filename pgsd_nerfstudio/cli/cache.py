"""`pgsd cache`: what is kept because it was costly to make, and its removal.

Only files whose folders and names this package gives are known here. Whatever else lies in the folder of the cache is neither
listed nor removed, and no link to another folder is followed.
"""

from __future__ import annotations

import json
import re
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from pgsd_nerfstudio.cli.console import console
from pgsd_nerfstudio.refusal import Refusal, refusing

Kind = Literal["demo", "surfaces", "motion", "answers", "edits", "prompts", "requests", "views", "bin"]
HASH = r"[0-9a-f]{16}"
KINDS: dict[Kind, tuple[str, str]] = {
    "demo": (rf"demo-{HASH}\.safetensors", "the built-in courtyard"),
    "surfaces": (rf"surfaces/{HASH}\.safetensors", "surface of a scene"),
    "motion": (rf"motion/{HASH}(\.safetensors|/chunk-\d+\.safetensors)", "simulated motion"),
    "answers": (rf"answers/{HASH}\.safetensors", "what reaches each Gaussian of a scene"),
    "edits": (rf"edits/{HASH}(\.unfinished)?\.safetensors", "look fitted to edited pictures"),
    "prompts": (rf"prompts/{HASH}\.safetensors", "a prompt as its text encoder reads it"),
    "requests": (rf"requests/request-{HASH}\.json", "reply of a language model"),
    "views": (rf"views/{HASH}/view_\d+\.png", "a view that has no photograph"),
    "bin": (r"bin/\.?ffmpeg(\.\d+)?", "link to the ffmpeg that ns-render uses"),
}
"""Of each kind: names of its files below the folder of the cache, and what they are."""
_NAMES: dict[Kind, re.Pattern[str]] = {kind: re.compile(pattern) for kind, (pattern, _) in KINDS.items()}
UNFINISHED = r"\.[0-9a-f]{8}\."
"""What stands before the name of a file that is being written, see `storage.atomic_write`."""
ABANDONED = 3600.0
"""Seconds after which nobody is writing such a file any more."""
DAY = 86400.0


@dataclass(frozen=True)
class Kept:
    """One file of the cache."""

    kind: Kind
    path: Path
    size: int
    """Bytes; of a link none."""
    age: float
    """Seconds since it was written."""

    @property
    def what(self) -> str:
        """What it is, with what the file says of itself."""
        name, general = self.path.name, KINDS[self.kind][1]
        if re.match(UNFINISHED, name):
            return f"{general}, left unfinished"
        if name.startswith("chunk-") or name.endswith(".unfinished.safetensors"):
            return f"{general}, interrupted: the same command goes on from here"
        about = described(self.path)
        if self.kind == "motion" and "effect" in about:
            return f"{about['effect']}, {about.get('intensity', 0):g} {about.get('unit', '')}, seed {about.get('seed', 0)}"
        if self.kind == "surfaces" and "voxel" in about:
            return f"{general}, voxels of {1000 * about['voxel']:.0f} mm"
        return general


def described(path: Path) -> dict[str, Any]:
    """What a stored file says of itself, read without its tensors; empty if it says nothing or cannot be read."""
    from pgsd_nerfstudio.storage import header_of  # which loads torch

    if path.suffix != ".safetensors":
        return {}
    try:
        header, _ = header_of(path)
        about = json.loads(header["__metadata__"]["about"])
        return about if isinstance(about, dict) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def kept(folder: Path) -> Iterator[Kept]:
    """The files of the cache in a folder, by kind and name.

    Raises:
        OSError: a folder cannot be read.
    """
    now = time.time()
    found = []
    for path in _files(folder):
        name = path.relative_to(folder).as_posix()
        whole = re.sub(rf"(^|/){UNFINISHED}(?=[^/]+$)", r"\1", name)
        if (kind := _kind_of(whole)) is not None:
            status = path.lstat()
            size = 0 if stat.S_ISLNK(status.st_mode) else status.st_size
            age = max(0.0, now - status.st_mtime)
            if whole == name or age > ABANDONED:
                found.append(Kept(kind, path, size, age))
    order = [*KINDS]
    yield from sorted(found, key=lambda each: (order.index(each.kind), each.path))


def _kind_of(name: str) -> Kind | None:
    """Kind of a file by its path below the folder of the cache; None if it is none of ours."""
    for kind, pattern in _NAMES.items():
        if pattern.fullmatch(name):
            return kind
    return None


def _files(folder: Path, depth: int = 0) -> Iterator[Path]:
    """Files and links, three folders deep; a link to a folder counts as a file."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.is_symlink() or path.is_file():
            yield path
        elif path.is_dir() and depth < 2:
            yield from _files(path, depth + 1)


def size_of(count: float) -> str:
    """A number of bytes in kB, MB or GB."""
    if count < 1000:
        return f"{count:.0f} bytes"
    for unit in ("kB", "MB"):
        count /= 1000
        if count < 1000:
            return f"{count:.3g} {unit}"
    return f"{count / 1000:.3g} GB"


def age_of(seconds: float) -> str:
    """A time in seconds, in the unit that suits it."""
    for unit, length in (("days", DAY), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True)
class List:
    """List what is kept: kind, size, time since it was made, and what it is."""

    kind: tuple[Kind, ...] = ()
    """Only these kinds; all of them if not given."""

    def run(self) -> int:
        from rich.console import Console
        from rich.table import Column, Table

        from pgsd_nerfstudio.storage import cache_dir

        folder = cache_dir()
        with refusing(OSError):
            files = _chosen(folder, self.kind)
        table = Table("kind", Column("file", overflow="fold"), "size", "age", "what it is")
        for each in files:
            name = str(each.path.relative_to(folder))
            table.add_row(each.kind, name, size_of(each.size), age_of(each.age), each.what)
        if files:
            Console().print(table)
        print(f"{_counted(files)} in {folder}")
        return 0


@dataclass(frozen=True)
class Clear:
    """Remove what is kept; it is made again when it is needed. Runs keep copies of what they need, and stay whole."""

    kind: tuple[Kind, ...] = ()
    """Only these kinds; all of them if not given."""
    older_than: float = 0.0
    """Only what was made more than so many days ago."""
    dry_run: bool = False
    """Say what would be removed, and remove nothing."""
    yes: bool = False
    """Do not ask."""

    def run(self) -> int:
        from pgsd_nerfstudio.storage import cache_dir

        if not self.older_than >= 0:
            raise Refusal(f"--older-than must be a number of days, 0 or more, got {self.older_than:g}")
        folder = cache_dir()
        with refusing(OSError):
            files = _chosen(folder, self.kind, self.older_than)
        if self.dry_run or not files:
            for each in files:
                print(each.path)
            print(f"{_counted(files)} in {folder} would be removed" if files else f"nothing to remove in {folder}")
            return 0
        if not self.yes and not self._agreed(f"Remove {_counted(files)} from {folder}?"):
            print("nothing was removed")
            return 0
        for each in files:
            with refusing(OSError):
                each.path.unlink(missing_ok=True)
        _remove_empty_folders(folder, files)
        print(f"{_counted(files)} removed from {folder}")
        return 0

    def _agreed(self, question: str) -> bool:
        if not sys.stdin.isatty():
            raise Refusal(f"{question} There is nobody to ask: add --yes, or --dry-run to see what would be removed")
        return console().input(f"{question} [y/N] ", markup=False).strip().lower() in ("y", "yes")


@dataclass(frozen=True)
class Cache:
    """What is kept because it was costly to make, in $PGSD_CACHE or ~/.cache/pgsd_nerfstudio: list or clear it."""

    action: Annotated[
        Annotated[List, tyro.conf.subcommand("list", prefix_name=False)]
        | Annotated[Clear, tyro.conf.subcommand("clear", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        return self.action.run()


def _chosen(folder: Path, kinds: Sequence[Kind], older_than: float = 0.0) -> list[Kept]:
    kinds = kinds or get_args(Kind)
    return [each for each in kept(folder) if each.kind in kinds and each.age >= older_than * DAY]


def _counted(files: Sequence[Kept]) -> str:
    return f"{len(files)} file{'' if len(files) == 1 else 's'}, {size_of(sum(each.size for each in files))}"


def _remove_empty_folders(folder: Path, files: Sequence[Kept]) -> None:
    """Folders that these files have left empty, but not that of the cache."""
    for parent in sorted({above for each in files for above in each.path.parents}, key=lambda each: -len(each.parts)):
        if folder in parent.parents and not any(parent.iterdir()):
            parent.rmdir()
