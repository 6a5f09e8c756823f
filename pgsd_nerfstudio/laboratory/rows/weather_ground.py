"""Figures of weather in a scene: where snow, sand and rain land, the length of a drop's streak, and the onset. Every row is
measured on a simulation of a built-in effect."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
from pgsd_nerfstudio.effects import RAINFALL, SANDSTORM, SNOWFALL, Effect, Wind
from pgsd_nerfstudio.effects.appearance import initial_look
from pgsd_nerfstudio.effects.effect import effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, domain_of, simulate_metric
from pgsd_nerfstudio.physics.bodies import DRIPPED, SLID, SPLASHED
from pgsd_nerfstudio.physics.laws.fall_speeds import rain_fall_speed
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.courtyard.masonry import HALF, LAWN_LEVEL, WALL_HEIGHT, WALL_THICKNESS
from pgsd_nerfstudio.scene.demo import FOCAL, demo_scene
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

HOUSE = (3.0, 3.0, 2.5)  # m
AROUND = Domain((-7.0, -7.0, -0.2), (7.0, 7.0, 5.0))
BESIDE = 1.0  # m of ground before and behind the house that count
DEPTH = 1e-3  # m below a solid's faces at which a point counts as inside
DISTANCE = 2.0  # m from the lens to the drop whose streak is measured
LEAN = "; dense matter left out, compiling its kernels would take the time of all"


def rows(quick: bool) -> Iterable[Record]:
    """Landings, streaks and onsets; `quick` takes fewer particles and leaves out dense matter."""
    scene = demo_scene()
    if scene.mesh is None:
        raise ValueError("the demo scene must have its exact mesh, found none")
    surface = SurfaceMesh(scene.frame.to_metric(scene.mesh[0]), scene.mesh[1])
    yield from _snow(scene, surface, quick)
    yield from _sand(quick)
    yield _water(scene, surface, quick)
    yield from _streaks()
    yield from _beginnings()


def _snow(scene: Scene, surface: SurfaceMesh, quick: bool) -> Iterable[Record]:
    """Rest positions of the flakes of a snowfall in the demo scene."""
    snow, frames = (replace(SNOWFALL, dense=None), 75) if quick else (SNOWFALL, 250)
    run = simulate_metric(surface, snow, Clock(frames=frames), domain_of(scene), progress=False)
    resting, covers = run.rest_positions[run.collided], run.rest_covers[run.collided]
    foot = resting - snow.surface.settle * rotations.unitquat_to_rotmat(run.rest_quats[run.collided].roll(-1, 1))[:, :, 2]
    foot[:, 2] -= covers
    found = surface.closest(foot)
    on = (found.distance <= 0.005).float().mean()
    of = f"{len(foot):,} landed flakes in the demo scene, exact mesh{LEAN if quick else ''}"
    yield Record.judged(
        "snow: landed flakes within 5 mm of what they lie on", float(on), "of all", ">= 0.99",
        source="rest position less the cover along z and less the settle of "
        f"{1e3 * snow.surface.settle:g} mm along the flake's normal, its distance to the mesh; {of}",
    )  # fmt: skip
    yield from _inside_walls(run)
    stop = run.offsets[1:][run.collided]
    contact, before = run.positions[stop - 1], run.positions[torch.maximum(stop - 2, run.offsets[:-1][run.collided])]
    deeper = contact[:, 2] - foot[:, 2] - covers
    yield Record.judged(
        "snow: landed flakes laid more than 2 cm deeper than where they touched", float((deeper > 0.02).float().mean()),
        "of all", "<= 0.001",
        source=f"as if they had sunk through a thin thing; {float((deeper > 0.005).float().mean()):.2%} lie more than 5 mm "
        f"deeper, where the cover they touched and its smooth height differ; {of}",
    )  # fmt: skip
    faces = ((before - foot) * found.normals).sum(1) > 0
    under = (found.normals[:, 2] < -0.2) & faces
    yield Record.judged(
        "snow: flakes at rest on faces that look down", float(under.float().mean()), "of all", "<= 0.02",
        source="normal of the mesh at their foot has z < -0.2, and they came from the side to which it points: of leaves and "
        f"blades, which are sheets, the other side is as good; {of}",
    )  # fmt: skip


def _inside_walls(run: ParticleHistory) -> Iterable[Record]:
    """Shares of positions and of sliders that are inside of the demo's walls."""
    owners = torch.repeat_interleave(torch.arange(len(run)), run.offsets.diff())
    on_way, at_rest = _in_walls(run.positions), _in_walls(run.rest_positions) & run.collided
    slid = (run.kinds & SLID) > 0
    positions = torch.cat([on_way[~slid[owners]], at_rest[run.collided & ~slid]])
    solid = f"more than {1e3 * DEPTH:g} mm inside of the blocks that the demo's two walls are modelled as"
    yield Record.judged(
        "snow: positions inside of walls", float(positions.double().mean()), "of all", "<= 0",
        source=f"{int(positions.sum())} of {len(positions):,} in the air and at rest, {solid}; sliders have a row of their own",
    )  # fmt: skip
    lost = torch.zeros_like(slid).index_put_((owners[on_way],), torch.tensor(True)) | at_rest
    count, sliders = int((lost & slid).sum()), int(slid.sum())
    yield Record.judged(
        "snow: sliders that got inside of walls", count / max(sliders, 1), "of all that slid", "<= 0",
        source=f"{count} of {sliders} at some time, {solid}",
    )  # fmt: skip


