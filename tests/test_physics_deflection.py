"""Wind around obstacles: potential flow past a cylinder, balances of what flows, walls, closed rooms and damaged meshes."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.air.deflection import Deflection
from pgsd_nerfstudio.physics.air.obstacle_flow import MOST, Faces, Lattice, mass_consistent, open_faces
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws.boundary_layer import law_of_the_wall
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-4.0, -4.0, -0.3), (4.0, 4.0, 4.0))
ALONG_X = np.array([1.0, 0.0])


def mesh(vertices, triangles) -> SurfaceMesh:
    return SurfaceMesh(torch.tensor(np.asarray(vertices)).float(), torch.tensor(np.asarray(triangles)).int())


def box(lower, upper) -> SurfaceMesh:
    corners = np.array([[(lower, upper)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh(corners, [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])


def wall(height: float) -> SurfaceMesh:
    """Across the wind, 5 m long, without thickness, through cell centres or not."""
    return mesh([[0, -2.5, -0.5], [0, 2.5, -0.5], [0, 2.5, height], [0, -2.5, height]], [[0, 1, 2], [0, 2, 3]])


def cylinder(radius: float, sides: int = 400) -> SurfaceMesh:
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    here = np.arange(sides)
    after = (here + 1) % sides
    triangles = np.concatenate([np.stack([here, after, after + sides], 1), np.stack([here, after + sides, here + sides], 1)])
    return mesh(np.concatenate([np.insert(ring, 2, -1.0, 1), np.insert(ring, 2, 2.0, 1)]), triangles)


def ball(radius: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    rings, sides = 24, 48
    polar, turn = np.meshgrid(np.pi * np.arange(rings + 1) / rings, 2 * np.pi * np.arange(sides) / sides, indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    ring, side = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = (ring * sides + side).ravel(), (ring * sides + (side + 1) % sides).ravel()
    triangles = np.concatenate([np.stack([a, a + sides, b + sides], 1), np.stack([a, b + sides, b], 1)])
    return radius * unit + [0, 0, height], triangles


@cache
def garden() -> tuple[SurfaceMesh, Deflection]:
    """A house, a ball above the ground, a thin wall: deflected."""
    vertices, triangles = ball(0.9, 2.0)
    house, fence = box((-3, -3, -0.2), (-0.5, -1, 2.4)), wall(1.3)
    parts = [
        house,
        mesh(vertices + np.array([1.8, 2.0, 0.0]), triangles),
        mesh(fence.vertices + torch.tensor([2.1, 0, 0]), fence.triangles),
    ]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    joined = SurfaceMesh(
        torch.cat([part.vertices for part in parts]),
        torch.cat([part.triangles + int(start) for part, start in zip(parts, starts, strict=False)]),
    )
    found = Deflection.of(joined, DOMAIN, Wind())
    assert found is not None
    return joined, found


def blocked_wind(surface: SurfaceMesh, domain: Domain = DOMAIN, wind: Wind | None = None) -> Deflection:
    found = Deflection.of(surface, domain, wind or Wind())
    assert found is not None
    return found


def total(deflection: Deflection, points, wind=ALONG_X) -> np.ndarray:
    """The whole mean wind at points."""
    points = np.asarray(points, float)
    velocity = deflection.velocity(points, wind)
    velocity[:, :2] += law_of_the_wall(points[:, 2], Wind().roughness, Wind().reference_height)[:, None] * wind
    return velocity


def outflow(fluxes: Faces, thickness: np.ndarray) -> np.ndarray:
    """Of every cell, for both winds."""
    x, y, z = fluxes
    return (np.diff(x, axis=1) + np.diff(y, axis=2)) * thickness + np.diff(z, axis=3)


# --- Potential flow past a cylinder ---


def error_around_cylinder(cell: float, nearest: float) -> np.ndarray:
    """Between `nearest` and 4 radii from the axis, against u = grad(x + x / r^2); a layer of air 12 radii wide all around."""
    count = round(24 / cell)
    lattice = Lattice(np.array([-12.03, -11.98, 0.0]), cell, (count, count, 1), True)
    passable = open_faces(cylinder(1.0), lattice)
    passable[2][:] = False
    deflection = Deflection.around(lattice, passable, np.ones(1))
    rng = np.random.default_rng(0)
    r, turn = rng.uniform(nearest, 4, 4000), rng.uniform(0, 2 * np.pi, 4000)
    x, y = r * np.cos(turn), r * np.sin(turn)
    found = ALONG_X + deflection.velocity(np.stack([x, y, np.full(4000, cell / 2)], 1), ALONG_X)[:, :2]
    truth = np.stack([1 - (x**2 - y**2) / r**4, -2 * x * y / r**4], 1)
    return np.linalg.norm(found - truth, axis=1)


def test_air_passes_a_cylinder_as_potential_flow_does():
    error = error_around_cylinder(0.2, 1.2)  # outside one cell of the wall
    assert error.mean() < 0.035
    assert np.quantile(error, 0.95) < 0.12
    assert error_around_cylinder(0.2, 2.0).max() < 0.06


def test_finer_cells_come_closer_to_potential_flow():
    coarse, middle, fine = (error_around_cylinder(cell, 1.5) for cell in (0.4, 0.2, 0.1))
    assert coarse.mean() > 1.5 * middle.mean() > 1.5**2 * fine.mean()
    assert coarse.max() > 1.5 * middle.max() > 1.5**2 * fine.max()


# --- What flows in flows out ---


def test_no_cell_gains_or_loses_air():
    _, deflection = garden()
    assert np.abs(outflow(deflection.fluxes, deflection.lattice.thickness)).max() < 1e-8


def test_nothing_flows_through_blocked_faces_and_the_ground():
    surface, deflection = garden()
    passable = open_faces(surface, deflection.lattice)
    blocked = [int((~faces).sum()) for faces in passable]
    assert min(blocked) > 30
    for faces, flux in zip(passable, deflection.fluxes, strict=True):
        assert (flux[:, ~faces] == 0).all()
    assert (deflection.fluxes[2][..., 0] == 0).all()


def test_the_flux_through_every_cross_section_is_that_through_the_sides_between():
    _, deflection = garden()
    (x, y, z), thick = deflection.fluxes, deflection.lattice.thickness
    through = (x[0] * thick).sum((1, 2))
    sides = ((y[0, :, -1] - y[0, :, 0]) * thick).sum(1) + z[0, :, :, -1].sum(1)
    np.testing.assert_allclose(through[1:] - through[:-1], -sides, atol=1e-7)
    assert np.ptp(through) > 0.02 * through.max()  # air does leave through the sides on its way


def test_a_channel_carries_the_same_flux_everywhere():
    passable = np.ones((21, 8, 6), bool), np.ones((20, 9, 6), bool), np.ones((20, 8, 7), bool)
    passable[0][9, :5, :4] = False
    for faces in (passable[1][:, 0], passable[1][:, -1], passable[2][:, :, 0], passable[2][:, :, -1]):
        faces[:] = False
    (x, _, _), _ = mass_consistent(passable, np.linspace(0.5, 1.0, 6), np.ones(6))
    through = x[0].sum((1, 2))
    np.testing.assert_allclose(through, through[0], atol=1e-7)
    assert 0.3 < through[0] / (8 * np.linspace(0.5, 1.0, 6).sum()) < 0.95


@pytest.mark.parametrize("turbulence", [0.0, 0.2])
def test_the_whole_wind_has_no_divergence_between_the_lattice_points_either(turbulence):
    _, deflection = garden()
    field = WindField.draw(Wind(turbulence=turbulence), 1, deflection)
    points = np.random.default_rng(0).uniform([-4, -4, 0.02], [4, 4, 4], (1500, 3))
    h, slopes = 1e-4, np.zeros((3, 3, len(points)))
    for axis in range(3):
        shift = h * np.eye(3)[axis]
        slopes[axis] = ((field.velocity(points + shift, 2.0) - field.velocity(points - shift, 2.0)) / (2 * h)).T
    divergence = slopes[0, 0] + slopes[1, 1] + slopes[2, 2]
    diagonal = np.sqrt((slopes[[0, 1, 2], [0, 1, 2]] ** 2).mean())
    assert diagonal > 0.05  # there is something to cancel
    assert np.abs(divergence).max() < 1e-5 * diagonal


def test_the_mean_wind_is_the_one_nearest_to_the_undisturbed():
    """Among flows without divergence: any closed loop of air added to it takes it farther away."""
    surface, deflection = garden()
    profile = law_of_the_wall(deflection.lattice.heights, Wind().roughness, Wind().reference_height)
    _, passable = mass_consistent(open_faces(surface, deflection.lattice), profile, deflection.lattice.thickness)
    change_x = deflection.fluxes[0][0] - profile
    for axis in (1, 2):  # loops through two faces across x and two across this axis
        along, side = np.moveaxis(change_x[1:-1], axis, 1), np.moveaxis(deflection.fluxes[axis][0], axis, 1)[:, 1:-1]
        loop = along[:, 1:] - along[:, :-1] - side[1:] + side[:-1]
        along, side = np.moveaxis(passable[0][1:-1], axis, 1), np.moveaxis(passable[axis], axis, 1)[:, 1:-1]
        free = along[:, 1:] & along[:, :-1] & side[1:] & side[:-1]
        assert np.abs(loop[free]).max() < 1e-8
        assert np.abs(loop[~free]).max() > 0.1


# --- Walls and rooms ---


def test_air_is_slower_before_and_behind_a_wall_and_faster_above():
    deflection = blocked_wind(wall(1.5))
    across = np.linspace(-1, 1, 9)
    for height, low, high in ((0.4, 0.1, 0.8), (0.8, 0.1, 0.85), (1.9, 1.03, 2.0), (2.3, 1.01, 2.0)):
        places = (-0.9, -0.6, 0.6, 0.9) if height < 1.5 else (-0.2, 0.0, 0.2)
        points = [[x, y, height] for x in places for y in across]
        share = total(deflection, points)[:, 0] / law_of_the_wall(np.array([height]), 0.03, 2.0)
        assert (share > low).all() and (share < high).all(), (height, share.min(), share.max())


def test_a_wall_that_stops_the_wind_lets_it_pass_along():
    deflection = blocked_wind(wall(1.5))
    points = np.array([[x, y, 0.9] for x in (-0.5, 0.5) for y in (-1.0, 0.0, 1.0)])
    np.testing.assert_allclose(deflection.velocity(points, np.array([0.0, 1.0])), 0.0, atol=1e-12)


def test_the_wind_turns_with_its_direction():
    """Obstacle and wind turned by a quarter: the flow is turned with them."""
    surface = box((-1.5, -0.7, -0.2), (0.4, 1.1, 1.6))
    x, y, z = surface.vertices.T
    turned = SurfaceMesh(torch.stack([-y, x, z], 1), surface.triangles)
    points = np.random.default_rng(0).uniform([-3, -3, 0], [3, 3, 3], (200, 3))
    found = blocked_wind(surface).velocity(points, ALONG_X)
    again = blocked_wind(turned).velocity(points @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.array([0.0, 1.0]))
    np.testing.assert_allclose(again, found @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)


def test_air_in_a_closed_room_stands_still():
    deflection = blocked_wind(box((-2, -2, -0.2), (2, 2, 2.6)))
    inside = np.stack([np.abs(deflection.lattice.face_centres(0)[..., axis]) < 1.95 for axis in (0, 1)]).all(0)
    inside &= deflection.lattice.face_centres(0)[..., 2] < 2.3
    assert inside.sum() > 500
    assert (deflection.fluxes[0][:, inside] == 0).all()
    points = np.random.default_rng(0).uniform([-1.4, -1.4, 0.0], [1.4, 1.4, 2.1], (1000, 3))
    speed = np.linalg.norm(total(deflection, points), axis=1)
    # What is left is the bend of the log profile between the layers.
    assert speed.max() < 0.11
    assert speed[points[:, 2] > 0.2].max() < 0.03


def test_turbulence_ends_at_walls():
    deflection = blocked_wind(box((-2, -2, -0.2), (2, 2, 2.6)))
    field = WindField.draw(Wind(speed=0.0, turbulence=0.3), 0, deflection)
    rng = np.random.default_rng(0)
    on = np.stack([np.full(500, 2.0), rng.uniform(-1.5, 1.5, 500), rng.uniform(0.5, 2.0, 500)], 1)
    at_wall, away = field.velocity(on, 1.0), field.velocity(on + np.array([1.4, 0, 0]), 1.0)
    assert np.sqrt((at_wall**2).mean()) < 0.01
    assert np.sqrt((away**2).mean()) > 0.15


def test_turbulence_is_ramped_up_over_the_distance_from_a_wall():
    """Bridson's ramp of distance, 15/8 r - 10/8 r^3 + 3/8 r^5 over 0.6 m, from half a cell on."""
    deflection = blocked_wind(wall(3.0))
    lattice, index = deflection.lattice, np.arange(5)
    first = lattice.face_centres(0)[~open_faces(wall(3.0), lattice)[0]][:, 0].max()
    points = np.stack([first + lattice.cell * (index + 0.5), 0 * index, 0 * index + lattice.heights[4]], 1)
    points[:, 1] = lattice.lower[1] + lattice.cell * (lattice.shape[1] // 2 + 0.5)
    r = (index * lattice.cell / 0.6).clip(0, 1)
    share, slope = deflection.shelter(points)
    np.testing.assert_allclose(share, 15 / 8 * r - 10 / 8 * r**3 + 3 / 8 * r**5, atol=1e-12)
    between, _ = deflection.shelter(np.linspace(points[0], points[-1], 200))
    assert (np.diff(between) >= -1e-15).all()
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)


