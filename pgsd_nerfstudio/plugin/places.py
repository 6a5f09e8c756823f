"""Where what a run was made of lies now: where it was, or, after a move of the whole, below a folder above the run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path


def found(saved: Path, run_folder: Path, made_in: Path | None = None) -> Path | None:
    """The place at which a file or folder that a run remembers is found; None if at none.

    The place itself comes first, then the one that lies to the run as it did when the run was made. Then its last parts are
    looked for below the folder of the run and each folder above: a scene `/old/project/data/garden.ply` of the run
    `/new/project/outputs/run` is `/new/project/data/garden.ply`. A relative place, as nerfstudio saves it, is looked for from
    the working directory first.

    Args:
        saved: the place as it was saved.
        run_folder: absolute, of the run.
        made_in: absolute, where the run's folder was when it was made; None: it is not known.
    """
    return next((place for place in places(saved, run_folder, made_in) if _exists(place)), None)


def places(saved: Path, run_folder: Path, made_in: Path | None = None) -> Iterator[Path]:
    """Where `found` looks, in this order. Of a folder the name alone says too little: it counts for files only."""
    yield saved
    if made_in is not None and saved.is_absolute():
        yield Path(os.path.normpath(run_folder / os.path.relpath(saved, made_in)))
    parts = saved.parts[1:] if saved.is_absolute() else saved.parts
    for folder in (run_folder, *run_folder.parents):
        for first in range(len(parts)):
            place = folder.joinpath(*parts[first:])
            if first < len(parts) - 1 or (first == 0 and not saved.is_absolute()) or (_exists(place) and place.is_file()):
                yield place


def _exists(place: Path) -> bool:
    try:
        return place.exists()
    except OSError:  # a folder on the way that may not be read, a name that is too long
        return False
