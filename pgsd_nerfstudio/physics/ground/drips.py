"""Drips: rain that runs off tables, benches and roofs gathers at their edges and falls in large drops.

The way of the water is that of `standing_water`, on the map of what is seen from above. Where it would go down over an edge, it
hangs until it has gathered the volume of a drop. The drops of an edge are counted by the water that has come to it, so nothing
is lost: what has come has dripped, or hangs there as less than one drop. Drops that fall from edges and leaves are 4 to 6 mm
wide (Hall & Calder, "Drop size modification by forest canopies: measurements using a disdrometer", Journal of Geophysical
Research 98, 1993).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.flooding import flood
from pgsd_nerfstudio.physics.ground.ground_map import heights_below
from pgsd_nerfstudio.physics.ground.standing_water import CELL, FILM, MAX_CELLS
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DIAMETER = 0.0045  # m
EDGE = 0.12  # m; water that goes farther down between two cells falls
SLOWEST = 0.02  # drops a second of an edge; less water than that evaporates or creeps below
BELOW = 0.02  # m below the edge at which a drop lets go
MOST = 400.0  # drops a second of all edges; where more fall, each stands for several


@dataclass(frozen=True, eq=False)
class Drips:
    """Edges from which water drips; e of them."""

    places: Float[ndarray, "e 3"]
    """Where drops let go, metres."""
    areas: Float[ndarray, " e"]
    """m^2 of surface whose rain comes to each edge."""

    @staticmethod
    def of(surface: SurfaceMesh, domain: Domain) -> Drips:
        """The edges of a scene.

        Args:
            surface: the mesh in metres.
            domain: bounds of the map.
        """
        cell = max(CELL, math.sqrt(domain.area / MAX_CELLS))
        lower = np.asarray(domain.lower[:2], float) + cell / 2
        shape = tuple(np.maximum(np.floor(np.asarray(domain.size[:2]) / cell).astype(int), 1))
        x, y = (lower[k] + cell * np.arange(shape[k]) for k in range(2))
        at = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        heights = heights_below(surface, at, np.full(len(at), float(domain.upper[2])))
        return Drips.on(heights.reshape(shape), lower, cell)

    @staticmethod
    def on(heights: Float[ndarray, "x y"], lower: Float[ndarray, "2"], cell: float) -> Drips:
        """The edges of a map of heights.

        Args:
            heights: m; NaN where there is no surface.
            lower: centre of the first cell, m.
            cell: edge of a cell, m.
        """
        known = np.where(np.isfinite(heights), heights, -np.inf)
        _, parent, order = flood(known, np.full(heights.shape, -np.inf))
        cells = _over_edges(known.reshape(-1), parent, order)
        edges = np.flatnonzero(cells)
        place = np.stack(np.unravel_index(edges, heights.shape), 1)
        down = np.stack(np.unravel_index(parent[edges], heights.shape), 1)
        at = lower + cell * (place + 0.75 * (down - place))
        return Drips(np.concatenate([at, known[tuple(place.T)][:, None] - BELOW], 1), cells[edges] * cell**2)

    def dripped(self, fallen: float, rate: float) -> Int[ndarray, " e"]:
        """Drops that have let go of each edge; edges that get too little water have none.

        Args:
            fallen: m of rain so far.
            rate: of the full rain, m/s.
        """
        drop = math.pi / 6 * DIAMETER**3
        ready = self.areas * rate / drop > SLOWEST
        return np.where(ready, np.floor(self.areas * max(fallen, 0.0) / drop), 0).astype(np.int64)

    def falling(self, before: float, after: float, rate: float) -> tuple[Int[ndarray, " d"], Float[ndarray, " d"]]:
        """The edges of the drops that let go while rain falls, and how many real drops each stands for.

        Args:
            before: m of rain at the beginning.
            after: m of rain at the end.
            rate: of the full rain, m/s.
        """
        stands_for = max(1, math.ceil(self.areas.sum() * rate / (math.pi / 6 * DIAMETER**3) / MOST))
        first, last = (self.dripped(fallen, rate) // stands_for for fallen in (before, after))
        edges = np.repeat(np.arange(len(self.areas)), last - first)
        return edges, np.full(len(edges), float(stands_for))


def after_film(fallen: float, speedup: float) -> float:
    """m of rain that has run off: the film that clings to a surface takes what comes first, in the time lapse of water."""
    return max(fallen - FILM / speedup, 0.0)


@kernel()
def _over_edges(heights: ndarray, parent: ndarray, order: ndarray) -> ndarray:
    """Number of cells whose water falls over the edge of each cell."""
    n = len(heights)
    coming = np.ones(n)
    over = np.zeros(n)
    for k in range(n - 1, -1, -1):  # upstream cells come first
        at = order[k]
        way = parent[at]
        if way < 0 or heights[at] == -np.inf:
            continue
        if heights[at] - heights[way] > EDGE:
            if heights[way] > -np.inf:
                over[at] += coming[at]
        else:
            coming[way] += coming[at]
    return over