# --- Where there is nothing in the way ---


def test_air_stands_still_on_the_ground_and_below():
    _, deflection = garden()
    points = np.random.default_rng(0).uniform([-5, -5, -0.5], [5, 5, 0.0], (300, 3))
    points[::3, 2] = 0.0
    assert np.abs(WindField.draw(Wind(), 0, deflection).velocity(points, 1.0)).max() < 1e-12


def test_the_wind_is_undisturbed_beyond_a_cell_and_a_half_outside_the_lattice():
    _, deflection = garden()
    points = np.random.default_rng(0).uniform([-12, -12, 0], [12, 12, 9], (3000, 3))
    lower, reach = deflection.lattice.lower, 1.5 * deflection.lattice.cell
    upper = lower + deflection.lattice.cell * np.array(deflection.lattice.shape)
    points = points[((points < lower - reach) | (points > upper + reach)).any(1)]
    assert len(points) > 1000
    deflected, open_country = (WindField.draw(Wind(), 0, way).velocity(points, 1.0) for way in (deflection, None))
    np.testing.assert_allclose(deflected, open_country, rtol=0, atol=1e-15)


def test_the_wind_changes_without_a_jump():
    """Along lines right through the garden and out of it, 1 mm at a time."""
    _, deflection = garden()
    field = WindField.draw(Wind(), 0, deflection)
    steps = np.linspace(0, 1, 16_001)[:, None]
    for start, stop in (((-8, -2, 1.2), (8, 1, 1.5)), ((1.8, 2, -0.2), (1.9, 2.1, 7)), ((0, 8, 0.5), (0.2, -8, 2.5))):
        start, stop = np.array(start, float), np.array(stop, float)
        found = field.velocity(start + steps * (stop - start), 0.5)
        assert np.linalg.norm(np.diff(found, axis=0), axis=1).max() < 0.01
        assert np.ptp(found, axis=0).max() > 0.2


