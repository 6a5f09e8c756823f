"""Figures of what flies: how much of a picture it changes, how its number grows, what thinning costs, whether it flickers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from torch import Tensor

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.visibility import changed_rows, flicker_rows, shown, weather_along
from pgsd_nerfstudio.physics import Clock, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.physics.ground.lowest import down_to_ground
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene

SIZE = (480, 320)  # pixels
PEAK = 0.1  # alpha from which a flake stands out as a spot
ALL = 10**8


def rows(quick: bool) -> Iterator[Record]:
    """The rows; `quick` takes one frame where else three are averaged."""
    prepared = prepare_scene(demo_scene(), "cpu")
    path = slow_path(prepared.scene, frames=50)
    view = path[25].resized(*SIZE)
    instants = (2,) if quick else (2, 14, 24)
    yield from changed_rows(prepared, path, view, instants)
    yield _growth(prepared, path, view)
    yield from _thinning(prepared, path, view)
    yield from flicker_rows(prepared, path, view, 4 if quick else 12)
    yield from _windy(prepared)


def _growth(prepared: PreparedScene, path: Cameras, view: Cameras) -> Record:
    counts = [
        _spots(shown(weather_along(prepared, effect("snowfall", intensity=rate), path, 2, most=ALL), view, 1).alpha)
        for rate in (0.5, 6.0)
    ]
    power = float(np.log(counts[1] / counts[0]) / np.log(12.0))
    return Record.judged(
        "snow, 0.5 to 6 mm/h: visible flakes grow as this power of the intensity",
        power,
        "",
        ">= 0.6",
        source=f"{counts[0]} and {counts[1]} spots; the real number grows as 0.76 (Gunn & Marshall 1958)",
    )


def _spots(alpha: Float[Tensor, "h w"]) -> int:
    """Number of local maxima of alpha above PEAK."""
    values = alpha.numpy()
    return int(((values == maximum_filter(values, 3)) & (values > PEAK)).sum())


def _thinning(prepared: PreparedScene, path: Cameras, view: Cameras) -> Iterator[Record]:
    """Against a run in which every particle is there and drawn however far away it is."""
    for name, intensity in (("snowfall", 1.5), ("rainfall", 20.0)):
        kind = effect(name, intensity=intensity).with_legibility(1.0)
        full = shown(weather_along(prepared, kind, path, 1, sharpness=1e5, most=ALL), view, 0)
        for most in (100_000, 20_000):
            weather = weather_along(prepared, kind, path, 1, most=most)
            thin = shown(weather, view, 0)
            light = [float(luminance(linear(each.weather).reshape(-1, 3)).mean()) for each in (thin, full)]
            spots = [_spots(each.alpha) for each in (thin, full)]
            yield Record.judged(
                f"{name}, {intensity:g} mm/h, at most {most:,} seen: mean light against the unthinned run",
                100 * abs(light[0] / light[1] - 1),
                "%",
                "<= 1",
                error=100 * (spots[0] / max(spots[1], 1) - 1),
                error_unit=f"% more spots ({spots[0]} for {spots[1]})",
                source=f"{len(weather.history):,} particles; unthinned: all that the cameras may see, at any distance",
            )


def _windy(prepared: PreparedScene) -> Iterator[Record]:
    scene = prepared.scene
    surface = surface_of(scene, prepared.rasterizer, progress=False)
    domain, kind = domain_of(scene), effect("snowfall")
    counts = {}
    for speed in (0.0, 8.0):
        windy = replace(kind, wind=replace(kind.wind, speed=speed, gustiness=0.0))
        history = simulate_metric(surface, windy, Clock(25.0, 75), domain, max_particles=20_000, progress=False)
        # Above all furniture, where neither shelter nor the ground takes any.
        above = []
        for frame in (0, 50, 74):
            heights = history.positions_at(frame, history.active(frame))[:, 2]
            above.append(float((heights > domain.upper[2] - 1.0).sum()))
        counts[speed] = float(np.mean(above[1:])) / above[0]
    yield Record.judged(
        "snow in a wind of 8 m/s: flakes in the upper metre of the air, against the start",
        counts[8.0],
        "",
        ">= 0.9",
        error=counts[0.0],
        error_unit="in still air",
        source="what enters upwind is flux times area, so that the wind takes none",
    )
    pit = torch.tensor([[-2.0, -2, -1], [2, -2, -1], [2, 2, -1], [-2, 2, -1]])
    hole = SurfaceMesh(pit, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    history = simulate_metric(hole, kind, Clock(25.0, 150), down_to_ground(domain, hole), max_particles=3_000, progress=False)
    deep = float((history.rest_positions[history.collided][:, 2] < -0.5).float().mean()) if history.collided.any() else 0.0
    yield Record.judged(
        "snow over a pit 1 m below the ground: share of the landed that lies in it", 100 * deep, "%", ">= 99", source="geometry"
    )
