"""Drips: all rain that runs over an edge falls from it, in drops."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import RAINFALL
from pgsd_nerfstudio.physics.bodies import DRIPPED, SPLASHED
from pgsd_nerfstudio.physics.clock import Clock, Domain
from pgsd_nerfstudio.physics.ground.drips import DIAMETER, Drips, after_film
from pgsd_nerfstudio.physics.metric import simulate_metric
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

RATE = 20e-3 / 3600  # m/s
DROP = math.pi / 6 * DIAMETER**3


def _tables() -> np.ndarray:
    """A table of 0.8 m x 0.6 m that slopes to one side, on ground that slopes away."""
    x, y = np.meshgrid(np.arange(60) * 0.03, np.arange(50) * 0.03, indexing="ij")
    ground = 0.01 * x
    table = (x > 0.5) & (x < 1.3) & (y > 0.4) & (y < 1.0)
    return np.where(table, 0.7 - 0.02 * x, ground)


def test_the_edges_of_a_table_get_the_rain_of_its_whole_top():
    heights = _tables()
    drips = Drips.on(heights, np.zeros(2), 0.03)
    assert drips.areas.sum() == pytest.approx((heights > 0.3).sum() * 0.03**2)
    assert (drips.places[:, 2] < 0.7).all() and (drips.places[:, 2] > 0.6).all()
    low, high = drips.places[:, 0] > 1.1, drips.places[:, 0] < 0.7
    assert drips.areas[low].sum() > 3 * drips.areas[high].sum()


def test_what_has_come_to_an_edge_has_dripped_but_for_less_than_a_drop():
    drips = Drips.on(_tables(), np.zeros(2), 0.03)
    for metres in (0.0, 1e-5, 1e-4, 1e-3):
        hanging = drips.areas * metres / DROP - drips.dripped(metres, RATE)
        assert ((hanging >= 0) & (hanging < 1)).all()
    steps = np.linspace(0, 1e-3, 37)
    fell = sum(stands_for.sum() for _, stands_for in (drips.falling(a, b, RATE) for a, b in pairwise(steps)))
    assert fell == drips.dripped(1e-3, RATE).sum()


def test_the_film_comes_first():
    assert after_film(1e-7, 800.0) == 0.0
    assert after_film(1e-3, 800.0) == pytest.approx(1e-3 - 2e-4 / 800)


def test_no_edge_no_drip():
    assert len(Drips.on(np.zeros((20, 20)), np.zeros(2), 0.03).areas) == 0
    assert len(Drips.on(np.full((20, 20), np.nan), np.zeros(2), 0.03).areas) == 0


def _bench() -> SurfaceMesh:
    """Level ground, and a level plate of 1 m x 1 m half a metre above it."""
    corners = []
    for half, height in ((3.0, 0.0), (0.5, 0.5)):
        corners += [[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]]
    triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return SurfaceMesh(torch.tensor(corners), torch.tensor(triangles, dtype=torch.int32))


def test_drops_fall_from_the_edge_of_a_bench_in_a_simulation():
    clock, domain = Clock(frames=75), Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 3.0))
    rain = replace(RAINFALL, wind=replace(RAINFALL.wind, speed=0.0, turbulence=0.0))
    run = simulate_metric(_bench(), rain, clock, domain, max_particles=300, progress=False)
    drips = (run.kinds & (DRIPPED | SPLASHED)) == DRIPPED  # not what splashes from them
    film = 2e-4 / rain.surface.accumulation_speedup
    expected = 1.0 * (RATE * 74 / 25 - film) / DROP
    assert 0.6 * expected < int((drips.float() * run.represents).sum()) <= expected
    starts = run.positions[run.offsets[:-1]][drips]
    assert (starts[:, :2].abs().amax(1) - 0.5).abs().max() < 0.06 and (starts[:, 2] - 0.48).abs().max() < 0.02
    off = replace(rain, surface=replace(rain.surface, drips=False))
    dry = simulate_metric(_bench(), off, clock, domain, max_particles=300, progress=False)
    assert not (dry.kinds & DRIPPED).any()