@pytest.mark.parametrize(
    "surface",
    [
        SurfaceMesh.empty(),
        mesh([[-50, -50, 0], [50, -50, 0], [0, 80, 0]], [[0, 1, 2]]),
        mesh([[-50, -50, -0.25], [50, -50, -0.1], [0, 80, 0.1]], [[0, 1, 2]]),
        box((20, 20, -0.2), (22, 22, 3)),
    ],
    ids=["no mesh", "flat ground", "uneven ground", "a house elsewhere"],
)
def test_open_country_deflects_nothing(surface):
    assert Deflection.of(surface, DOMAIN, Wind()) is None


# --- Hard cases ---


def sound(deflection: Deflection, domain: Domain) -> np.ndarray:
    """Balanced and finite everywhere, also far outside; the wind at 1000 places in the domain."""
    assert np.abs(outflow(deflection.fluxes, deflection.lattice.thickness)).max() < 1e-8
    assert math.prod(deflection.lattice.shape) <= MOST
    lower, upper = np.array(domain.lower), np.array(domain.upper)
    points = np.random.default_rng(0).uniform(lower, upper, (1000, 3))
    field = WindField.draw(Wind(), 0, deflection)
    far = np.concatenate([points + 5 * (upper - lower), points - 5 * (upper - lower), 1e9 * points])
    assert np.isfinite(field.velocity(far, 1.0)).all()
    found = total(deflection, points)
    assert np.isfinite(found).all() and np.isfinite(field.velocity(points, 1.0)).all()
    return found


