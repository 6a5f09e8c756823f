"""Figures of large scenes: what the map of a surface costs when only a part of the scene lies in the simulated air.

The demo's exact surface is stretched, while the air stays 20 m wide, as it does in any large scene.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.ground.sampling import points_within
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid, Wetting
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

AIR = Domain((-10.0, -10.0, -0.3), (10.0, 10.0, 6.0))
STRETCHED = (1, 10, 100)
PLAIN = 10  # the largest stretch whose whole surface is sampled too
CELL = 0.25  # m; of the places that are compared
WETTING = Wetting(cell=0.1)


def rows(exact: SurfaceMesh, *, quick: bool) -> Iterator[Record]:
    """Memory and time of the maps of a surface against its size, beside the places that they miss.

    Args:
        exact: a surface around the origin, in metres.
        quick: without the largest size.
    """
    for factor in STRETCHED[:-1] if quick else STRETCHED:
        surface = SurfaceMesh(exact.vertices * factor, exact.triangles)
        across = float((surface.bounds[1] - surface.bounds[0]).max())
        for name, make in (("contact", _contact), ("wetness", _wetness)):
            began = time.perf_counter()
            make(surface)
            seconds = time.perf_counter() - began
            tracemalloc.start()
            make(surface)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            missed = _missed(surface) if factor <= PLAIN else None
            paid = {} if missed is None else {"error": missed, "error_unit": f"places of {CELL:g} m missed"}
            source = f"demo's surface, {across:,.0f} m across, in air of 20 x 20 m"
            yield Record(f"map of {name}, scene {across:,.0f} m across: memory", peak / 1e6, "MB", source=source, **paid)
            yield Record(f"map of {name}, scene {across:,.0f} m across: time", seconds, "s", source=source, **paid)


def _contact(surface: SurfaceMesh) -> None:
    Ground.of(surface, SurfaceResponse(), AIR)


def _wetness(surface: SurfaceMesh) -> None:
    WetnessGrid.of(surface, AIR, WETTING)


def _missed(surface: SurfaceMesh) -> int:
    """Number of places in the air where sampling the whole surface finds it, and sampling it within the air does not."""
    lower, upper = np.array(AIR.lower), np.array(AIR.upper)
    everywhere = np.full(3, np.inf)
    whole = _places(points_within(surface, -everywhere, everywhere, CELL / 2))
    return len(np.setdiff1d(whole, _places(points_within(surface, lower, upper, CELL / 2))))


def _places(pieces: Iterator[ndarray]) -> Int[ndarray, " n"]:
    """Keys of the cells in the air that hold a point."""
    lower, shape = np.array(AIR.lower), np.ceil(np.array(AIR.size) / CELL).astype(int)
    keys = np.zeros(0, np.int64)
    for points in pieces:
        cells = np.floor((points - lower) / CELL).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < shape)).all(1)]
        keys = np.union1d(keys, np.ravel_multi_index(tuple(cells.T), tuple(shape)))
    return keys
