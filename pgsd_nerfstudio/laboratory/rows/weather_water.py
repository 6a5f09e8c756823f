"""Figures of water on surfaces: waves, what they mirror, what stands and drips, and what all of it costs in a picture."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.integrate import quad
from scipy.special import j1
from torch import Tensor

from pgsd_nerfstudio.effects import RAINFALL
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Clock, domain_of, simulate_metric
from pgsd_nerfstudio.physics.ground.drips import DIAMETER, Drips
from pgsd_nerfstudio.physics.ground.standing_water import StandingWater
from pgsd_nerfstudio.physics.laws.populations import MM_PER_HOUR
from pgsd_nerfstudio.physics.laws.water_waves import VISCOSITY, frequency, transform
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.moment import Viewpoint
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.light import mirrored
from pgsd_nerfstudio.response.mirrored_scene import MirroredScene
from pgsd_nerfstudio.response.prepare import answer_of, sky_of, to_metric
from pgsd_nerfstudio.response.puddles import reflected
from pgsd_nerfstudio.response.ripples import DEPTH, SPREADS, Ripples
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, surface_of

WATER = 1.333  # index of refraction at 20 degrees Celsius, 589 nm
MILLIMETRES = (0.1, 1.0, 10.0, 50.0)  # of rain
PLANE = 0.02  # m above the ground below which the mirrored picture shows nothing, since it is the mirror
NEAR = 4.0  # m from the middle of the courtyard to the farthest water that is compared
SIDE = 512  # pixels of the pictures whose cost is measured


def rows(quick: bool) -> Iterable[Record]:
    """Waves, mirror and balance of water; `quick` simulates fewer drops."""
    scene = demo_scene()
    surface = surface_of(scene, CpuRasterizer(scene.gaussians), progress=False)
    yield _rings()
    yield _slowest_wave()
    yield _fresnel()
    yield from _balance(scene, surface, quick)
    yield _mirror(scene, surface)


def _rings() -> Record:
    """Slopes that a picture takes from its tables, against the integral of Cauchy and Poisson in float64."""
    worst = 0.0
    for number, spread in enumerate(SPREADS):
        ripples = Ripples(np.zeros(1), np.zeros((1, 2)), np.ones(1), np.array([number]))
        for seconds in (0.0333, 0.1017, 0.3121, 0.611):
            radii = np.linspace(0.004, 0.2, 50)
            # The slope is clipped for a crater of 1 m, so the crater is small.
            small = replace(ripples, depths=np.full(1, 1e-5))
            found = small.slopes(np.stack([radii, np.zeros(50)], 1), seconds)[:, 0] / 1e-5
            exact = np.array([_slope(r, seconds, spread) for r in radii])
            worst = max(worst, float(np.abs(found - exact).max() / np.abs(exact).max()))
    return Record.judged(
        "rings of drops: slope at 0.03-0.6 s and 0.4-20 cm", 100 * worst, "% of the steepest, worst", "<= 1",
        source="integral of Cauchy and Poisson with the dispersion of Lamb (1932), adaptive quadrature in float64",
    )  # fmt: skip


def _slope(radius: float, seconds: float, spread: float) -> float:
    def integrand(k: float) -> float:
        at = np.array([k])
        moving = math.cos(float(frequency(at, DEPTH)[0]) * seconds) * math.exp(-2 * VISCOSITY * k**2 * seconds)
        return -k * float(transform(at, spread)[0]) * k * j1(k * radius) * moving

    return quad(integrand, 0.0, 8 / spread, limit=2000, epsabs=1e-9)[0]


def _slowest_wave() -> Record:
    k = np.geomspace(50, 5000, 20_001)
    speed = float((frequency(k, 1.0) / k).min())
    return Record.judged(
        "least phase speed of waves on deep water, apart from 23.2 cm/s", 100 * abs(speed / 0.232 - 1), "%", "<= 1",
        source="Lamb, Hydrodynamics, section 267",
    )  # fmt: skip


def _fresnel() -> Record:
    angle = np.radians(np.arange(0.0, 90.0, 0.5))
    inside = np.arcsin(np.sin(angle) / WATER)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.sin(inside - angle) / np.sin(inside + angle)
        along = np.tan(angle - inside) / np.tan(angle + inside)
    exact = (across**2 + along**2) / 2
    exact[0] = ((WATER - 1) / (WATER + 1)) ** 2
    found = mirrored(torch.from_numpy(np.cos(angle))).numpy()
    return Record.judged(
        "light that water mirrors, 0-89.5 degrees", float(np.abs(found - exact).max()), "worst error of the share", "<= 0.002",
        source="Fresnel's formulas in sines and tangents, n = 1.333, float64",
    )  # fmt: skip


def _balance(scene: Scene, surface: SurfaceMesh, quick: bool) -> Iterable[Record]:
    """Water that has fallen, against what stands, clings, drips and has run off."""
    domain, response = domain_of(scene), RAINFALL.surface
    ground = StandingWater.of(surface, domain, unevenness=response.unevenness)
    fallen = [metres * 1e-3 for metres in MILLIMETRES]
    pools = [ground.after(metres) for metres in fallen]
    lost = max(abs(p.held + p.ran_off - m * ground.area) / (m * ground.area) for p, m in zip(pools, fallen, strict=True))
    yield Record.judged(
        "standing water: neither held nor run off, of what fell", lost, "worst share", "<= 1e-12",
        source=f"demo, {MILLIMETRES[0]:g}-{MILLIMETRES[-1]:g} mm of rain, {len(ground.into)} hollows",
    )  # fmt: skip
    drips, drop = Drips.of(surface, domain), math.pi / 6 * DIAMETER**3
    rate = RAINFALL.emission.intensity * MM_PER_HOUR / 1000
    hanging = drips.areas * 1e-4 / drop - drips.dripped(1e-4, rate)
    some = drips.dripped(1e-4, rate) > 0
    yield Record.judged(
        "drips: water that hangs at an edge after 0.1 mm of rain", float(hanging[some].max()), "drops at most", "< 1",
        source=f"demo, {len(drips.areas)} edges; what came to an edge has dripped or hangs there",
    )  # fmt: skip
    clock = Clock(frames=50 if quick else 100)
    run = simulate_metric(surface, RAINFALL, clock, domain, max_particles=5_000 if quick else 20_000, progress=False)
    brought = run.about["water_deposited_kg"] + run.about["water_missed_kg"]
    expected = rate * 1000 * domain.area * (clock.frames - 1) / clock.fps
    yield Record.judged(
        "rain that fills puddles, apart from the water of drops in the wetness grid",
        100 * abs(brought / expected - 1), "%", "<= 10",
        source="demo, RAINFALL; splash droplets that are still in the air and drips, which are counted above, are not in it",
    )  # fmt: skip


def _mirror(scene: Scene, surface: SurfaceMesh) -> Record:
    """Rays on the surface mesh against the picture of a camera that is mirrored in the ground."""
    metric = to_metric(scene)
    camera = scene.frame.cameras_to_metric(scene.cameras[3].resized(240, 160))
    mirror = torch.diag(torch.tensor([1.0, 1, -1, 1])).to(camera.viewmats)
    below = replace(camera, viewmats=camera.viewmats @ mirror)
    above = metric.means[:, 2] > PLANE
    with torch.no_grad():
        expected = CpuRasterizer(metric.select(above)).render(below)
    points, towards, seen = _on_ground(camera)
    up = torch.tensor([0.0, 0, 1]).expand(len(points), 3)
    mirrored_scene = MirroredScene.of(
        metric, surface, scene.frame.to_metric(scene.cameras.centers[:1].float())[0], sky_of(scene, metric)
    )
    found = encoded(mirrored_scene.seen(points, reflected(towards, up), None, 0.0))
    covered = expected.accumulation[0].reshape(-1)[seen] > 0.98
    error = (found - expected.rgb[0].reshape(-1, 3)[seen])[covered].clamp(-1, 1)
    return Record.judged(
        "mirrored scene on a flat puddle: rays on the mesh against a mirrored camera",
        -10 * math.log10(float(error.square().mean())), "dB", ">= 18",
        source=f"demo, camera 3, 240x160, {int(covered.sum())} pixels of ground within {NEAR:g} m",
    )  # fmt: skip


def _on_ground(camera: Cameras) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Tensor]:
    """Where rays of a camera in metres meet the ground, unit vectors back to it, and the numbers of their pixels."""
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    K, rotation = camera.Ks[0].float(), camera.viewmats[0, :3, :3].float()
    ahead = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1).reshape(-1, 3)
    rays = torch.nn.functional.normalize(ahead @ rotation, dim=1)
    center = camera.centers[0].float()
    length = -center[2] / rays[:, 2]
    points = center + length[:, None] * rays
    seen = ((length > 0) & (points[:, :2].norm(dim=1) < NEAR)).nonzero()[:, 0]
    return points[seen], -rays[seen], seen


def costs(quick: bool) -> Iterable[Record]:
    """CPU time that water adds to a picture of 512 x 512 pixels; `quick` simulates fewer drops."""
    scene = demo_scene()
    surface = surface_of(scene, CpuRasterizer(scene.gaussians), progress=False)
    clock, domain = Clock(frames=50), domain_of(scene)
    run = simulate_metric(surface, RAINFALL, clock, domain, max_particles=5_000 if quick else 20_000, progress=False)
    answer = answer_of(scene, surface, RAINFALL, seconds=2.0)
    view = Viewpoint.of(scene.cameras[3].resized(SIDE, SIDE), 0, scene.gaussians.means)
    plain = replace(answer, puddles=None)
    base = _colours(plain, scene, view)
    for name, off in (
        ("puddles, ripples and mirror", ""),
        ("puddles and mirror without ripples", "ripples"),
        ("film alone", "puddles"),
    ):
        response = replace(RAINFALL.surface, **({off: False} if off else {}))
        yield Record(
            f"{name}: colours of a view", 1000 * (_colours(_struck(answer, run, response), scene, view) - base), "ms CPU",
            source="demo, camera 3; more than with the even sky mirrored, least of 7 times",
        )  # fmt: skip
    moment = _struck(answer, run, RAINFALL.surface).at(1.9)
    assert moment is not None
    found = moment.adds(view)
    yield Record(
        f"rings and crowns near a camera: {0 if found is None else len(found):,} Gaussians",
        1000 * _least(lambda: moment.adds(view)), "ms CPU", source="demo, camera 3, without their blending",
    )  # fmt: skip


def _struck(answer: Answer, run: ParticleHistory, response: object) -> Answer:
    assert answer.puddles is not None
    effect = replace(RAINFALL, surface=response)
    return replace(answer, effect=effect, puddles=replace(answer.puddles, effect=effect)).struck_by(run)


def _colours(answer: Answer, scene: Scene, view: Viewpoint) -> float:
    """Seconds of CPU time of the colours of what a view sees, each time at another moment."""
    frozen = scene.gaussians
    at = (torch.cat([frozen.means, torch.ones(len(frozen), 1)], 1) @ view.viewmat.T)[:, :3]
    pixel = (at @ view.K.T)[:, :2] / at[:, 2:]
    ids = ((at[:, 2] > 0) & (pixel > 0).all(1) & (pixel < SIDE).all(1)).nonzero()[:, 0]
    rgb = linear(torch.full((len(ids), 3), 0.5))
    moments = iter(np.linspace(1.0, 1.9, 8))

    def one() -> None:
        moment = answer.at(float(next(moments)))
        assert moment is not None
        moment.frozen_colors(rgb, frozen.means[ids], ids, view)

    return _least(one)


def _least(work: Callable[[], object], times: int = 7) -> float:
    spent = []
    work()
    for _ in range(times):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)