def test_flipped_triangles_change_nothing_and_small_holes_little():
    vertices, triangles = ball(1.2, 1.7)
    rng = np.random.default_rng(0)
    flipped = np.where(rng.uniform(size=len(triangles))[:, None] < 0.3, triangles[:, ::-1], triangles)
    holed = flipped[rng.uniform(size=len(triangles)) >= 0.05]
    whole, turned, open_ = (sound(blocked_wind(mesh(vertices, t.copy())), DOMAIN) for t in (triangles, flipped, holed))
    np.testing.assert_array_equal(turned, whole)
    assert np.sqrt(((open_ - whole) ** 2).mean()) < 0.06


def test_triangles_thrown_at_random_and_degenerate_ones_are_survived():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-4, 4, (300, 3))
    triangles = rng.integers(0, 300, (200, 3))  # some with a vertex twice
    sound(blocked_wind(mesh(vertices, triangles)), DOMAIN)


def test_ground_that_fills_the_bottom_leaves_the_air_above_alone():
    """Raised ground from side to side: the wind, which blows level, meets none of it."""
    surface = mesh([[-50, -50, 0.5], [50, -50, 0.5], [0, 80, 0.5]], [[0, 1, 2]])
    deflection = blocked_wind(surface)
    sound(deflection, DOMAIN)
    assert np.abs(deflection.splines).max() < 1e-8


