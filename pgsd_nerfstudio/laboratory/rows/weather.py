"""Figures of weather in pictures against laws: fog, snow on surfaces, the first second, the sun. `weather_ground` has those of
motion and landings, `weather_air` of what flies, `weather_light` those of light and cover."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from pgsd_nerfstudio.effects.effect import EFFECTS, effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import motion_costs as rows_motion_costs
from pgsd_nerfstudio.laboratory.rows import weather_air as rows_weather_air
from pgsd_nerfstudio.laboratory.rows import weather_ground as rows_weather_ground
from pgsd_nerfstudio.laboratory.rows import weather_light as rows_weather_light
from pgsd_nerfstudio.laboratory.rows import weather_water as rows_weather_water
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.rendering.medium import Medium
from pgsd_nerfstudio.rendering.moment import Gaps, Viewpoint
from pgsd_nerfstudio.rendering.reference import render_reference
from pgsd_nerfstudio.response.coating import Coating
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.haze_field import HazeField
from pgsd_nerfstudio.response.prepare import composed, sun_of, to_metric
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.courtyard.baking import SUN
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of

VISIBILITIES = (20.0, 50.0, 200.0)  # m
SECONDS = 10.0


def verify(quick: bool) -> list[Record]:
    """All rows of the weather; `quick` takes fewer rays and particles."""
    scene = demo_scene()
    assert scene.mesh is not None
    surface = SurfaceMesh(scene.frame.to_metric(scene.mesh[0]), scene.mesh[1])
    return [
        *_fog(scene),
        *_patchy(scene, quick),
        *_layers(scene, surface),
        *_first_second(scene, surface),
        _sun(scene),
        *rows_weather_air.rows(quick),
        *rows_weather_ground.rows(quick),
        *rows_weather_light.rows(quick),
        *rows_weather_water.rows(quick),
    ]


def bench(quick: bool) -> list[Record]:
    """Costs of weather; `quick` takes one second of few particles."""
    return [*rows_motion_costs.costs(quick), *rows_weather_water.costs(quick)]


def _fog(scene: Scene) -> Iterator[Record]:
    """Transmittance T of even fog before walls at 10-200 m.

    The brightness of a white wall behind black airlight is T, down to 1e-17; that of a black wall behind white airlight is
    1 - T.
    """
    for visibility in VISIBILITIES:
        worst = {"CPU rasterizer": 0.0, "float64 reference": 0.0}
        contrast = 0.0
        for metres in (10.0, 20.0, 50.0, 100.0, 200.0):
            expected = math.exp(-math.log(20.0) / visibility * metres)
            for name in worst:
                seen = _wall(scene, visibility, metres, white_wall=True, reference=name != "CPU rasterizer")
                worst[name] = max(worst[name], abs(seen / expected - 1))
                black = _wall(scene, visibility, metres, white_wall=False, reference=name != "CPU rasterizer")
                contrast = max(contrast, abs(black - (1 - expected)))
        for name, error in worst.items():
            yield Record.judged(
                f"fog, visibility {visibility:g} m: transmittance at 10-200 m, {name}",
                100 * error,
                "% worst",
                "<= 5",
                error=contrast,
                error_unit="worst error of a black wall's brightness",
                source="Beer-Lambert with the extinction ln 20 / visibility of the meteorological optical range (WMO No. 8)",
            )
        if visibility == VISIBILITIES[-1]:
            yield Record("fog: transmittance, gsplat", None, "", source="needs CUDA; it takes the same colours as the others")


def _wall(scene: Scene, visibility: float, metres: float, *, white_wall: bool, reference: bool) -> float:
    """Linear light of a white wall through even fog of black airlight, or of a black wall through white airlight.

    Args:
        scene: its frame gives the scale.
        visibility: of the fog, m.
        metres: distance of the wall.
        white_wall: which of the two walls.
        reference: render with the float64 reference rather than the CPU rasterizer.
    """
    fog = effect("fog", intensity=visibility)
    assert fog.haze is not None
    haze = replace(fog.haze, rgb=(0.0,) * 3 if white_wall else (1.0,) * 3, patchiness=0.0, scale_height=math.inf)
    even = replace(fog, haze=haze, appearance=replace(fog.appearance, active=replace(fog.appearance.active, opacity=0.5)))
    unit = scene.frame.metres_per_unit
    medium = HazeField.of(even, scene.frame, domain_of(scene)).at(0.0)
    assert medium is not None
    scales = torch.tensor([[0.4 * metres, 0.4 * metres, 0.01]]) / unit
    shade = torch.ones(1, 3) if white_wall else torch.zeros(1, 3)
    wall = Gaussians(torch.tensor([[0.0, 0.0, metres / unit]]), torch.tensor([[1.0, 0, 0, 0]]), scales, torch.ones(1), shade)
    lens = torch.tensor([[[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], lens, 17, 17)
    moment = _Air(medium)
    if reference:
        seen = render_reference(cameras, [wall], torch.full((3,), float(not white_wall)), moments=moment)
    else:
        seen = CpuRasterizer(wall).render(cameras, None, torch.full((3,), float(not white_wall)), moment)
    # One Gaussian is never quite opaque; the light behind it is subtracted, since it has nothing to do with the fog.
    share = seen.accumulation[0, 8, 8]
    through = seen.rgb[0, 8, 8] - (1 - share) * moment.seen_behind
    return float(linear(through / share).mean())


class _Air:
    """A moment whose only effect is the air's medium."""

    key = b"air"

    def __init__(self, medium: Medium) -> None:
        self.medium = medium
        self.seen_behind = torch.zeros(3)

    def altered(self, frozen: Gaussians) -> Gaussians:
        return frozen

    def frozen_colors(self, rgb: Tensor, means: Tensor, ids: Tensor, view: Viewpoint) -> Tensor:
        return self.moving_colors(rgb, means, view)

    def adds(self, view: Viewpoint) -> None:
        return None

    def moving_colors(self, rgb: Tensor, means: Tensor, view: Viewpoint) -> Tensor:
        return self.medium.through(rgb, means, view.viewmat, view.K, view.width, view.height)

    def background(self, own: Tensor, view: Viewpoint, gaps: Gaps) -> Tensor:
        self.seen_behind = self.medium.behind(own, view.viewmat, view.K, view.width, view.height, 1e4)
        return self.seen_behind


