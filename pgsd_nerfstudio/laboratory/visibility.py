"""How visible weather is in pictures of any scene: what flying particles change, whether it flickers, whether it starts clear.

A pixel is changed by flying particles if it differs by more than CHANGED from the same picture without them; landed particles
and the scene's answer are in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.dynamics.in_sight import Eye, faded_in
from pgsd_nerfstudio.effects import EFFECTS, Effect, effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Clock, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import surface_of
from pgsd_nerfstudio.weather.adapting import adapted
from pgsd_nerfstudio.weather.making import answer_to
from pgsd_nerfstudio.weather.options import SimulationOptions
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene
from pgsd_nerfstudio.weather.weather import Weather

CHANGED = 0.03  # of the range of display values: eight steps of 8 bits, which one sees
WANTED = {"snowfall": (1.5, 5.0, 20.0), "rainfall": (20.0, 10.0, 40.0)}  # mm/h; least and greatest % of changed pixels
FLICKER = 0.01  # share of the mean light by which it may change from frame to frame
FPS = 25.0


@dataclass(frozen=True)
class Shown:
    """Pictures of one moment in display values, and the flying layer alone."""

    weather: Float[Tensor, "h w 3"]
    without: Float[Tensor, "h w 3"]
    """The same without what flies."""
    alpha: Float[Tensor, "h w"]
    """Of what flies."""

    @property
    def changed(self) -> float:
        """Share of the pixels that flying particles change, 0..1."""
        return float(((self.weather - self.without).abs().amax(-1) > CHANGED).float().mean())


def weather_along(
    prepared: PreparedScene, kind: Effect, path: Cameras, frames: int, sharpness: float | None = None, most: int = 100_000
) -> Weather:
    """A weather as cameras see it; its motion is not kept in the cache.

    Args:
        prepared: the scene.
        kind: the effect, which follows the scene where nobody asked for a number.
        path: the cameras, in scene units.
        frames: how many are simulated.
        sharpness: as for `simulate_metric`.
        most: particles seen at once.
    """
    scene, kind = prepared.scene, adapted(kind, prepared)[0]
    surface = surface_of(scene, prepared.rasterizer, progress=False)
    history = simulate_metric(
        surface,
        kind,
        Clock(FPS, frames),
        domain_of(scene),
        max_particles=most,
        cameras=scene.frame.cameras_to_metric(path),
        sharpness=sharpness,
        progress=False,
    )
    options = SimulationOptions(seconds=frames / FPS)
    answer = answer_to(prepared, surface, kind, options).struck_by(history)
    return Weather(prepared, kind, options, history, answer.beside(history.about["sharpness"]))


def shown(weather: Weather, view: Cameras, frame: int) -> Shown:
    """One camera's pictures of a frame with and without what flies.

    Args:
        weather: with its simulated motion and initial look.
        view: one camera in scene units.
        frame: number of the frame.
    """
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
    return Shown(pictures[0], pictures[1], (layers[0] - layers[1]).mean(-1))


def _alone(prepared: PreparedScene, air: Gaussians, view: Cameras, grey: float) -> Float[Tensor, "h w 3"]:
    """The scene with flying particles of one grey, without light and haze; the difference of white and black is their alpha."""
    painted = replace(air, colors=torch.full_like(air.colors, grey))
    return prepared.rasterizer.render(view, painted, None, None).rgb[0]


def changed_rows(prepared: PreparedScene, path: Cameras, view: Cameras, instants: Sequence[int]) -> Iterator[Record]:
    """Shares of pixels that flying snow and rain change; at the default legibility they are judged.

    Args:
        prepared: the scene.
        path: cameras in scene units for which the weather is simulated.
        view: the one that is shown.
        instants: frames over which shares are averaged.
    """
    for name, (intensity, low, high) in WANTED.items():
        own, factor = effect(name, intensity=intensity), 0.0
        for kind in (own, own.with_legibility(1.0)):
            if factor == 1:
                continue  # the default is nature's own
            weather, asked = weather_along(prepared, kind, path, instants[-1] + 1), kind is own
            factor = weather.effect.appearance.area_factor
            found = 100 * float(np.mean([shown(weather, view, frame).changed for frame in instants]))
            yield Record(
                f"{name}, {intensity:g} mm/h, {prepared.scene.name}: pixels that flying particles change, "
                f"{factor:g} times their area",
                found,
                "%",
                target=f">= {low:g}" if asked else None,
                holds=low <= found <= high if asked else None,
                source=f"wanted {low:g}-{high:g} %; changed: by more than {CHANGED:g} of the range, "
                f"{view.width}x{view.height} pixels",
            )


def flicker_rows(prepared: PreparedScene, path: Cameras, view: Cameras, frames: int) -> Iterator[Record]:
    """Greatest changes of the mean light from frame to frame in full fog and in a full sandstorm.

    Args:
        prepared: the scene.
        path: cameras in scene units for which the weather is simulated.
        view: the one that is shown.
        frames: how many changes are looked at.
    """
    for name in ("fog", "sandstorm"):
        kind = replace(effect(name), timeline=Timeline())
        weather = weather_along(prepared, kind, path, frames + 1)
        light = [float(linear(weather.render_frame(view, frame).rgb.clamp(0, 1)).mean()) for frame in range(frames + 1)]
        steps = np.abs(np.diff(light)) / np.mean(light)
        yield Record.judged(
            f"{name}, {prepared.scene.name}: greatest change of the mean light from frame to frame",
            float(steps.max()),
            "of it",
            f"<= {FLICKER:g}",
            source=f"{frames} frames at {FPS:g} frames per second, still camera",
        )


def clear_row(prepared: PreparedScene, path: Cameras, view: Cameras) -> Record:
    """Pictures at second 0 of all effects that start clear against the picture without weather.

    Args:
        prepared: the scene.
        path: cameras in scene units for which the weather is simulated.
        view: the one that is shown.
    """
    differ = 0
    for each in EFFECTS.values():
        clear = replace(each, timeline=replace(each.timeline, onset=max(each.timeline.onset, 2.0)))
        weather = weather_along(prepared, clear, path, 2)
        differ += int((weather.render_frame(view, 0).rgb != weather.render_clear(view).rgb).sum())
    return Record.judged(
        f"second 0 of weather that starts clear, {prepared.scene.name}: values that differ from the untouched scene",
        float(differ),
        "",
        "== 0",
        source=", ".join(EFFECTS),
    )
