"""How a weather comes and goes: clear at first, everywhere by and by or behind a front, nothing new after its end."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import FOG, RAINFALL, SNOWFALL, Effect, Wind
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, simulate_metric
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.bodies import SPLASHED
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.record.report import report
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-4.0, -3.0, -0.2), (4.0, 3.0, 3.0))
FPS, FRAMES, MOST, ONSET = 25.0, 90, 3000, 2.0
ENOUGH = 4.5  # standard deviations
STEADY = Wind(speed=0.6, gustiness=0.0, turbulence=0.1)
COURSES = ("everywhere", "as a front")


def courtyard() -> SurfaceMesh:
    """A floor of 4 m and a table of 1 m at 0.7 m."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([2 * corners, 0.5 * corners + torch.tensor([0, 0, 0.7])])
    return SurfaceMesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32))


def run(
    timeline: Timeline,
    effect: Effect = SNOWFALL,
    *,
    surface: SurfaceMesh | None = None,
    frames: int = FRAMES,
    max_particles: int = MOST,
    cameras: Cameras | None = None,
    resume: Path | None = None,
) -> ParticleHistory:
    return simulate_metric(
        SurfaceMesh.empty() if surface is None else surface,
        replace(effect, timeline=timeline),
        Clock(FPS, frames),
        DOMAIN,
        max_particles=max_particles,
        cameras=cameras,
        progress=False,
        resume=resume,
    )


def counts(history: ParticleHistory) -> np.ndarray:
    return np.array([len(history.active(frame)) for frame in range(history.frames)])


def same(first: ParticleHistory, second: ParticleHistory) -> bool:
    values = [(v, getattr(second, n)) for n, v in vars(first).items() if isinstance(v, torch.Tensor)]
    return all(torch.equal(a, b) for a, b in values)


def snow_in(speed: float) -> Effect:
    return replace(SNOWFALL, wind=replace(STEADY, speed=speed))


def cameras() -> Cameras:
    poses = torch.eye(4)[None].clone()
    poses[:, :3, 3] = torch.tensor([3.0, -2, 1.0])
    poses[:, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looking along +y
    K = torch.tensor([[[90.0, 0, 32], [0, 90, 32], [0, 0, 1]]])
    return Cameras.from_opengl(poses, K, 64, 64)


@pytest.fixture(scope="module")
def steady() -> ParticleHistory:
    return run(Timeline(), snow_in(3.0))


@pytest.fixture(scope="module", params=COURSES)
def timeline(request) -> Timeline:
    return Timeline(onset=ONSET, arrives=request.param)


@pytest.fixture(scope="module")
def coming(timeline) -> ParticleHistory:
    return run(timeline, snow_in(3.0))


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL, FOG], ids=lambda e: e.name)
def test_without_an_onset_a_front_is_everywhere_from_the_start(effect):
    settings = {"surface": courtyard(), "frames": 12, "max_particles": 150, "cameras": cameras()}
    assert same(run(Timeline(), effect, **settings), run(Timeline(arrives="as a front"), effect, **settings))


@pytest.mark.parametrize("speed", [0.6, 4.0, 8.0])
def test_wind_does_not_empty_the_air_behind_walls_and_roofs(speed):
    """What enters upwind is flux times area: there is as much in front of the courtyard's floor as in still air."""
    history, fell = run(Timeline(), snow_in(speed), surface=courtyard(), frames=100), []
    for frame in (0, 60, 80, 99):
        x, y, z = history.positions_at(frame, history.active(frame)).numpy().T
        fell.append(((z > 1.2) & (np.abs(x) < 3.5) & (np.abs(y) < 2.5)).sum())
    assert np.mean(fell[1:]) == pytest.approx(fell[0], rel=0.1)


def test_the_first_frame_is_clear(coming):
    assert len(coming.active(0)) == 0
    assert int(coming.births.min()) >= 1


@pytest.mark.parametrize("course", COURSES)
def test_a_single_clear_frame_is_a_history_without_particles(course):
    assert len(run(Timeline(onset=1.0, arrives=course), frames=1)) == 0


