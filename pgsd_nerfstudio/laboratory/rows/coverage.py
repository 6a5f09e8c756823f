"""Figures of what flying particles cover, by their distance from the camera, against rays through solid bodies."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import torch

from pgsd_nerfstudio.dynamics.in_sight import Eye, faded_in, fading_in
from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.solid_coverage import Ellipsoids, solid_coverage
from pgsd_nerfstudio.laboratory.visibility import weather_along
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene, prepare_scene

SIZE = (192, 128)  # pixels
BINS = (0.0, 1.0, 2.0, 4.0, 8.0, float("inf"))  # m from the camera
FACTOR = 1.5
FRAME = 1


def by_distance(quick: bool) -> Iterator[Record]:
    """Snow and rain of the demo at a legibility of 1."""
    prepared = prepare_scene(demo_scene(), "cpu")
    for name, intensity, times in (("snowfall", 1.5, 1), ("rainfall", 20.0, 8)):
        yield from _by_distance(prepared, name, intensity, times, 64 if quick else 256)


def _by_distance(prepared: PreparedScene, name: str, intensity: float, times: int, samples: int) -> Iterator[Record]:
    """Mean alpha of the particles of each bin alone against what their bodies take of rays.

    The bodies are ellipsoids whose longest axis is the particle's diameter, as flat as its Gaussian, and take of a ray what the
    Gaussian's peak does: flakes are lace. A Gaussian's shadow is that of an ellipsoid whose semi-axes are sqrt(2) of its
    standard deviations, which is 0.96 of a flake's and 1.02 of a drop's radius; so 0.93 and 1.04 of the area are expected. The
    fade at the end of a particle's reach and before the lens is in both.
    """
    scene = prepared.scene
    path = slow_path(scene, frames=50)
    weather = weather_along(prepared, effect(name, intensity=intensity).with_legibility(1.0), path, FRAME + 1)
    view = path[25].resized(*SIZE)
    eye = Eye.of(view, prepared.rasterizer.config, scene.frame)
    instant = next(weather.sequence.frames(FRAME, FRAME + 1))
    flying = torch.arange(len(instant.active))
    air = faded_in(instant, weather.history.reaches, eye).select(flying)
    peaks, center = instant.gaussians.opacities[flying], torch.from_numpy(eye.center).float()
    fades = fading_in(air.means, weather.history.reaches[instant.active], air.scales.amax(1), center)
    axes = 0.5 * weather.history.diameters[instant.active, None] * air.scales / air.scales.amax(1, keepdim=True)
    moved = torch.zeros_like(air.means) if air.displacements is None else air.displacements
    bodies = Ellipsoids(air.means, air.quats, axes, peaks * fades, moved)
    distance, metric = (air.means - center).norm(dim=1), scene.frame.cameras_to_metric(view)
    for low, high in itertools.pairwise(BINS):
        there = ((distance >= low) & (distance < high) & (fades > 0)).nonzero()[:, 0]
        drawn = _mean_alpha(air.select(there), prepared, view)
        solid, error = solid_coverage(bodies.select(there), metric, samples, times)
        apart = max(drawn / max(solid, 1e-12), solid / max(drawn, 1e-12))
        where = f"at {low:g}-{high:g} m" if high < BINS[-1] else f"beyond {low:g} m"
        yield Record.judged(
            f"{name}, {intensity:g} mm/h: coverage {where} of the camera",
            apart, "times off", f"<= {FACTOR:g}", error=100 * error / max(solid, 1e-12), error_unit="% standard error",
            source=f"{100 * drawn:.4f} % drawn at {SIZE[0]}x{SIZE[1]}, {100 * solid:.4f} % by {samples} rays a pixel through "
            "ellipsoids of the particles' diameters that take what the Gaussians' peaks take; "
            f"{len(there):,} particles of a mean peak of {float(peaks[there].mean()):.2f}",
        )  # fmt: skip


def _mean_alpha(air: Gaussians, prepared: PreparedScene, view: Cameras) -> float:
    """Mean alpha of particles alone; in metres, the view in scene units."""
    rasterizer = CpuRasterizer(Gaussians.empty(), config=prepared.rasterizer.config)
    return float(rasterizer.render(view, prepared.scene.frame.gaussians_to_scene(air)).accumulation.double().mean())
