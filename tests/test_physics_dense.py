"""Dense matter in large domains: the cells of its grid grow, so that memory is bounded, and matter rests in them too."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import pgsd_nerfstudio.physics.ground.dense as module
from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.dense import DenseMatter
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SNOW = effect("snowfall")


def matter(domain: Domain) -> DenseMatter:
    corners = torch.tensor([[-9.0, -9, 0.4], [9, -9, 0.4], [9, 9, 0.4], [-9, 9, 0.4]])
    floor = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    assert SNOW.dense is not None
    return DenseMatter(SNOW.dense, SNOW.surface, floor, domain)


def test_the_cells_are_those_of_the_effect_until_there_would_be_too_many():
    assert SNOW.dense is not None
    assert matter(Domain((-10, -10, -0.3), (10, 10, 20))).cell == SNOW.dense.cell
    tall = Domain((-10, -10, -0.3), (10, 10, 400))
    cell = matter(tall).cell
    assert math.prod(edge / cell for edge in tall.size) == pytest.approx(12e6, rel=1e-6)


@pytest.mark.slow
def test_matter_rests_on_the_floor_in_large_cells_too(monkeypatch):
    monkeypatch.setattr(module, "MOST_CELLS", 2_000)
    heap = matter(Domain((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0)))
    assert heap.cell == pytest.approx(0.252, abs=0.001)
    at = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 8)] * 2, [0.55, 0.6]), -1).reshape(-1, 3)
    n = len(at)
    bodies = Bodies(
        ids=np.arange(n),
        positions=at.astype(np.float32),
        velocities=np.zeros((n, 3), np.float32),
        **{name: np.zeros(n, np.float32) for name in ("speeds", "diameters", "sways", "hertz", "phases", "holds", "spins")},
        represents=np.ones(n, np.float32),
        reaches=np.full(n, 1e9, np.float32),
        since=np.zeros(n, np.int32),
        until=np.full(n, 2**31 - 1, np.int32),
        kinds=np.zeros(n, np.uint8),
    )
    heap.add(bodies, np.full(n, 1e-4))
    rested = np.zeros(n, bool)
    for _ in range(75):
        moved = heap.step(0.04)
        height, rested = moved.positions[:, 2], moved.rests
        if rested.any():
            break
    assert rested.any() and (height > 0.4 - 0.05).all() and height.max() < 0.7
