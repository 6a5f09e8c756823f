"""A dam that breaks: the front of water on a dry floor, against theory and against the experiment of Martin & Moyce (1952).

Without friction and with a dam that vanishes at once the answer is known (`potential_flow`), and that is what is simulated
here. The experiment lags behind it by about 0.3 units of time (16 ms) at each of its first five times: a membrane that melts is
no dam that vanishes. Its speed is comparable, its instants are not; and late its thin tip is slowed by the floor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from pgsd_nerfstudio.laboratory.experiments.potential_flow import collapse, front
from pgsd_nerfstudio.laboratory.experiments.solids import G, lattice
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm.config import MpmConfig
from pgsd_nerfstudio.physics.mpm.materials import Water
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.runtime import Precision
from pgsd_nerfstudio.physics.mpm.solver import Mpm

MARTIN_MOYCE = ((0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134), (4.034, 4.944))
"""Time T = t sqrt(2 g / a) and front Z = x / a of a column of a = 2.25 inches, twice as high (1952, figure 3)."""
WIDTH = 0.05715  # a in metres
LEFT_OUT = 0.002  # share of the water beyond the front, here and in theory: single particles are no front


def dam_break(
    times: Sequence[float], cells: int = 10, thick: int = 8, *, precision: Precision = "f32", bulk: float = 1e5
) -> list[float]:
    """Fronts Z at ascending times T, with `cells` to a width of the column and `thick` cells between its side walls."""
    dx = WIDTH / cells
    walls = Obstacle.room((0, 0, 0), (7 * WIDTH, thick * dx, 4 * WIDTH), 0.0)
    domain = Domain((-dx, -dx, -dx), (7 * WIDTH + dx, (thick + 1) * dx, 3 * WIDTH))
    mpm = Mpm(MpmConfig(dx=dx, precision=precision), domain, walls)
    points, volume = lattice((0, 0, 0), (WIDTH, thick * dx, 2 * WIDTH), dx / 2)
    mpm.emit(points, torch.zeros_like(points), Water(bulk_modulus=bulk), volume)
    fronts, now = [], 0.0
    for late in times:
        mpm.step((late - now) / math.sqrt(2 * G / WIDTH))
        now = late
        # A particle reaches half its spacing beyond its middle.
        fronts.append((float(mpm.positions[:, 0].double().quantile(1 - LEFT_OUT)) + dx / 4) / WIDTH)
    return fronts


def dam_break_in_theory(times: Sequence[float], spacing: float = 0.03) -> tuple[list[float], list[float]]:
    """Fronts Z, read like those of `dam_break`, and the very tips, at ascending times T by potential flow."""
    surfaces = collapse([late / math.sqrt(2) for late in times], 2.0, spacing)
    return [front(surface, LEFT_OUT) for surface in surfaces], [front(surface, 0.0) for surface in surfaces]


def passage(times: Sequence[float], fronts: Sequence[float], start: float, end: float) -> float:
    """Time T that a front takes from Z = start to Z = end: what does not depend on when the dam began to open."""
    begun, done = np.interp([start, end], fronts, times)
    return float(done - begun)
