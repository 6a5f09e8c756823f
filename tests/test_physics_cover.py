"""The cover: heaps are cones at the angle of repose, nothing is lost, steep places keep a film, tables keep the floor bare."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.columns import AROUND, BORDER, DROP, WALL, Columns
from pgsd_nerfstudio.physics.ground.cover import Cover, CoverConfig
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -3.5), (2.0, 2.0, 3.6))
SMALL = Domain((-1.0, -1.0, -0.5), (1.0, 1.0, 1.5))
SQUARE = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def mesh_of(*squares: torch.Tensor) -> SurfaceMesh:
    """Of squares by their corners."""
    return SurfaceMesh(torch.cat(squares), torch.cat([FACES + 4 * n for n in range(len(squares))]))


def raised(size: float, height: float, degrees: float = 0.0) -> torch.Tensor:
    """Corners of a square of 2 `size` metres that rises with x."""
    corners = size * SQUARE
    corners[:, 2] = height + math.tan(math.radians(degrees)) * corners[:, 0]
    return corners


def plane(degrees: float = 0.0) -> SurfaceMesh:
    return mesh_of(raised(3, 0.0, degrees))


def table(height: float = 0.7) -> SurfaceMesh:
    """1 m wide, over a floor."""
    return mesh_of(raised(3, 0.0), raised(0.5, height))


def ring(inner: float) -> list[torch.Tensor]:
    """A floor around a square without floor, whose corners go into each other."""
    low = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, -inner, 0], [-3, -inner, 0]])
    turns = [torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return [low @ turn.T for turn in turns]


def rough() -> SurfaceMesh:
    """Ground with bumps of 7 cm, steeper than any repose in places, below a table and 60 slanting leaves."""
    rng, axis = np.random.default_rng(3), np.linspace(-1.2, 1.2, 25)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    ground = np.stack([x, y, rng.normal(0, 0.07, x.shape)], -1).reshape(-1, 3)
    corner = (25 * np.arange(24)[:, None] + np.arange(24)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 25, corner + 26], 1), np.stack([corner, corner + 26, corner + 1], 1)])
    arms = rng.normal(0, 0.12, (60, 2, 3))
    down = np.cross(arms[:, 0], arms[:, 1])[:, 2] < 0
    arms[down] = arms[down][:, ::-1]
    middle = rng.uniform([-0.9, -0.9, 0.2], [0.9, 0.9, 0.5], (60, 3))
    leaves = np.stack([middle, middle + arms[:, 0], middle + arms[:, 1]], 1).reshape(-1, 3)
    corners = np.concatenate([ground, leaves, raised(0.4, 0.9).numpy()])
    faces = np.concatenate([faces, len(ground) + np.arange(180).reshape(-1, 3), len(ground) + 180 + FACES.numpy()])
    return SurfaceMesh(torch.from_numpy(corners).float(), torch.from_numpy(faces).int())


def poured(cover: Cover, at: tuple[float, float], volume: float, parts: int = 200) -> Cover:
    for _ in range(parts):
        cover.deposit(np.array([[*at, 0.0]]), np.array([volume / parts]), np.array([0.08]))
        assert cover.relax()
    return cover


def scattered(cover: Cover, count: int, volume: float, rng: np.random.Generator) -> float:
    """Drop `count` particles anywhere on the raised surfaces; the volume that found no level."""
    c = cover.columns
    level = rng.integers(len(c.base), size=count)
    points = c.centres[level] + [0, 0, 1] * cover.heights[level, None]
    points[:, :2] += c.cell * rng.uniform(-0.5, 0.5, (count, 2))
    return cover.deposit(points, np.full(count, volume), rng.uniform(0.0, 0.15, count))


def steepest(cover: Cover, level: int) -> float:
    """Steepest descent, in rise per run, from a level over its sheet: planes through three tops, and edges."""
    c = cover.columns
    tops = c.base + cover.heights
    arms = []
    for k, other in enumerate(c.neighbours[level]):
        arms.append(np.array([*(c.cell * AROUND[k]), tops[other] - tops[level]]) if other >= 0 else None)
    slopes = [-arm[2] / math.hypot(arm[0], arm[1]) for arm in arms if arm is not None]
    for k in range(4):
        for d in (4 + k, 4 + (k + 3) % 4):
            if arms[k] is None or arms[d] is None:
                continue
            normal = np.cross(arms[k], arms[d])
            downhill = normal[:2] / normal[2]
            shares = np.linalg.solve(np.stack([arms[k][:2], arms[d][:2]], 1), downhill)
            if (shares >= 0).all():  # the plane falls into this triangle
                slopes.append(math.hypot(*downhill))
    return max(slopes, default=-math.inf)


@pytest.mark.parametrize("degrees", [25.0, 33.0, 45.0])
def test_a_heap_is_a_cone_at_the_angle_of_repose(degrees):
    volume, middle, steep = 0.05, np.array([0.31, -0.2]), math.tan(math.radians(degrees))
    cover = poured(Cover.of(plane(), DOMAIN, CoverConfig(repose_degrees=degrees, film=0.0)), (0.31, -0.2), volume)
    assert cover.volume == pytest.approx(volume, rel=1e-12)
    c = cover.columns
    at = c.centres[:, :2] - middle
    flank = (cover.heights > 0.25 * cover.thickest) & (cover.heights < 0.8 * cover.thickest)
    along = np.gradient(cover.heights.reshape(c.shape), c.cell)
    slopes = np.degrees(np.arctan(np.hypot(*along))).ravel()[flank]
    assert slopes.max() < degrees + 1.0 and slopes.min() > degrees - 3.0
    radius = (3 * volume / (math.pi * steep)) ** (1 / 3)
    assert cover.thickest == pytest.approx(radius * steep, rel=0.1)
    out, contour = np.linspace(0, 1.2 * radius, 600), []
    for turn in np.radians(np.arange(0, 360, 7.5)):
        line = middle + out[:, None] * [math.cos(turn), math.sin(turn)]
        contour.append(out[np.argmax(cover.height(np.column_stack([line, 0 * out])) < 0.3 * radius * steep)])
    assert max(contour) / min(contour) < 1.075  # an octagon has 1.082
    assert np.mean(contour) == pytest.approx(0.7 * radius, rel=0.02)
    assert np.sqrt((cover.heights @ at**2) / cover.heights.sum()) == pytest.approx(radius * math.sqrt(0.15), rel=0.02)


def test_nowhere_is_cover_steeper_than_repose_on_rough_ground_with_leaves_and_a_table():
    config, rng = CoverConfig(repose_degrees=38.0), np.random.default_rng(0)
    cover = Cover.of(rough(), SMALL, config)
    for _ in range(15):
        scattered(cover, 300, 1e-4, rng)
        assert cover.relax()
    loose = (cover.heights > config.film + 2 * config.slack).nonzero()[0]
    assert len(loose) > 1500
    allowed = math.tan(math.radians(38)) + 2 * config.slack / cover.columns.cell
    assert max(steepest(cover, level) for level in loose) < allowed


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_lost_or_made_and_what_lies_only_grows(seed):
    cover, rng = Cover.of(rough(), SMALL, CoverConfig(repose_degrees=35.0)), np.random.default_rng(seed)
    given, before = 0.0, cover.heights.copy()
    for _ in range(40):
        given += 100 * 2e-4 - scattered(cover, 100, 2e-4, rng)
        assert cover.relax()
        assert (cover.heights >= before).all()
        before = cover.heights.copy()
    assert cover.lost > 0
    assert cover.volume + cover.lost == pytest.approx(given, rel=1e-12)


@pytest.mark.parametrize(("slope", "stays"), [(20.0, True), (60.0, False)])
def test_steep_slopes_keep_a_film_and_gentle_ones_all(slope, stays):
    config, rng = CoverConfig(repose_degrees=40.0, film=0.004), np.random.default_rng(0)
    cover = Cover.of(plane(slope), DOMAIN, config)
    xy = rng.uniform(-0.6, 0.6, (4000, 2))
    missed = cover.deposit(
        np.column_stack([xy, math.tan(math.radians(slope)) * xy[:, 0]]), np.full(4000, 2e-5), np.full(4000, 0.1)
    )
    fallen = cover.heights.copy()
    assert missed == 0.0
    assert cover.relax()
    if stays:
        inner = (np.abs(cover.columns.centres[:, :2]) < 0.4).all(1)
        assert fallen[inner].min() > 0.02
        np.testing.assert_array_equal(cover.heights[inner], fallen[inner])
    else:  # all the way down and out, where the slope goes on
        assert cover.thickest <= config.film + config.slack
        x, y = cover.columns.centres[:, :2].T
        path = (x < -0.7) & (np.abs(y) < 0.4)
        np.testing.assert_allclose(cover.heights[path], config.film, atol=config.slack)
        assert (cover.heights[x > 0.75] == 0).all()
        assert cover.lost > 0.06
    assert cover.volume + cover.lost == pytest.approx(0.08, rel=1e-9)


def test_cover_on_a_table_leaves_the_floor_below_bare_and_falls_over_its_edges():
    cover, rng = Cover.of(table(), DOMAIN), np.random.default_rng(0)
    top = cover.columns.base > 0.5
    assert int(top.sum()) == 400  # 1 m^2 of squares of 5 cm, and the floor goes on below
    points = np.column_stack([rng.uniform(-0.35, 0.35, (500, 2)), np.full(500, 0.7)])
    cover.deposit(points, np.full(500, 2e-5), np.full(500, 0.05))
    cover.relax()
    assert cover.heights[~top].sum() == 0.0
    cover.deposit(np.array([[0.0, 0.0, 0.7]]), np.array([0.4]), np.array([0.1]))
    assert cover.relax()
    assert cover.volume == pytest.approx(0.41, rel=1e-12) and cover.lost == 0.0
    assert cover.heights[~top].sum() > 0.1 / cover.columns.cell**2
    x, y = np.abs(cover.columns.centres[:, :2]).T
    assert cover.heights[top & (np.maximum(x, y) > 0.47)].max() < 0.05
    assert (cover.heights[~top & (np.maximum(x, y) < 0.2)] == 0).all()
    x, y = cover.columns.centres[:, :2].T
    sides = [cover.heights[~top & (side > 0.5)].sum() for side in (x, y, -x, -y)]
    assert max(sides) / min(sides) < 1.15  # the column of 50 m falls apart one side after the other


@pytest.mark.parametrize("surface", [mesh_of(raised(0.5, 0.7)), mesh_of(*ring(0.5))], ids=["a plate in the air", "a hole"])
def test_what_runs_over_an_edge_with_nothing_below_leaves_and_is_counted(surface):
    cover = Cover.of(surface, DOMAIN)
    start = cover.columns.centres[np.argmin(np.linalg.norm(cover.columns.centres[:, :2] - [0.55, 0.0], axis=1))]
    cover.deposit(start[None], np.array([0.3]), np.array([0.1]))
    assert cover.relax()
    assert cover.lost > 0.02
    assert cover.volume + cover.lost == pytest.approx(0.3, rel=1e-12)


def test_the_border_of_the_domain_mirrors_level_ground():
    half = Cover.of(plane(), Domain((0.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    whole = Cover.of(plane(), Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    for _ in range(60):
        half.deposit(np.array([[0.1, 0.0, 0.0]]), np.array([5e-4]), np.array([0.09]))
        whole.deposit(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]), np.full(2, 5e-4), np.full(2, 0.09))
        assert half.relax() and whole.relax()
    assert half.lost == 0.0
    np.testing.assert_allclose(half.heights, whole.heights[whole.columns.centres[:, 0] > 0], atol=0.004)


def test_cover_that_reaches_over_a_step_flows_onto_it():
    """A block of 0.4 m without floor under it: a heap beside it first leans on it, then runs over it."""
    surface = mesh_of(*ring(0.6), raised(0.6, 0.4))
    cover = Cover.of(surface, DOMAIN)
    block = cover.columns.base > 0.2
    side = (~block & (np.abs(cover.columns.centres[:, :2] - [0.625, 0.025]).max(1) < 0.01)).nonzero()[0]
    assert WALL in cover.columns.neighbours[side] and not (cover.columns.neighbours[side] == DROP).any()
    at = cover.columns.centres[side]
    for _ in range(10):
        cover.deposit(at, np.array([0.0025]), np.array([0.05]))
        assert cover.relax()
    assert 0.2 < cover.heights[side[0]] < 0.4 and cover.heights[block].sum() == 0.0
    for _ in range(120):
        cover.deposit(np.add(at, [0, 0, cover.heights[side[0]]]), np.array([0.0025]), np.array([0.05]))
        assert cover.relax()
    assert cover.heights[block].sum() > 0
    edge = (block & (np.abs(cover.columns.centres[:, :2] - [0.575, 0.025]).max(1) < 0.01)).nonzero()[0]
    drop = cover.heights[side] - 0.4 - cover.heights[edge]
    assert drop[0] < 0.05 + 2 * cover.config.slack


def test_levels_end_at_drops_walls_and_the_border():
    c = Cover.of(table(), DOMAIN).columns
    top = c.base > 0.5
    assert (c.neighbours[top] == DROP).any() and not (c.neighbours[top] == WALL).any()
    assert not (c.neighbours[~top] == DROP).any()
    assert not top[c.neighbours[~top & (c.neighbours >= 0).all(1)]].any()  # the floor goes on under the table, not onto it
    assert not top[c.beyond[c.neighbours == DROP]].any()
    border = (np.abs(c.centres[:, :2]) > 1.95).any(1)
    np.testing.assert_array_equal((c.neighbours == BORDER).any(1), border)
    roofed = Columns.of(mesh_of(raised(3, 0.0), raised(0.5, 0.7), raised(3, 1.4)), DOMAIN, 0.05, 0.1)
    edge = roofed.beyond[roofed.neighbours == DROP]
    assert len(edge) > 0 and np.abs(roofed.base[edge]).max() < 1e-6  # things fall to the floor, whatever is above


def test_levels_are_all_surfaces_that_look_up_unless_another_is_close_above():
    shelves = [raised(0.5, height) for height in (0.0, 0.05, 0.3, 0.45)]
    levels = Columns.of(mesh_of(*shelves), SMALL, 0.1, gap=0.1)
    np.testing.assert_allclose(np.unique(levels.base.round(4)), [0.05, 0.3, 0.45])
    leaves = Columns.of(mesh_of(*(raised(0.2, 0.2 * n - 3.1) for n in range(33))), DOMAIN, 0.1, gap=0.1)
    assert len(leaves.base) == 33 * 16
    ceiling = mesh_of(raised(0.5, 0.0), raised(0.5, 1.0) * torch.tensor([-1.0, 1, 1]))
    np.testing.assert_allclose(Columns.of(ceiling, SMALL, 0.1, gap=0.1).base, 0.0, atol=1e-6)
    above = Columns.of(plane(), Domain((-1, -1, 0.2), (1, 1, 1)), 0.1, gap=0.1)
    assert len(above.base) == 0


def test_squares_grow_rather_than_become_more_than_400_000():
    columns = Columns.of(SurfaceMesh.empty(), Domain((0, 0, 0), (300, 40, 2)), 0.05, 0.1)
    assert columns.cell == pytest.approx(math.sqrt(300 * 40 / 400_000))
    assert np.prod(columns.shape) < 403_000


def test_a_disc_stays_on_its_sheet_and_keeps_its_middle():
    cover = Cover.of(table(0.25), DOMAIN, CoverConfig(tolerance=0.05))
    top = cover.columns.base > 0.1
    cover.deposit(np.array([[0.45, 0.0, 0.25]]), np.array([1e-3]), np.array([0.3]))
    assert cover.heights[~top].sum() == 0.0
    assert cover.volume == pytest.approx(1e-3, rel=1e-12)
    flat, rng = Cover.of(plane(), DOMAIN), np.random.default_rng(0)
    at, radius = rng.uniform(-1, 1, (50, 2)), 0.4
    flat.deposit(np.column_stack([at, np.zeros(50)]), np.full(50, 1e-3), np.full(50, radius))
    centre = flat.heights @ flat.columns.centres[:, :2] / flat.heights.sum()
    np.testing.assert_allclose(centre, at.mean(0), atol=1e-3)
    spread = (flat.heights @ flat.columns.centres[:, :2] ** 2) / flat.heights.sum() - (at**2).mean(0)
    np.testing.assert_allclose(spread, radius**2 / 6, rtol=0.05)  # of a paraboloid, along each axis


def test_deposits_in_another_order_make_the_same_cover():
    rng = np.random.default_rng(2)
    points, volumes = np.column_stack([rng.normal(0, 0.3, (400, 2)), np.zeros(400)]), rng.uniform(0, 4e-4, 400)
    covers = []
    for order in (np.arange(400), rng.permutation(400)):
        together, one_by_one = (Cover.of(plane(), DOMAIN, CoverConfig(tolerance=1.0)) for _ in range(2))
        together.deposit(points[order], volumes[order], np.full(400, 0.1))
        assert together.relax()
        for part in np.array_split(order, 40):
            one_by_one.deposit(points[part], volumes[part], np.full(len(part), 0.1))
            assert one_by_one.relax()
        covers += [together, one_by_one]
    first, bit, second, other_bit = (cover.heights for cover in covers)
    np.testing.assert_allclose(first, second, atol=1e-12)
    assert np.abs(bit - other_bit).mean() < 0.01 * bit[bit > 0].mean()
    assert np.abs(bit - other_bit).max() < 0.1 * covers[1].thickest
    assert np.abs(first - bit).mean() < 0.03 * bit[bit > 0].mean()


def test_thickness_is_read_smoothly_and_the_slope_is_that_of_the_raised_surface():
    cover = Cover.of(plane(10.0), DOMAIN)
    cover.heights[:] = 0.2 + 0.1 * cover.columns.centres[:, 0]
    at = np.random.default_rng(0).uniform(-1.9, 1.9, (300, 2))
    points = np.column_stack([at, math.tan(math.radians(10)) * at[:, 0]])
    np.testing.assert_allclose(cover.height(points), 0.2 + 0.1 * at[:, 0], atol=1e-9)
    rise = math.tan(math.radians(10)) + 0.1
    expected = np.array([-rise, 0, 1]) / math.hypot(rise, 1)
    np.testing.assert_allclose(cover.normal(points), np.broadcast_to(expected, (300, 3)), atol=1e-5)


def test_thickness_and_normals_do_not_jump_within_a_sheet_and_a_constant_is_kept_at_its_edges():
    cover = Cover.of(table(), DOMAIN)
    line = np.column_stack([np.linspace(-0.499, 0.499, 4001), np.full(4001, 0.487), np.full(4001, 0.7)])
    cover.heights[:] = 0.03
    np.testing.assert_allclose(cover.height(line), 0.03, rtol=1e-12)
    cover.heights[:] = np.random.default_rng(0).uniform(0, 0.05, len(cover.heights))
    assert np.abs(np.diff(cover.height(line))).max() < 3e-4
    assert np.abs(np.diff(cover.normal(line), axis=0)).max() < 0.02


def test_points_within_thick_cover_belong_to_it():
    cover = Cover.of(table(), DOMAIN)
    assert cover.find(np.array([[1.0, 1.0, 0.3], [0.0, 0.0, 0.4]])).tolist() == [-1, -1]
    cover.heights[cover.columns.base < 0.5] = 0.6
    points = np.array([[1.0, 1.0, z] for z in (0.0, 0.3, 0.6, 0.74)])
    np.testing.assert_allclose(cover.height(points), 0.6)
    np.testing.assert_allclose(cover.above(points), points[:, 2], atol=1e-6)
    assert cover.above(np.array([[1.0, 1.0, 0.8], [1.0, 1.0, -0.1]])).tolist() == [0.0, 0.0]
    assert cover.above(np.array([[0.0, 0.0, 0.82]]))[0] == pytest.approx(0.12, abs=1e-5)  # over the table


def test_a_run_goes_on_from_a_snapshot():
    config = CoverConfig(most_moves=1)
    first, again = Cover.of(mesh_of(raised(0.5, 0.0)), SMALL, config), Cover.of(mesh_of(raised(0.5, 0.0)), SMALL, config)
    first.deposit(np.zeros((1, 3)), np.array([0.2]), np.array([0.1]))
    while first.lost == 0.0:
        assert not first.relax()  # it takes many moves for each level
    again.restore(first.snapshot())
    for cover in (first, again):
        done = [cover.relax() for _ in range(500)]
        assert not done[0] and done[-1]
    np.testing.assert_array_equal(first.heights, again.heights)
    assert first.lost == again.lost > 0
    with pytest.raises(ValueError, match="with 400 levels was expected, got one with 1600"):
        first.restore(Cover.of(plane(), SMALL).snapshot())


def test_nothing_to_lie_on_holds_nothing():
    empty = Cover.of(SurfaceMesh.empty(), DOMAIN)
    points = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert empty.deposit(points, np.ones(3), np.full(3, 0.1)) == 3.0
    assert empty.relax() and empty.volume == empty.thickest == empty.lost == 0.0
    assert empty.height(points).tolist() == empty.above(points).tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(empty.normal(points), [[0.0, 0.0, 1.0]] * 3)
    assert len(Cover.of(SurfaceMesh(table().vertices, table().triangles[:, [0, 2, 1]]), DOMAIN).heights) == 0  # all look down


def test_a_flipped_triangle_in_a_floor_makes_no_hole():
    axis = torch.linspace(-1, 1, 41)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    corner = (41 * torch.arange(40)[:, None] + torch.arange(40)).flatten()
    faces = torch.cat([torch.stack([corner, corner + 41, corner + 42], 1), torch.stack([corner, corner + 42, corner + 1], 1)])
    faces[::97] = faces[::97, [0, 2, 1]]
    floor = SurfaceMesh(torch.stack([x, y, 0 * x], -1).reshape(-1, 3), faces.int())
    assert len(Columns.of(floor, SMALL, 0.05, 0.1).base) == 1600


def test_deposits_of_no_size_and_of_no_place():
    cover = Cover.of(plane(), DOMAIN)
    points = np.array([[0.01, 0.01, 0.0], [np.nan, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, np.inf], [2.0, 2.0, 0.0]])
    assert cover.deposit(points, np.array([1e-3, 1.0, 2.0, 4.0, 0.0]), np.array([0.0, 0.1, 0.1, 0.1, 0.1])) == 7.0
    assert cover.volume == pytest.approx(1e-3) and np.count_nonzero(cover.heights) == 1
    np.testing.assert_array_equal(cover.height(points[1:4]), 0.0)
    assert cover.deposit(np.zeros((0, 3)), np.zeros(0), np.zeros(0)) == 0.0
    assert cover.find(points).tolist()[-1] == len(cover.heights) - 1  # the border belongs to the domain


def test_ten_cubic_metres_at_one_place_find_theirs_or_say_so():
    cover = Cover.of(plane(), DOMAIN)
    cover.deposit(np.zeros((1, 3)), np.array([10.0]), np.array([0.1]))
    done = [cover.relax() for _ in range(20)]  # 300 m high at first: more than one call may move
    assert not done[0] and done[-1]
    assert cover.volume + cover.lost == pytest.approx(10.0, rel=1e-12)
    assert cover.thickest < 2.6


def test_bad_amounts_and_settings_are_refused():
    cover, point = Cover.of(plane(), SMALL), np.zeros((1, 3))
    with pytest.raises(ValueError, match=r"volumes of cover must be finite and not negative, got -1 m\^3"):
        cover.deposit(point, np.array([-1.0]), np.array([0.1]))
    with pytest.raises(ValueError, match="radii of cover must be finite and not negative, got nan m"):
        cover.deposit(point, np.array([1.0]), np.array([np.nan]))
    with pytest.raises(ValueError, match=r"one for each of 1 points, got \(2,\)"):
        cover.deposit(point, np.ones(2), np.array([0.1]))
    assert cover.volume == 0.0
    with pytest.raises(ValueError, match="angle of repose must lie in 0-90 degrees, got 90"):
        CoverConfig(repose_degrees=90.0)
    with pytest.raises(ValueError, match="positive cell, got 0"):
        CoverConfig(cell=0.0)
    with pytest.raises(ValueError, match="film must not be negative, got -1 m"):
        CoverConfig(film=-1.0)