def test_the_number_in_the_air_rises_as_the_share_that_has_come(timeline, coming, steady):
    arrival = Arrival.of(timeline, DOMAIN, STEADY)
    number, full = counts(coming), counts(steady)
    for frame in range(5, 50, 5):
        share = arrival.share(frame / FPS)
        spread = math.sqrt(full[frame] * share)  # the wind replaces them by others
        assert abs(number[frame] - full[frame] * share) < ENOUGH * spread + 0.01 * full[frame], frame


def test_after_the_onset_there_is_as_much_as_if_it_had_always_been(coming, steady):
    late = slice(int(ONSET * FPS) + 5, FRAMES)
    assert counts(coming)[late].mean() == pytest.approx(counts(steady)[late].mean(), rel=ENOUGH / math.sqrt(MOST) / 2)


def test_what_is_there_at_first_without_an_onset_comes_within_it_at_the_same_places():
    calm = replace(SNOWFALL, wind=Wind(speed=0.0, turbulence=0.0, flutter=0.0))
    settings = {"effect": calm, "frames": 60, "max_particles": 800}
    at_once, by_and_by = run(Timeline(), **settings), run(Timeline(onset=ONSET), **settings)
    places = by_and_by.positions[by_and_by.offsets[:-1]].double()
    distance, which = torch.cdist(at_once.positions_at(0, at_once.active(0)).double(), places).min(1)
    assert distance.max() < 2e-4  # the lattice on which positions are kept
    born = by_and_by.births[which].numpy()
    assert born.max() <= ONSET * FPS
    even = len(which) / (ONSET * FPS)
    assert np.abs(np.bincount(born, minlength=51)[1:51] - even).max() < 4.5 * math.sqrt(even) + 1


@pytest.mark.parametrize("speed", [0.0, 2.0, 6.0], ids=["calm", "slower than the front", "faster than the front"])
def test_air_behind_a_front_is_full_and_even_and_ahead_of_it_there_is_nothing(speed):
    timeline = Timeline(onset=ONSET, arrives="as a front")
    effect = snow_in(speed)
    history, arrival = run(timeline, effect, frames=51), Arrival.of(timeline, DOMAIN, effect.wind)
    window = history.window(0, 51)
    late = np.stack([arrival.times(window.positions[:, frame].numpy()) - frame / FPS for frame in range(51)], 1)
    assert late[window.active.numpy()].max() < 1e-5
    full = counts(run(Timeline(), effect, frames=1))[0]
    for frame in (20, 35, 50):
        times = arrival.times(history.positions_at(frame, history.active(frame)).numpy())
        edges = np.linspace(0.0, frame / FPS, 5)
        found = np.histogram(times, edges)[0]
        due = full * np.diff([arrival.share(edge) for edge in edges])
        assert (np.abs(found - due) < ENOUGH * np.sqrt(due) + 0.03 * due).all(), (frame, found, due)


@pytest.mark.parametrize(("effect", "course"), [(SNOWFALL, "everywhere"), (SNOWFALL, "as a front"), (RAINFALL, "everywhere")])
def test_none_enters_after_the_end_and_what_flies_goes_on(effect, course):
    history = run(Timeline(onset=1.0, arrives=course, ends=1.6), effect, surface=courtyard(), frames=50, max_particles=150)
    droplets = (history.kinds & SPLASHED) > 0
    assert int(history.births[~droplets].max()) == 40
    number = counts(history)
    assert 0 < number[49] < number[40]
    assert int((history.ends[~droplets] > 45).sum()) > 5