def _in_walls(points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Which points (m) are inside of the demo's two brick walls, by the numbers that the walls are modelled with."""
    ends, thick = (-HALF - WALL_THICKNESS, HALF), (HALF, HALF + WALL_THICKNESS)
    x, y, z = points.T
    north = _between(x, *ends) & _between(y, *thick)
    west = _between(x, -thick[1], -thick[0]) & _between(y, *ends)
    return (north | west) & _between(z, LAWN_LEVEL, WALL_HEIGHT)


def _between(values: Float[Tensor, " n"], low: float, high: float) -> Bool[Tensor, " n"]:
    return (values > low + DEPTH) & (values < high - DEPTH)


def _sand(quick: bool) -> Iterable[Record]:
    """Sand that lands windward and leeward of a house whose walls are square to the wind."""
    storm, frames = (replace(SANDSTORM, dense=None), 75) if quick else (SANDSTORM, 250)
    surface = _house(math.radians(storm.wind.direction_degrees))
    run = simulate_metric(surface, storm, Clock(frames=frames), AROUND, progress=False)
    ids = run.collided.nonzero()[:, 0]
    foot = run.rest_positions[ids].clone()
    foot[:, 2] -= run.rest_covers[ids]
    volume = (run.diameters[ids].double() ** 3 * run.represents[ids]).numpy()
    along, across = (_turned(foot.double(), math.radians(storm.wind.direction_degrees))[:, k].numpy() for k in (0, 1))
    height, half = foot[:, 2].numpy(), HOUSE[0] / 2
    beside = np.abs(across) < HOUSE[1] / 2
    on_wall = beside & (height > 0.05) & (height < HOUSE[2] - 0.05)
    near = {side: np.abs(side * along - half) < 0.05 for side in (-1, 1)}
    strip = {side: beside & (height < 0.05) & _off_house(side * along - half) for side in (-1, 1)}
    about = f"landed grains weighted by D^3 times the real grains each stands for{LEAN if quick else ''}"
    wall = {side: on_wall & near[side] for side in (-1, 1)}
    yield _ratio("sand: on the windward wall of a house against the leeward", wall[-1], wall[1], volume, about)
    both = {side: wall[side] | strip[side] for side in (-1, 1)}
    yield _ratio(f"sand: wall and {BESIDE:g} m of ground, windward against leeward", both[-1], both[1], volume, about, None)


def _off_house(beyond: np.ndarray) -> np.ndarray:
    return (beyond > 0) & (beyond < BESIDE)


def _ratio(
    name: str, windward: np.ndarray, leeward: np.ndarray, volume: np.ndarray, about: str, target: str | None = ">= 5"
) -> Record:
    """Ratio of the volumes that landed windward and leeward; without leeward grains, the windward count.

    Args:
        name: of the row.
        windward: [n] which grains landed windward.
        leeward: [n] which grains landed leeward.
        volume: [n] of each grain, in any unit.
        about: source of the row.
        target: comparison that judges the row; None: the row is not judged.
    """
    counts = f"{int(windward.sum()):,} grains windward, {int(leeward.sum()):,} leeward; {about}"
    if leeward.any():
        value = float(volume[windward].sum() / volume[leeward].sum())
    else:
        value, counts = float(windward.sum()), f"{counts}; none leeward, so the count against one grain"
    if target is None:
        return Record(name, value, "times", source=counts)
    return Record.judged(name, value, "times", target, source=counts)


def _house(angle: float) -> SurfaceMesh:
    """A ground of 16 m and on it a box rotated by `angle` radians; its faces point outward."""
    corners = torch.tensor([[x, y, z] for z in (0.0, HOUSE[2]) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    corners[:, :2] *= torch.tensor(HOUSE[:2])
    corners[:, :2] = _turned(corners, -angle)[:, :2]
    quads = [[0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6], [4, 5, 7, 6]]
    faces = [[q[a], q[b], q[c]] for q in quads for a, b, c in ((0, 1, 2), (0, 2, 3))]
    ground = 8.0 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    triangles = torch.tensor([*faces, [8, 9, 10], [8, 10, 11]], dtype=torch.int32)
    return SurfaceMesh(torch.cat([corners, ground]), triangles)


def _turned(points: Float[Tensor, "n 3"], angle: float) -> Float[Tensor, "n 3"]:
    """Points in axes that are rotated by `angle` radians about z."""
    cos, sin = math.cos(angle), math.sin(angle)
    x, y, z = points.T
    return torch.stack([cos * x + sin * y, cos * y - sin * x, z], 1)


def _water(scene: Scene, surface: SurfaceMesh, quick: bool) -> Record:
    """Balance of the rain that lands in the demo scene; `quick` takes only its table and the objects on it."""
    domain, frames, most = domain_of(scene), 125, 10_000
    if quick:
        domain, frames, most = Domain((-1.5, -1.5, -0.3), (1.5, 1.5, 3.0)), 40, 800
        surface = _within(surface, domain)
    run = simulate_metric(surface, RAINFALL, Clock(frames=frames), domain, max_particles=most, progress=False)
    masses = RAINFALL.material.mass(run.diameters.double()) * run.represents.double()
    down = surface.closest(run.positions[run.offsets[1:] - 1]).distance < DEPTH
    down &= (run.kinds & DRIPPED) == 0  # their water has been counted where it fell first
    droplets = ((run.kinds & SPLASHED) > 0) & ((run.kinds & DRIPPED) == 0)
    fallen, off = float(masses[down].sum()), float(masses[droplets].sum())
    found = run.about["water_deposited_kg"] + run.about["water_missed_kg"] + off
    return Record.judged(
        "rain: water that came down and is not found", 100 * abs(found / fallen - 1), "%", "<= 1",
        source=f"deposited {run.about['water_deposited_kg']:.3g} kg, splashed away {off:.3g}, missed "
        f"{run.about['water_missed_kg']:.3g}, against {fallen:.3g} kg of drops whose way ends at the demo's "
        + ("table and what stands on it" if quick else "exact mesh"),
    )  # fmt: skip


def _within(surface: SurfaceMesh, domain: Domain) -> SurfaceMesh:
    """The triangles that are entirely inside of a domain."""
    corners = surface.vertices[surface.triangles.long()]
    inside = (corners > torch.tensor(domain.lower)) & (corners < torch.tensor(domain.upper))
    return SurfaceMesh(surface.vertices, surface.triangles[inside.all(2).all(1)])


def _streaks() -> Iterable[Record]:
    """Lengths of the streaks of drops in still air: in the roll-out, and of one drop in the picture."""
    still = replace(RAINFALL, wind=Wind(speed=0.0, turbulence=0.0, flutter=0.0))
    domain = Domain((-1.0, -1.0, 0.0), (1.0, 1.0, 4.0))
    run = simulate_metric(SurfaceMesh.empty(), still, Clock(frames=8), domain, max_particles=300, progress=False)
    exposure, frame = still.appearance.exposure, 5
    known = torch.from_numpy(rain_fall_speed(run.diameters.double().numpy())) * exposure
    look = initial_look(still, run)
    instant = next(Rollout(run, look, DynamicsField.for_history(run), exposure=exposure).frames(frame, frame + 1))
    gaussians = instant.gaussians
    if gaussians.displacements is None:
        raise ValueError(f"drops must be smeared at an exposure of {exposure:g} s, found none that is")
    lengths = gaussians.displacements.double().norm(dim=1)[: len(instant.active)]
    error = (lengths / known[instant.active] - 1).abs().max()
    beard = f"Beard (1976) times 1/{1 / exposure:.0f} s, {len(lengths)} drops in still air"
    yield Record.judged("rain: length of a drop's streak, worst", 100 * float(error), "%", "<= 10", source=beard)
    one = int((run.diameters[instant.active] - 2e-3).abs().argmin())
    pixels = _drawn_length(gaussians.select(torch.tensor([one])))
    due = float(known[instant.active[one]]) * FOCAL / DISTANCE
    yield Record.judged(
        "rain: length of a drawn streak", 100 * abs(pixels / due - 1), "%", "<= 10",
        source=f"{pixels:.1f} of {due:.1f} pixels: a drop of {1e3 * float(run.diameters[instant.active[one]]):.2g} mm "
        f"{DISTANCE:g} m before the lens, root of 12 times the second moment of its brightness along the streak that the "
        "motion adds; speed times exposure times focal length over distance",
    )  # fmt: skip


def _drawn_length(drop: Gaussians) -> float:
    """Length in pixels of the streak of a drop that is seen from the side."""
    side = 160
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looking along +y, z up
    viewmat[:3, 3] = torch.tensor([0.0, 0.0, DISTANCE]) - viewmat[:3, :3] @ drop.means[0]
    K = torch.tensor([[FOCAL, 0.0, side / 2], [0.0, FOCAL, side / 2], [0.0, 0.0, 1.0]])
    camera, rasterizer = Cameras(viewmat[None], K[None], side, side), CpuRasterizer(Gaussians.empty())
    moments = []
    for shown in (drop, replace(drop, displacements=None)):
        along = rasterizer.render(camera, shown).rgb[0].double().sum(dim=(1, 2))
        places, weights = torch.arange(side) + 0.5, along / along.sum()
        moments.append(float((weights * (places - (weights * places).sum()).square()).sum()))
    return math.sqrt(12 * max(moments[0] - moments[1], 0.0))


def _beginnings() -> Iterable[Record]:
    """Particles of effects with an onset of 1 s: in frame 0, and in the steady state afterwards."""
    domain, clock = Domain((-2.0, -2.0, 0.0), (2.0, 2.0, 3.0)), Clock(frames=50)

    def number(weather: Effect, timeline: Timeline) -> ParticleHistory:
        return simulate_metric(
            SurfaceMesh.empty(), replace(weather, timeline=timeline), clock, domain, max_particles=1000, progress=False
        )

    for course in ("everywhere", "as a front"):
        clear = [len(number(effect(name), Timeline(onset=1.0, arrives=course)).active(0)) for name in ("snowfall", "sandstorm")]
        yield Record.judged(
            f"onset of 1 s, {course}: particles in frame 0", sum(clear), "", "<= 0", source="snowfall and sandstorm"
        )
    with_onset, without = (
        sum(len(run.active(frame)) for frame in range(30, 50)) / 20
        for run in (number(SNOWFALL, Timeline(onset=1.0)), number(SNOWFALL, Timeline()))
    )
    yield Record.judged(
        "onset of 1 s: number in the air after it", 100 * abs(with_onset / without - 1), "%", "<= 5",
        source=f"{with_onset:.0f} flakes against {without:.0f} without an onset, frames 30-49",
    )  # fmt: skip
