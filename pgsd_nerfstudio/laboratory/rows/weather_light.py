"""Figures of light and cover in pictures: gaps in foliage, skies, the layer of snow, airlight near walls, sun under clouds.

The demo's true mesh and depths judge what lies where; a path tracer's figures of the same courtyard judge the light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy.spatial import KDTree

from pgsd_nerfstudio.effects.appearance import initial_look
from pgsd_nerfstudio.effects.effect import effect
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import weather_clouds
from pgsd_nerfstudio.physics import Clock, domain_of, simulate_metric
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.airlight import thinned
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.haze_field import full_extinction
from pgsd_nerfstudio.response.landed import in_place
from pgsd_nerfstudio.response.layer_making import layer_of
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.response.prepare import composed, sky_of, softening_of, to_metric
from pgsd_nerfstudio.response.sky import sky_share
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_depth, demo_scene
from pgsd_nerfstudio.scene.frame import attention
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of

SECONDS = 10.0
VIEW = 3  # camera of the demo that sees table, wall, hedge and sky
GAP = 0.16  # share of the light that the bush lets through
PATH_TRACED = ((3.2, 0.048), (4.1, 0.035), (5.8, 0.055), (8.5, 0.121), (9.9, 0.156))
"""Airlight relative to the sky at distances in metres, before a black courtyard in fog of a visibility of 60 m: path tracing
(Mitsuba 3.9.1, 256 samples, 48 bounces, Henyey & Greenstein's phase function of g = 0.85)."""
TABLE = 0.75  # m above the ground
NEAR = 0.01  # m


def rows(quick: bool) -> Iterator[Record]:
    """All rows; `quick` simulates fewer flakes."""
    scene = demo_scene()
    rasterizer = choose_rasterizer(scene.gaussians, "cpu")
    surface, metric, snow = surface_of(scene, rasterizer, progress=False), to_metric(scene), effect("snowfall")
    exposure = Exposure.of(metric, surface, snow)
    softening = softening_of(metric, exposure, surface, snow, sky_of(scene, metric))
    layer = layer_of(scene, metric, surface, snow)
    answer = composed(scene, snow, exposure, softening, layer=layer)
    yield _bush(scene)
    yield from _sphere(scene)
    yield from _layer(scene, answer)
    yield from _landed(scene, surface, answer, quick)
    yield _over_sky(scene, answer)
    yield _airlight()
    yield from weather_clouds.rows(metric, softening, quick)


def _bush(scene: Scene) -> Record:
    """Light of a dark bush with gaps before a black background, in rain and without weather."""
    unit = scene.frame.metres_per_unit
    one = Gaussians(
        torch.tensor([[0.0, 0.0, 3.0 / unit]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 3.0),
        torch.tensor([1 - GAP]),
        torch.full((1, 3), 0.35),
    )
    alone = replace(scene, gaussians=one)
    loose = Exposure(torch.tensor([[0.0, 0, 1]]), torch.ones(1, dtype=torch.bool), *torch.tensor([[0.4], [0.3], [0.8]]))
    camera = Cameras(torch.eye(4)[None], torch.tensor([[[40.0, 0, 8.5], [0, 40, 8.5], [0, 0, 1]]]), 17, 17)
    rasterizer = CpuRasterizer(one)
    clear, rain = (
        float(luminance(linear(rasterizer.render(camera, None, None, moment).rgb[0, 8, 8])[None]))
        for moment in (None, composed(alone, effect("rainfall"), loose).at(2.0))
    )
    return Record.judged(
        f"rain: light of a dark bush with gaps of {GAP:.0%}, against without weather", rain / clear, "times", "<= 1",
        source=f"{clear:.3f} clear and {rain:.3f} in rain, linear; black background, 3 m from the lens",
    )  # fmt: skip


def _sphere(scene: Scene) -> Iterator[Record]:
    """A sphere of bright blue Gaussians 300 m around the demo."""
    generator, count, radius = torch.Generator().manual_seed(0), 1500, 300.0 / scene.frame.metres_per_unit
    means = radius * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    frozen = scene.gaussians
    colors = frozen.colors.new_zeros(count, *frozen.colors.shape[1:])
    (colors if colors.ndim == 2 else colors[:, 0])[:] = torch.tensor([1.0, 1.2, 1.5])
    dome = Gaussians(
        means, torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count, 3), 0.1 * radius), torch.ones(count), colors
    )
    around = replace(scene, gaussians=concatenate([frozen, dome]))
    metric = to_metric(around)
    _, distance = attention(scene.cameras, frozen)
    share = sky_share(metric, scene.frame.to_metric(scene.cameras.centers), distance * scene.frame.metres_per_unit)
    yield Record.judged(
        "sky: Gaussians of a sphere at 300 m that answer as sky", float(share[-count:].mean()), "of all", ">= 0.99",
        source=f"{count} Gaussians around the demo",
    )  # fmt: skip
    near = to_metric(scene).means.norm(dim=1) < 15
    yield Record.judged(
        "sky: Gaussians of the demo's courtyard that answer as sky", float((share[: len(near)][near] > 0).float().mean()),
        "of all", "<= 0", source=f"{int(near.sum()):,} Gaussians within 15 m",
    )  # fmt: skip