@pytest.mark.parametrize("course", COURSES)
def test_an_interrupted_onset_goes_on_to_the_same_bits(course, tmp_path, monkeypatch):
    timeline, settings = Timeline(onset=2.5, arrives=course), {"surface": courtyard(), "frames": 52, "max_particles": 400}
    whole, meet, calls = run(timeline, **settings), Ground.meet, []

    def interrupted(self, *arguments):
        calls.append(0)
        if len(calls) == 40:
            raise KeyboardInterrupt
        return meet(self, *arguments)

    monkeypatch.setattr(Ground, "meet", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(timeline, **settings, resume=tmp_path)
    assert same(whole, run(timeline, **settings, resume=tmp_path))
    assert len(calls) == 40 + 27  # frames 25 to 51


@pytest.mark.parametrize("speed", [0.6, 12.0])
@pytest.mark.parametrize("course", COURSES)
def test_particles_and_mass_are_accounted_for(course, speed):
    effect = snow_in(speed)
    history = run(Timeline(onset=1.5, arrives=course, ends=2.0), effect, surface=courtyard(), frames=60, max_particles=500)
    about, said = history.about, report(history, SNOWFALL.material)
    ends = about["landed"] + about["absorbed"] + about["left"] + about["unseen"] + about["in_air"]
    assert about["emitted"] == len(history) == ends
    assert abs(said["mass_lost"]) < 1e-9 * said["mass_emitted"]
    assert said["per_frame"]["mass_in_air"][0] == 0.0


@pytest.mark.parametrize("course", COURSES)
def test_what_comes_later_is_left_out_too_where_no_camera_can_see_it(course):
    module = importlib.import_module("pgsd_nerfstudio.physics.metric")
    timeline, calm = Timeline(onset=ONSET, arrives=course), snow_in(0.0)
    sight = module._sight(calm, DOMAIN, cameras())
    history = run(timeline, calm, frames=50, cameras=cameras())
    assert sight.share < 0.7
    places = history.positions[history.offsets[:-1]].numpy()
    assert sight.needed(places).mean() > 0.999  # but for the lattice on which positions are kept
    seen = sight.needed(places, history.reaches.numpy())
    assert seen.mean() > 0.99 and history.about["unseen"] > 50


@pytest.mark.parametrize("degrees", [0.0, 25.0, 90.0, 200.0, 301.0])
def test_a_front_goes_evenly_from_the_upwind_to_the_downwind_corner(degrees):
    timeline, wind = Timeline(onset=3.0, arrives="as a front"), Wind(direction_degrees=degrees)
    arrival = Arrival.of(timeline, DOMAIN, wind)
    corners = np.array([[x, y, 1.0] for x in (-4.0, 4.0) for y in (-3.0, 3.0)])
    assert arrival.times(corners).min() == pytest.approx(0.0, abs=1e-12)
    assert arrival.times(corners).max() == pytest.approx(3.0)
    points = np.random.default_rng(0).uniform(DOMAIN.lower, DOMAIN.upper, (100_000, 3))
    times = arrival.times(points)
    along = points[:, 0] * math.cos(math.radians(degrees)) + points[:, 1] * math.sin(math.radians(degrees))
    for seconds in (0.3, 1.1, 2.5):
        assert ((along <= arrival.front_position(seconds)) == (times <= seconds)).all()
        assert arrival.share(seconds) == pytest.approx((times <= seconds).mean(), abs=0.006)
    assert (arrival.share(0.0), arrival.share(3.0), arrival.share(9.0)) == pytest.approx((0.0, 1.0, 1.0))


def test_what_arrives_everywhere_comes_when_it_is_drawn():
    arrival = Arrival.of(Timeline(onset=4.0), DOMAIN, STEADY)
    points = np.zeros((3, 3))
    assert arrival.times(points, np.array([0.0, 0.25, 1.0])).tolist() == [0.0, 1.0, 4.0]
    assert arrival.share(1.0) == 0.25
    with pytest.raises(ValueError, match="draws"):
        arrival.times(points)
    with pytest.raises(ValueError, match="has a front"):
        arrival.front_position(1.0)


def test_without_an_onset_it_is_everywhere_at_once():
    arrival = Arrival.of(Timeline(arrives="as a front", ends=2.0), DOMAIN, STEADY)
    assert (arrival.times(np.ones((2, 3))) == 0).all()
    assert arrival.front_position(0.0) == math.inf
    assert arrival.share(0.0) == 1.0
    assert not arrival.is_over(2.0)
    assert arrival.is_over(2.01)
