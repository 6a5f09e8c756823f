"""Figures of what flies: how much of a picture it changes, how its number grows, what thinning costs, whether it flickers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from torch import Tensor

from pgsd_nerfstudio.dynamics.in_sight import Eye, faded_in
from pgsd_nerfstudio.effects import Effect, effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Clock, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.physics.ground.lowest import down_to_ground
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of
from pgsd_nerfstudio.weather.adapting import adapted
from pgsd_nerfstudio.weather.making import answer_to
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene
from pgsd_nerfstudio.weather.weather import Weather

SIZE = (480, 320)  # pixels
CHANGED = 0.03  # of the range of display values: eight steps of 8 bits, which one sees
PEAK = 0.1  # alpha from which a flake stands out as a spot
ALL = 10**8


def rows(quick: bool) -> Iterator[Record]:
    """The rows; `quick` takes one frame where else three are averaged."""
    prepared = prepare_scene(demo_scene(), "cpu")
    path = slow_path(prepared.scene, frames=50)
    view = path[25].resized(*SIZE)
    instants = (2,) if quick else (2, 14, 24)
    yield from _changed(prepared, path, view, instants)
    yield _growth(prepared, path, view)
    yield from _thinning(prepared, path, view)
    yield from _flicker(prepared, path, view, 4 if quick else 12)
    yield from _windy(prepared)


@dataclass(frozen=True)
class _Shown:
    """Pictures of one moment in display values, and the flying layer alone."""

    weather: Float[Tensor, "h w 3"]
    without: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]


def _weather(
    prepared: PreparedScene, kind: Effect, path: Cameras, frames: int, sharpness: float | None = None, most: int = 100_000
) -> Weather:
    """A weather over ground and furniture; what is seen of it is not kept in the cache."""
    scene, kind = prepared.scene, adapted(kind, prepared)[0]
    surface = surface_of(scene, prepared.rasterizer, progress=False)
    history = simulate_metric(
        surface,
        kind,
        Clock(25.0, frames),
        domain_of(scene),
        max_particles=most,
        cameras=scene.frame.cameras_to_metric(path),
        sharpness=sharpness,
        progress=False,
    )
    options = SimulationOptions(seconds=frames / 25.0)
    answer = answer_to(prepared, surface, kind, options).beside(history.about["sharpness"])
    return Weather(prepared, kind, options, history, answer)


def _shown(weather: Weather, view: Cameras, frame: int) -> _Shown:
    """With and without what flies; landed particles are in both."""
    place, rasterizer = weather.scene.frame, weather.prepared.rasterizer
    eye = Eye.of(view, rasterizer.config, place)
    instant = next(weather.sequence.frames(frame, frame + 1))
    everything = place.gaussians_to_scene(faded_in(instant, weather.history.reaches, eye))
    flying = len(instant.active)
    ids = torch.arange(len(everything))
    air, ground = everything.select(ids[:flying]), everything.select(ids[flying:])
    moment = weather.moment(frame)
    pictures = [rasterizer.render(view, moving, None, moment).rgb[0].clamp(0, 1) for moving in (everything, ground)]
    layers = [_alone(weather.prepared, air, view, grey) for grey in (1.0, 0.0)]
    return _Shown(pictures[0], pictures[1], (layers[0] - layers[1]).mean(-1))


def _alone(prepared: PreparedScene, air: Gaussians, view: Cameras, grey: float) -> Float[Tensor, "h w 3"]:
    """The scene with flying particles of one grey, without light and haze; the difference of white and black is their alpha."""
    painted = replace(air, colors=torch.full_like(air.colors, grey))
    return prepared.rasterizer.render(view, painted, None, None).rgb[0]


def _changed(prepared: PreparedScene, path: Cameras, view: Cameras, instants: tuple[int, ...]) -> Iterator[Record]:
    for name, intensity, low, high in (("snowfall", 1.5, 5, 20), ("rainfall", 20.0, 10, 40)):
        for legibility in (None, 1.0):
            kind = effect(name, intensity=intensity)
            if legibility is not None:
                if kind.appearance.legibility == 1.0:
                    continue
                kind = replace(kind, appearance=replace(kind.appearance, legibility=1.0))
            weather = _weather(prepared, kind, path, instants[-1] + 1)
            shares = []
            for frame in instants:
                shown = _shown(weather, view, frame)
                shares.append(float(((shown.weather - shown.without).abs().amax(-1) > CHANGED).float().mean()))
            found = 100 * float(np.mean(shares))
            factor = kind.appearance.legibility
            asked = legibility is None
            yield Record(
                f"{name}, {intensity:g} mm/h, demo: pixels that flying particles change, legibility {factor:g}",
                found,
                "%",
                target=f">= {low}" if asked else None,
                holds=low <= found <= high if asked else None,
                source=f"wanted {low}-{high} %; changed: by more than {CHANGED:g} of the range, {SIZE[0]}x{SIZE[1]} pixels",
            )


def _growth(prepared: PreparedScene, path: Cameras, view: Cameras) -> Record:
    counts = [
        _spots(_shown(_weather(prepared, effect("snowfall", intensity=rate), path, 2, most=ALL), view, 1).alpha)
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
        kind = effect(name, intensity=intensity)
        kind = replace(kind, appearance=replace(kind.appearance, legibility=1.0))
        full = _shown(_weather(prepared, kind, path, 1, sharpness=1e5, most=ALL), view, 0)
        for most in (100_000, 20_000):
            weather = _weather(prepared, kind, path, 1, most=most)
            thin = _shown(weather, view, 0)
            light = [float(luminance(linear(shown.weather).reshape(-1, 3)).mean()) for shown in (thin, full)]
            spots = [_spots(shown.alpha) for shown in (thin, full)]
            yield Record.judged(
                f"{name}, {intensity:g} mm/h, at most {most:,} seen: mean light against the unthinned run",
                100 * abs(light[0] / light[1] - 1),
                "%",
                "<= 1",
                error=100 * (spots[0] / max(spots[1], 1) - 1),
                error_unit=f"% more spots ({spots[0]} for {spots[1]})",
                source=f"{len(weather.history):,} particles; unthinned: all that the cameras may see, at any distance",
            )


def _flicker(prepared: PreparedScene, path: Cameras, view: Cameras, frames: int) -> Iterator[Record]:
    for name in ("fog", "sandstorm"):
        kind = replace(effect(name), timeline=Timeline())
        weather = _weather(prepared, kind, path, frames + 1)
        light = [float(linear(weather.render_frame(view, frame).rgb.clamp(0, 1)).mean()) for frame in range(frames + 1)]
        steps = np.abs(np.diff(light)) / np.mean(light)
        yield Record.judged(
            f"{name}: greatest change of the mean light from frame to frame",
            float(steps.max()),
            "of it",
            "<= 0.01",
            source=f"{frames} frames of the demo at 25 frames per second, still camera",
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