def test_a_domain_within_a_closed_box_is_still():
    deflection = blocked_wind(box((-4.3, -4.3, -1), (4.3, 4.3, 4.5)))
    assert np.linalg.norm(sound(deflection, DOMAIN), axis=1).max() < 0.11
    assert all((flux == 0).all() for flux in deflection.fluxes)


@pytest.mark.parametrize("size", [1e-3, 1e4], ids=["1 mm", "10 km"])
def test_an_obstacle_deflects_alike_in_domains_of_any_size(size):
    domain = Domain((-size / 2, -size / 2, 0.0), (size / 2, size / 2, size / 2))
    deflection = blocked_wind(box((-size / 8, -size / 4, -size / 8), (size / 8, size / 4, size / 4)), domain)
    assert min(deflection.lattice.shape) >= 4
    sound(deflection, domain)
    points = size * np.array([[-0.2, 0.0, 0.1], [0.0, 0.4, 0.1]])
    before, beside = np.linalg.norm(total(deflection, points), axis=1) / law_of_the_wall(points[:, 2], 0.03, 2.0)
    assert before < 0.75 < 1.0 < beside


def test_thin_domains_and_domains_high_above_the_ground_are_meshed():
    flat = Domain((-500.0, -500.0, 0.0), (500.0, 500.0, 0.02))
    assert math.prod(Lattice.around(flat).shape) <= MOST
    high = Domain((-4.0, -4.0, 50.0), (4.0, 4.0, 54.0))
    deflection = blocked_wind(box((-1, -1, 51), (1, 1, 53)), high)
    assert not deflection.lattice.grounded
    sound(deflection, high)
    assert np.abs(deflection.fluxes[2][..., 0]).max() > 1e-3  # air passes below the domain


def test_a_domain_without_end_is_refused():
    with pytest.raises(ValueError, match="finite domain"):
        Deflection.of(wall(1.0), Domain((-4, -4, 0), (math.inf, 4, 4)), Wind())


@pytest.mark.parametrize("off", [-1e-5, -1e-7, 0.0, 1e-7, 1e-5])
def test_a_wall_through_cell_centres_is_not_missed(off):
    lattice = Lattice.around(DOMAIN)
    for index in range(3, 20):
        middle = lattice.lower[0] + lattice.cell * (index + 0.5 + off)
        plane = mesh([[middle, -50, -50], [middle, 50, -50], [middle, 0, 80]], [[0, 1, 2]])
        assert (~open_faces(plane, lattice)[0]).any(0).all()
