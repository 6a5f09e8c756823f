"""Which air cameras see and need: projection by hand, straight falls, and gusty ways through the box that nobody may cut."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.air.airborne import Flutter, advance
from pgsd_nerfstudio.physics.air.sight import GUST_RATES, INSTANTS, MOST, Sight, _reach
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.boundary_layer import law_of_the_wall
from pgsd_nerfstudio.scene.cameras import Cameras

DOMAIN = Domain((-10.0, -10.0, -0.3), (10.0, 10.0, 5.0))
LOWER, SIZE = np.array(DOMAIN.lower), np.array(DOMAIN.size)
STILL = Wind(speed=0.0, turbulence=0.0, flutter=0.0)
FOG = Wind(speed=0.5, gustiness=0.25, turbulence=0.12, flutter=0.0)
SAND = Wind(speed=9.0, gustiness=0.3, gust_seconds=3.0, turbulence=0.9, largest_eddy=4.0, smallest_eddy=0.5, flutter=0.0)
WIDTH, HEIGHT = 640, 480


def looking(center, target, degrees: float = 40.0) -> Cameras:
    """One camera with that horizontal field of view."""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(forward, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]))
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.asarray(center, float)
    focal = WIDTH / 2 / math.tan(math.radians(degrees) / 2)
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.tensor(viewmat)[None], K[None], WIDTH, HEIGHT)


def together(*cameras: Cameras) -> Cameras:
    return Cameras(torch.cat([c.viewmats for c in cameras]), torch.cat([c.Ks for c in cameras]), WIDTH, HEIGHT)


def ring(count: int) -> Cameras:
    turns = 2 * math.pi * np.arange(count) / count
    return together(*(looking((6 * math.cos(turn), 6 * math.sin(turn), 1.6), (0, 0, 1)) for turn in turns))


def sight(cameras, *, wind=STILL, domain=DOMAIN, distance=5.0, margin=0.0, slowest=1.0, fastest=1.0) -> Sight:
    return Sight.of(domain, cameras, distance=distance, margin=margin, slowest=slowest, fastest=fastest, wind=wind)


def in_view(points, cameras: Cameras, distance: float):
    """Whether a point projects into some image from within the distance."""
    any_view = np.zeros(points.shape[:-1], bool)
    for viewmat, K in zip(cameras.viewmats.numpy(), cameras.Ks.numpy(), strict=True):
        in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        depth = in_camera[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (in_camera[..., axis] / depth * K[axis, axis] + K[axis, 2] for axis in range(2))
        inside = (u >= 0) & (u <= WIDTH) & (v >= 0) & (v <= HEIGHT)
        any_view |= inside & (depth > 0) & (np.linalg.norm(in_camera, axis=-1) <= distance)
    return any_view


def somewhere(count: int, seed: int = 0):
    return LOWER + np.random.default_rng(seed).uniform(size=(count, 3)) * SIZE


def centers(which: Sight):
    """Of all cells, [x, y, z, 3]."""
    at = np.moveaxis(np.indices(which.needed_cells.shape), 0, -1)
    return which.lower + (at + 0.5) * which.cell


NARROW = looking((0.0, 0.0, 1.6), (5.0, 1.0, 1.6))
TILTED = looking((-3.0, 4.0, 4.5), (1.0, -2.0, 0.0), 75.0)
DOWN = looking((0.0, 0.0, 4.0), (1e-4, 0.0, 0.0), 50.0)
OFF_CENTRE = Cameras(NARROW.viewmats, NARROW.Ks + torch.tensor([[0, 0, 300.0], [0, 0, -400.0], [0, 0, 0]]), WIDTH, HEIGHT)


@pytest.mark.parametrize("cameras", [NARROW, TILTED, DOWN, OFF_CENTRE, together(NARROW, TILTED, DOWN)])
def test_whatever_projects_into_an_image_is_seen(cameras):
    points = somewhere(200_000)
    visible = in_view(points, cameras, 5.0)
    assert visible.sum() > 500
    assert sight(cameras).seen(points)[visible].all()


@pytest.mark.parametrize("margin", [0.0, 0.7])
def test_what_is_farther_than_the_margin_and_a_cell_from_a_plane_of_the_view_is_not_seen(margin):
    cameras = looking((-2.0, 0.0, 2.0), (3.0, 0.0, 2.0), 90.0)  # x - 2 >= |y| and depth x + 2 <= 5
    x, y, _ = (points := somewhere(200_000)).T
    beyond = np.max([(np.abs(y) - (x + 2)) / math.sqrt(2), x + 2 - 5.0, -(x + 2)], 0)
    seen = sight(cameras, margin=margin).seen(points)
    assert not seen[beyond > margin + 0.25 * math.sqrt(2)].any()
    assert seen[(beyond < margin) & (np.abs(points[:, 2] - 2) < 0.1)].all()


def test_a_seen_place_has_the_distance_of_the_nearest_camera_that_sees_it():
    cameras = together(NARROW, TILTED, DOWN)
    found, points = sight(cameras), somewhere(100_000)
    at = cameras.viewmats.numpy()[:, :3, :3].transpose(0, 2, 1) @ -cameras.viewmats.numpy()[:, :3, 3:]
    away = np.linalg.norm(points - at[:, None, :, 0], axis=2)
    sees = np.array([in_view(points, cameras[i], 5.0) for i in range(3)])
    inner = sees.any(0)
    nearest = np.where(sees, away, np.inf).min(0)[inner]
    recorded = found._look_up(found.seen_distances, points)[inner]
    assert (recorded <= nearest + 1e-5).all()
    assert np.median(nearest - recorded) < 0.25  # half the diagonal of a cell


@pytest.mark.parametrize("weather", ["snow", "rain", "sand"])
def test_no_particle_that_comes_within_its_reach_was_ever_dropped(weather):
    wind, slowest, fastest, seconds = WEATHERS[weather]
    found = sight(ring(5), wind=wind, distance=20.0, slowest=slowest, fastest=fastest)
    at = -(ring(5).viewmats.numpy()[:, :3, :3].transpose(0, 2, 1) @ ring(5).viewmats.numpy()[:, :3, 3:])[:, :, 0]
    places, alive = ways(wind, slowest, fastest, 0, seconds)
    reaches = 3.0 * np.random.default_rng(0).uniform(size=places.shape[1]) ** (-1 / 3)
    near = np.stack([in_view(places, ring(5)[i], 20.0) & (np.linalg.norm(places - at[i], axis=2) < reaches) for i in range(5)])
    entered = near.any(0) & alive
    later = np.maximum.accumulate(entered[::-1], 0)[::-1]
    assert entered.any(0).sum() > 25
    wide = np.broadcast_to(np.maximum(reaches, 0.4).astype(np.float32), later.shape)
    assert found.needed(places[later], wide[later]).all()
    if weather != "sand":  # a storm brings everything
        assert found.needed(places[0], reaches).mean() < 0.9 * found.needed(places[0]).mean()


def test_many_cameras_see_what_each_of_them_sees():
    cameras = ring(7)
    union = np.any([sight(cameras[i]).seen_cells for i in range(7)], 0)
    assert np.array_equal(sight(together(cameras, cameras)).seen_cells, union)


def test_in_still_air_the_air_above_what_is_seen_is_needed_and_no_more():
    for cameras in (NARROW, TILTED):
        found = sight(cameras)
        above = np.maximum.accumulate(found.seen_cells, 2)
        wider = np.any([np.roll(above, (i, j, -k), (0, 1, 2)) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (0, 1)], 0)
        assert (found.needed_cells | ~above).all()
        assert not (found.needed_cells & ~wider).any()


@pytest.mark.parametrize("degrees", [0.0, 90.0, 205.0])
def test_steady_wind_spreads_need_upwind_by_the_time_of_the_fall(degrees):
    """From a seen place to (fall height) / (fall speed) x (wind at the top) upwind of it."""
    wind = Wind(speed=2.0, direction_degrees=degrees, gustiness=0.0, turbulence=0.0, flutter=0.0)
    camera = looking((1.0, -2.0, 0.5), (1.6, -1.8, 0.5), 10.0)
    found = sight(camera, wind=wind, distance=0.1)
    x, y, z = np.moveaxis(centers(found), -1, 0)
    angle, top = math.radians(degrees), 2.0 * law_of_the_wall(np.array([5.0]), 0.03, 2.0)[0]
    seen_x, seen_y, seen_z = centers(found)[found.seen_cells].T
    expected, slack = [], 1.5 * found.cell.max()
    for grown in (-1e-9, slack):
        reached = np.zeros(x.shape, bool)
        for a, b, c in zip(seen_x, seen_y, seen_z, strict=True):
            along = (a - x) * math.cos(angle) + (b - y) * math.sin(angle)
            across = (b - y) * math.cos(angle) - (a - x) * math.sin(angle)
            most = top * np.maximum(z - c + max(grown, 0), 0) * 1.01
            reached |= (np.abs(across) <= max(grown, 0.01)) & (along >= -grown) & (along <= most + grown) & (z >= c - grown)
        expected.append(reached)
    least, most = expected
    assert least.sum() > 20
    assert found.needed_cells[least & (z <= 5)].mean() > 0.99
    assert not (found.needed_cells & ~most).any()


def ways(wind: Wind, slowest: float, fastest: float, seed: int, seconds: float):
    """Places [t, n, 3] of particles that begin in the box, and whether they have been in it all the time."""
    rng = np.random.default_rng(seed)
    field, count, step = WindField.draw(wind, seed), 3000, 0.05
    position = (LOWER + rng.uniform(size=(count, 3)) * SIZE).astype(np.float32)
    position[: count // 2, 2] = DOMAIN.upper[2]
    speed = rng.uniform(slowest, fastest, count).astype(np.float32)
    speed[::2] = slowest
    velocity = field.velocity(position.astype(float), 0.0).astype(np.float32)
    velocity[:, 2] -= speed
    sway = (wind.flutter * rng.uniform(0.3, 1.7, count)).astype(np.float32)
    hertz = (wind.flutter_hertz * rng.uniform(0.6, 1.4, count)).astype(np.float32)
    flutter = Flutter(sway, hertz, rng.uniform(size=count).astype(np.float32))
    places, alive = [position.copy()], [np.ones(count, bool)]
    for index in range(round(seconds / step)):
        advance(position, velocity, speed, flutter, field, index * step, step)
        places.append(position.copy())
        alive.append(alive[-1] & ((position >= LOWER) & (position <= LOWER + SIZE)).all(1))
    return np.stack(places), np.stack(alive)


WEATHERS = {
    "snow": (Wind(), 0.9, 1.4, 7.0),
    "slow snow, strong turbulence": (Wind(turbulence=0.4), 0.5, 0.8, 10.0),
    "gusty snow": (Wind(speed=1.5, gustiness=0.6), 0.8, 1.4, 6.0),
    "rain": (Wind(speed=2.0, turbulence=0.25, flutter=0.0), 2.0, 9.0, 3.0),
    "rain in steady wind": (Wind(speed=4.0, gustiness=0.05, turbulence=0.1, flutter=0.0), 3.0, 9.0, 2.0),
    "sand": (SAND, 2.0, 6.0, 3.0),
    "fog": (FOG, 0.01, 0.012, 8.0),
    "hail in a storm": (Wind(speed=15.0, turbulence=1.0, flutter=0.0), 12.0, 30.0, 1.0),
}


@pytest.mark.parametrize("weather", WEATHERS)
def test_no_particle_that_comes_into_sight_was_ever_dropped(weather):
    wind, slowest, fastest, seconds = WEATHERS[weather]
    views = [NARROW, together(looking((-6.0, 5.0, 3.0), (-8.0, 5.0, 2.0), 30.0), looking((9.0, -9.0, 1.0), (9.0, 9.0, 1.0)))]
    found = [sight(cameras, wind=wind, distance=4.0, slowest=slowest, fastest=fastest) for cameras in views]
    watched = 0
    for seed in range(3):
        places, alive = ways(wind, slowest, fastest, seed, seconds)
        for cameras, one in zip(views, found, strict=True):
            entered = in_view(places, cameras, 4.0) & alive
            later = np.maximum.accumulate(entered[::-1], 0)[::-1]  # comes into sight now or later
            assert one.needed(places[later]).all()
            watched += entered.any(0).sum()
    assert watched > 120


@pytest.mark.parametrize("time", [1.0, 5.0, 10.0])
def test_gusts_stay_within_their_three_deviations(time):
    """What `Sight` takes for granted about the waves that `WindField` draws, over many draws."""
    seconds = Wind().gust_seconds
    gusts = np.stack([WindField.draw(Wind(modes=0), seed).gusts for seed in range(400)])
    amplitude, hertz, phase = np.moveaxis(gusts, 3, 0)[..., None]
    assert GUST_RATES[0] <= hertz.min() * seconds
    assert hertz.max() * seconds <= GUST_RATES[1]

    def way(at):
        return (-amplitude * np.cos(2 * math.pi * (hertz * at + phase)) / (2 * math.pi * hertz)).sum(2)

    start = np.random.default_rng(0).uniform(0, 30, 20)
    moved = np.abs(way(start + time) - way(start))
    mostly_still = Wind(speed=1.0, gustiness=1.0, turbulence=0.0, flutter=0.0)
    bound = np.interp(time, INSTANTS[1:], _reach(mostly_still, mostly_still.reference_height, 1.0, 1.0).against_wind)
    assert (moved[:, 0] > bound).mean() < 2e-3
    assert (moved[:, 1] > bound / 2).mean() < 2e-3
    assert (moved[:, 0] > bound / 2).mean() > 1e-2


@pytest.mark.parametrize("speed", [0.01, 0.5, 1.0, 4.0])
def test_turbulent_walks_stay_within_their_three_deviations(speed):
    wind, rng, count, step = Wind(speed=0.0, flutter=0.0), np.random.default_rng(0), 250, 0.05
    walks = []
    for seed in range(6):
        field = WindField.draw(wind, seed)
        position = (rng.uniform(-30, 30, (count, 3)) + np.array([0, 0, 300])).astype(np.float32)  # far above the ground
        start, speeds = position.copy(), np.full(count, speed, np.float32)
        velocity = (field.velocity(start.astype(float), 0.0) - np.array([0, 0, speed])).astype(np.float32)
        for index in range(200):
            advance(position, velocity, speeds, Flutter.none(count), field, index * step, step)
        walks.append(np.abs(position - start + np.array([0, 0, 200 * step * speed])))
    bound = np.interp(200 * step, INSTANTS[1:], _reach(wind, 5.0, speed, speed).across)
    assert (np.array(walks) > bound).mean() < 3e-3
    assert (np.array(walks) > bound / 3).mean() > 2e-2


def test_a_narrow_camera_needs_a_part_of_a_wide_box():
    snow = sight(NARROW, wind=Wind(), distance=5.0, margin=0.5, slowest=0.9, fastest=1.4)
    rain = sight(NARROW, wind=Wind(speed=2.0), distance=5.0, margin=0.5, slowest=3.0, fastest=9.0)
    assert 0.1 < snow.share < 0.5
    assert 0.1 < rain.share < 0.5
    assert sight(ring(12), wind=Wind(), distance=5.0, margin=0.5, slowest=0.9, fastest=1.4).share < 0.9
    assert not snow.needed(np.array([[8.0, -6.0, 0.5]])).any()  # downwind


def test_fog_drifts_into_sight_from_everywhere():
    assert sight(NARROW, wind=FOG, slowest=0.01, fastest=0.01).share == 1.0


def test_a_storm_brings_everything_above_into_sight():
    found = sight(NARROW, wind=Wind(speed=60.0), slowest=4.0, fastest=9.0)
    assert found.needed_cells[:, :, -1].all()


def test_what_neither_falls_nor_drifts_is_needed_where_it_is_seen():
    found = sight(TILTED, slowest=0.0, fastest=0.0)
    wider = found.seen_cells
    for axis in range(3):
        wider = wider | np.roll(wider, 1, axis) | np.roll(wider, -1, axis)
    assert (found.needed_cells | ~found.seen_cells).all()
    assert not (found.needed_cells & ~wider).any()


@pytest.mark.parametrize(
    "cameras", [looking((30.0, 0.0, 1.0), (40.0, 0.0, 1.0)), looking((10.5, 0.0, 1.0), (20.0, 0.0, 2.0))], ids=["far", "away"]
)
def test_cameras_that_see_no_air_of_the_box_need_none(cameras):
    found = sight(cameras, wind=Wind())
    assert found.share == 0.0
    assert not found.needed(somewhere(100)).any()
    assert not found.seen(somewhere(100)).any()


def test_cameras_outside_see_into_the_box():
    points = somewhere(100_000)
    cameras = looking((14.0, 0.0, 2.0), (0.0, 0.0, 1.0))
    visible = in_view(points, cameras, 8.0)
    assert visible.sum() > 100
    assert sight(cameras, distance=8.0).seen(points)[visible].all()


@pytest.mark.parametrize("found", [Sight.everything(), sight(NARROW[:0])])
def test_without_cameras_everything_is_needed(found):
    assert found.share == 1.0
    assert found.needed(np.zeros((3, 3), np.float32)).tolist() == [True] * 3
    assert found.seen(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_outside_of_the_box_counts_the_nearest_cell(dtype):
    found = sight(NARROW, wind=Wind())
    inside = centers(found).reshape(-1, 3).astype(dtype)
    assert np.array_equal(found.needed(inside), found.needed_cells.ravel())
    for axis in range(3):
        for sign, layer in ((1, -1), (-1, 0)):
            face = centers(found).astype(dtype).take(layer, axis).reshape(-1, 3)
            away = np.zeros(3, dtype)
            away[axis] = sign * 50.0
            assert np.array_equal(found.needed(face + away), found.needed_cells.take(layer, axis).ravel())


def test_large_boxes_get_larger_cells():
    found = sight(NARROW, domain=Domain((-60.0, -50.0, 0.0), (70.0, 90.0, 30.0)))
    assert 0.8 * MOST < found.needed_cells.size <= MOST
    assert (found.cell <= 1.6).all()
    assert (sight(NARROW).cell <= 0.25).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"distance": 0.0}, "distance > 0"),
        ({"margin": -1.0}, "-1 m"),
        ({"distance": math.nan}, "nan m"),
        ({"slowest": 2.0}, "got 2 and 1 m/s"),
        ({"slowest": -0.1}, "slowest <= fastest"),
        ({"fastest": math.inf}, "inf m/s"),
    ],
)
def test_impossible_lengths_and_speeds_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        sight(NARROW, **wrong)
