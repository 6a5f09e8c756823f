"""Only what will be seen is simulated, and all of it: falls by hand, and whole runs beside runs without foresight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import RAINFALL, SNOWFALL, Wind
from pgsd_nerfstudio.physics import Clock, Domain, simulate_metric
from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.foresight import foresee
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import NO_END, SPLASHED, Bodies
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-3.0, -3.0, 0.0), (3.0, 3.0, 4.0))
STILL = Wind(speed=0.0, turbulence=0.0, flutter=0.0)


def layer(low: float, high: float, distance: float) -> Sight:
    """Air between two heights is seen from a distance, in cells of 0.2 m."""
    seen = np.full((30, 30, 20), np.inf, np.float32)
    seen[:, :, round(low / 0.2) : round(high / 0.2)] = distance
    return Sight(np.array(DOMAIN.lower), np.full(3, 0.2), seen, np.minimum.accumulate(seen[:, :, ::1], 2))


def falling(heights: np.ndarray, speed: float, reach: float) -> Bodies:
    count = len(heights)
    none = Bodies.none()
    values = {name: np.zeros((count, *value.shape[1:]), value.dtype) for name, value in vars(none).items()}
    values["positions"][:, 2], values["velocities"][:, 2] = heights, -speed
    values["speeds"][:], values["reaches"][:], values["until"][:] = speed, reach, NO_END
    return Bodies(**values)


@pytest.mark.parametrize(("speed", "frames"), [(1.0, 12), (8.0, 3)])
def test_a_fall_through_a_layer_matters_from_before_it_until_after_it(speed, frames):
    bodies = falling(np.array([3.9, 2.5, 1.5]), speed, 2.0)
    settings = {"step": 0.04, "wind": WindField.draw(STILL, 0), "domain": DOMAIN, "sight": layer(1.0, 2.0, 1.5)}
    found = foresee(bodies, 10, **settings)
    for i, height in enumerate((3.9, 2.5, 1.5)):
        enters, leaves = 10 + max(height - 2.0, 0.0) / speed / 0.04, 10 + (height - 1.0) / speed / 0.04
        assert enters - frames <= found.since[i] <= enters
        assert leaves <= found.until[i] <= leaves + 2 * frames + 1
        assert found.positions[i, 2] == pytest.approx(height - (found.since[i] - 10) * 0.04 * speed, abs=1e-4)
    assert len(foresee(falling(np.array([0.9]), speed, 2.0), 10, **settings)) == 0  # below it
    assert len(foresee(falling(np.array([3.0]), speed, 1.4), 10, **settings)) == 0  # beyond its reach


def narrow() -> Cameras:
    """Looks along y through a part of the box."""
    viewmat = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 1.2], [0, 1, 0, 3.5], [0, 0, 0, 1]])
    K = torch.tensor([[500.0, 0, 120], [0, 500, 90], [0, 0, 1]])
    return Cameras(viewmat[None], K[None], 240, 180)


def shown(history, frame: int) -> int:
    """Particles in the picture within their reach, without splashes."""
    ids = history.active(frame)
    points = history.positions_at(frame, ids).numpy()
    seen = points @ narrow().viewmats[0, :3, :3].numpy().T + narrow().viewmats[0, :3, 3].numpy()
    u, v = 500 * seen[:, 0] / seen[:, 2] + 120, 500 * seen[:, 1] / seen[:, 2] + 90
    inside = (seen[:, 2] > 0) & (u > 0) & (u < 240) & (v > 0) & (v < 180)
    inside &= np.linalg.norm(seen, axis=1) <= history.reaches[ids].numpy()
    return int((inside & ((history.kinds[ids].numpy() & SPLASHED) == 0)).sum())


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL], ids=lambda e: e.name)
def test_what_is_seen_is_as_much_as_without_foresight_at_a_part_of_the_work(effect, monkeypatch):
    effect = replace(effect, wind=replace(effect.wind, speed=2.0), surface=replace(effect.surface, splash=None))
    corners = 3 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    floor = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    settings = {"max_particles": 20_000, "cameras": narrow(), "progress": False}
    few = simulate_metric(floor, effect, Clock(25.0, 50), DOMAIN, **settings)
    monkeypatch.setattr(Air, "_that_matter", lambda self, new, frame: new)
    many = simulate_metric(floor, effect, Clock(25.0, 50), DOMAIN, **settings)
    frames = range(0, 50, 7)
    both = np.array([[shown(run, frame) for frame in frames] for run in (few, many)])
    assert both[1].min() > 100
    # Frame by frame within chance, and on average.
    assert (np.abs(both[0] - both[1]) < 5 * np.sqrt(both[1])).all(), both
    assert both[0].mean() == pytest.approx(both[1].mean(), rel=3 / math.sqrt(both[1].sum()))
    assert few.positions.shape[0] < 0.55 * many.positions.shape[0]