def _layer(scene: Scene, answer: Answer) -> Iterator[Record]:
    """The table from above, bare and under snow; height of the layer over the table."""
    assert scene.mesh is not None and answer.layer is not None
    side, above = 96, 2.2
    turn = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    eye = scene.frame.to_scene(torch.tensor([0.0, 0.0, TABLE + above]))
    pose = torch.eye(4)
    pose[:3, :3] = turn @ scene.frame.rotation
    pose[:3, 3] = -pose[:3, :3] @ eye
    focal = 0.5 * side * above / 0.35
    camera = Cameras(pose[None], torch.tensor([[[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]]]), side, side)
    rasterizer = CpuRasterizer(scene.gaussians)
    dry = replace(answer, haze=None)
    bare, white = (
        luminance(linear(rasterizer.render(camera, None, None, m).rgb[0].view(-1, 3))) for m in (None, dry.at(SECONDS))
    )
    # The vase and its shelter are in the middle of the picture.
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    open_table = (((x - side / 2) ** 2 + (y - side / 2) ** 2).sqrt() > 0.65 * side / 2).view(-1)
    rough = [float(light[open_table].std() / light[open_table].mean()) for light in (bare, white)]
    yield Record.judged(
        "snow: deviation of the light of a table under it, relative to its mean", rough[1], "", "<= 0.1",
        source=f"demo from above after {SECONDS:g} s; planks and seams of the bare table deviate by {rough[0]:.2f}",
    )  # fmt: skip
    there, _, thickness = answer.layer.grown(answer.effect, SECONDS)
    at = answer.layer.points[there]
    on = (at[:, :2].norm(dim=1) < 0.6) & ((at[:, 2] - TABLE).abs() < 0.06)
    yield Record(
        "snow: thickness of the layer on a table", 100 * float(thickness[on].median()), "cm",
        source=f"median of {int(on.sum())} pieces after {SECONDS:g} s of snowfall in its time lapse of "
        f"{answer.effect.surface.accumulation_speedup:g}",
    )  # fmt: skip
    view = scene.cameras[VIEW].resized(192, 128)
    moment = answer.at(SECONDS)
    seen = luminance(linear(rasterizer.render(view, None, None, moment).rgb[0].view(-1, 3))).view(128, 192)
    sky, snow = seen[:16].median(), seen[100:].quantile(0.5)
    yield Record.judged(
        "snow: light of the sky above it relative to that of the snow", float(sky / snow), "times", ">= 0.7",
        source="medians of the upper eighth and the lower fifth of a picture of the demo, linear; path tracing gives 0.91",
    )  # fmt: skip