def _patchy(scene: Scene, quick: bool) -> Iterator[Record]:
    """Light through drifting patches of fog: the sum over froxels against a fine quadrature along each ray."""
    fog = effect("fog")
    field = HazeField.of(fog, scene.frame, domain_of(scene))
    camera = scene.cameras[0]
    view = Viewpoint.of(camera, 0, camera.viewmats)
    generator = torch.Generator().manual_seed(0)
    count = 300 if quick else 2000
    local = torch.rand(count, 3, generator=generator) * torch.tensor([0.8, 0.5, 0.0]) - torch.tensor([0.4, 0.25, -1.0])
    metres = 2.0 + 38.0 * torch.rand(count, 1, generator=generator)
    local = torch.nn.functional.normalize(local, dim=1) * metres / scene.frame.metres_per_unit
    points = (local - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
    medium = field.at(4.0)
    assert medium is not None
    found = medium.optical_depth(points, view.viewmat, view.K, view.width, view.height)
    start, end = (scene.frame.to_metric(p) for p in (view.center.expand(count, 3), points))
    steps = (torch.arange(400) + 0.5) / 400
    along = start[:, None] + (end - start)[:, None] * steps[:, None]
    expected = field.extinction * field.density(along.reshape(-1, 3), 4.0).reshape(count, -1).mean(1) * metres[:, 0]
    light = (torch.exp(-found) - torch.exp(-expected)).abs().max()
    thick = expected > 0.05
    worst = ((found - expected).abs() / expected)[thick].square().mean().sqrt()
    yield Record.judged(
        "fog in drifting patches: light that arrives from 2-40 m",
        100 * float(light),
        "% of the light, worst",
        "<= 5",
        error=100 * float(worst),
        error_unit="% of optical depth, rms",
        source=f"quadrature of 400 steps along {count} rays",
    )


def _layers(scene: Scene, surface: SurfaceMesh) -> Iterator[Record]:
    """Shares of the demo's upward and downward faces that a snowfall hides, over time."""
    snow, metric = effect("snowfall"), to_metric(scene)
    exposure = Exposure.of(metric, surface, snow)
    layers = Coating.of(snow, exposure, metric.means)
    shares = torch.stack([layers.hidden(float(t)) for t in torch.linspace(0, SECONDS, 51)])
    up = ~exposure.loose & (exposure.normals[:, 2] > 0.8)
    down = ~exposure.loose & (exposure.normals[:, 2] < -0.2)
    covered = shares[:, up].mean(1)
    yield Record.judged(
        "snow: smallest growth of the covered share of upward faces in 0.2 s",
        100 * float(covered.diff().min()),
        "%",
        "> 0",
        source=f"demo, {int(up.sum()):,} Gaussians on faces that look up; {covered[-1]:.0%} covered after {SECONDS:g} s",
    )
    yield Record.judged(
        "snow: covered share of faces that look down",
        100 * float(shares[-1, down].mean()),
        "%",
        "<= 2",
        source=f"demo, {int(down.sum()):,} Gaussians",
    )


def _first_second(scene: Scene, surface: SurfaceMesh) -> Iterator[Record]:
    """Pictures at second 0 of each effect with an onset against the picture without weather."""
    camera = scene.cameras[0].resized(160, 108)
    rasterizer = choose_rasterizer(scene.gaussians, "cpu")
    plain = rasterizer.render(camera).rgb
    metric, differ, later = to_metric(scene), 0, []
    for each in EFFECTS.values():
        clear = replace(each, timeline=Timeline(onset=max(each.timeline.onset, 2.0)))
        answer = composed(scene, clear, Exposure.of(metric, surface, clear))
        differ += int((rasterizer.render(camera, None, None, answer.at(0.0)).rgb != plain).sum())
        later.append(float((rasterizer.render(camera, None, None, answer.at(6.0)).rgb - plain).abs().mean()))
    yield Record.judged(
        "second 0 of weather that starts clear: values that differ from the untouched scene",
        float(differ),
        "",
        "== 0",
        source=f"{', '.join(EFFECTS)} on the demo; after 6 s they differ by {min(later):.3f}-{max(later):.3f} on average",
    )


def _sun(scene: Scene) -> Record:
    """Direction of the sun found on the surface that is fused from depth, as in captures."""
    surface = surface_of(scene, choose_rasterizer(scene.gaussians, "cpu"), progress=False)
    metric = to_metric(scene)
    sun = sun_of(metric, Exposure.of(metric, surface, effect("snowfall")), surface)
    name, source = "sun of the demo, found by its shadows", "the direction that the courtyard was baked with"
    if sun is None:
        return Record(name, None, "degrees off", holds=False, source="no sun was found")
    cosine = float(torch.tensor(sun.direction) @ torch.from_numpy(SUN).float())
    return Record.judged(name, math.degrees(math.acos(min(cosine, 1.0))), "degrees off", "<= 10", source=source)