def _landed(scene: Scene, surface: SurfaceMesh, answer: Answer, quick: bool) -> Iterator[Record]:
    """What is drawn of landed snow against the true mesh: pieces of the layer and visible flakes, by area times opacity."""
    assert scene.mesh is not None and answer.layer is not None
    true = SurfaceMesh(scene.frame.to_metric(scene.mesh[0]), scene.mesh[1])
    there, shown, _ = answer.layer.grown(answer.effect, SECONDS)
    places, weights = answer.layer.points[there], shown * answer.layer.spacing[there] ** 2
    away = true.closest(places).distance
    for metres, target in ((NEAR, "<= 0.3"), (0.05, "<= 0.01")):
        far = float(weights[away > metres].sum() / weights.sum())
        yield Record.judged(
            f"snow: layer more than {100 * metres:g} cm from the true mesh", far,
            "of its area", target,
            source=f"{len(there):,} pieces on the demo's fused surface, of which {_share(surface, true, metres):.0%} of the "
            "vertices are as far; the true mesh leaves out grass and ivy",
        )  # fmt: skip
    snow = replace(answer.effect, dense=None)
    run = simulate_metric(
        surface,
        snow,
        Clock(frames=50 if quick else 125),
        domain_of(scene),
        max_particles=4000 if quick else 20_000,
        progress=False,
    )
    metric = to_metric(scene)
    look = in_place(initial_look(snow, run), run, answer, metric)
    ids = run.collided.nonzero()[:, 0]
    before = initial_look(snow, run).collided_at(run, run.frames - 1, ids)
    after = look.collided_at(run, run.frames - 1, ids)
    # The mesh leaves out grass and ivy, but not the Gaussians, which are as exact.
    solid = metric.means[metric.opacities > 0.5]
    foot = run.rest_positions[ids].clone()
    foot[:, 2] -= run.rest_covers[ids]
    beside, _ = KDTree(solid.numpy()).query(foot.numpy())
    distance = torch.minimum(true.closest(foot).distance, torch.from_numpy(beside).float())
    area = [v.opacity * v.scales[:, 0] * v.scales[:, 1] for v in (before, after)]
    floating = distance > 0.05
    before_all, after_all = (float(each.sum()) for each in area)
    before_off, after_off = (float(each[floating].sum()) for each in area)
    yield Record.judged(
        "snow: drawn of flakes that landed more than 5 cm from anything of the demo", after_off / before_all,
        "of all landed", "<= 0.02",
        source=f"area times opacity of {len(ids):,} flakes; else {before_off / before_all:.1%}. The layer and "
        f"places that hold nothing have taken {1 - after_all / before_all:.0%} of all",
    )  # fmt: skip


def _share(surface: SurfaceMesh, true: SurfaceMesh, metres: float) -> float:
    return float((true.closest(surface.vertices).distance > metres).float().mean())


def _over_sky(scene: Scene, answer: Answer) -> Record:
    """Pixels that show the sky and that landed snow whitens, in six views of the demo without haze and change of light."""
    cameras = scene.cameras[torch.arange(0, 36, 6)].resized(192, 128)
    sky = torch.isinf(demo_depth(cameras))
    # Leaves and grass are not in the mesh's every pixel: only what is sky all around counts.
    near = torch.nn.functional.max_pool2d((~sky).float()[:, None], 9, stride=1, padding=4)[:, 0] > 0
    only = sky & ~near
    bare = replace(answer.effect, ambience=None)
    moment = replace(answer, effect=bare, haze=None, softening=None).at(SECONDS)
    rasterizer = CpuRasterizer(scene.gaussians)
    change = rasterizer.render(cameras, None, None, moment).rgb - rasterizer.render(cameras).rgb
    white = (change.mean(3) > 0.04) & only
    return Record.judged(
        "snow: pixels of the sky that landed snow whitens", float(white.sum() / only.sum()), "of all", "<= 0.001",
        source=f"by more than 0.04 of the display's range, 4 pixels or more from any true surface; {int(only.sum()):,} pixels",
    )  # fmt: skip


def _airlight() -> Record:
    """Airlight before near dark walls against path tracing."""
    fog = effect("fog", intensity=60.0)
    metres = torch.tensor([m for m, _ in PATH_TRACED])
    depth = full_extinction(fog) / max(fog.haze.amount if fog.haze else 1.0, 1e-6) * metres
    found, plain = -torch.expm1(-thinned(depth, metres, fog)), -torch.expm1(-depth)
    expected = torch.tensor([a for _, a in PATH_TRACED])
    worst = float((found / expected).log2().abs().max())
    return Record.judged(
        "fog: airlight before walls at 3-10 m, against path tracing", worst, "stops, worst", "<= 1.05",
        source=f"{', '.join(f'{v:.2f}' for v in found)} against {', '.join(f'{v:.2f}' for v in expected)} of the sky's light; "
        f"Koschmieder's law gives {', '.join(f'{v:.2f}' for v in plain)}",
    )  # fmt: skip
