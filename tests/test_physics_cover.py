"""The cover: heaps are cones at the angle of repose, nothing is lost, steep places keep a film, tables keep the floor bare."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.columns import DROP, WALL
from pgsd_nerfstudio.physics.cover import Cover, CoverConfig
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -2.5), (2.0, 2.0, 3.0))
SQUARE = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def plane(degrees: float = 0.0) -> SurfaceMesh:
    """Rises with x."""
    corners = 3 * SQUARE
    corners[:, 2] = math.tan(math.radians(degrees)) * corners[:, 0]
    return SurfaceMesh(corners, FACES)


def table() -> SurfaceMesh:
    """1 m wide, 0.7 m above a floor."""
    vertices = torch.cat([3 * SQUARE, 0.5 * SQUARE + torch.tensor([0, 0, 0.7])])
    return SurfaceMesh(vertices, torch.cat([FACES, FACES + 4]))


def poured(cover: Cover, at: tuple[float, float], volume: float, parts: int = 200) -> Cover:
    for _ in range(parts):
        cover.deposit(np.array([[*at, 0.0]]), np.array([volume / parts]), np.array([0.08]))
        assert cover.relax()
    return cover


@pytest.mark.parametrize("degrees", [25.0, 33.0, 45.0])
def test_a_heap_is_a_cone_at_the_angle_of_repose(degrees):
    volume = 0.02
    cover = poured(Cover.of(plane(), DOMAIN, CoverConfig(repose_degrees=degrees, film=0.0)), (0.31, -0.2), volume)
    assert cover.volume == pytest.approx(volume, rel=1e-12)
    c = cover.columns
    at = c.lower + c.cell * (np.stack(np.unravel_index(c.column, c.shape), 1) + 0.5) - [0.31, -0.2]
    away = np.linalg.norm(at, axis=1)
    flank = (cover.heights > 0.3 * cover.thickest) & (cover.heights < 0.8 * cover.thickest)
    rise = np.polyfit(away[flank], cover.heights[flank], 1)[0]
    assert math.degrees(math.atan(-rise)) == pytest.approx(degrees, abs=3.0)
    radius = (3 * volume / (math.pi * math.tan(math.radians(degrees)))) ** (1 / 3)
    assert cover.thickest == pytest.approx(radius * math.tan(math.radians(degrees)), rel=0.15)
    widths = []
    for turn in np.arange(0, 180, 22.5):
        along = at @ [math.cos(math.radians(turn)), math.sin(math.radians(turn))]
        widths.append(math.sqrt((cover.heights * along**2).sum() / cover.heights.sum()))
    assert max(widths) / min(widths) < 1.05
    assert np.mean(widths) == pytest.approx(radius * math.sqrt(0.15), rel=0.05)  # of a cone


@pytest.mark.parametrize(("slope", "stays"), [(20.0, True), (60.0, False)])
def test_steep_slopes_keep_a_film_and_gentle_ones_all(slope, stays):
    config = CoverConfig(repose_degrees=40.0, film=0.004)
    cover = Cover.of(plane(slope), DOMAIN, config)
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.6, 0.6, (4000, 2))
    points = np.column_stack([xy, math.tan(math.radians(slope)) * xy[:, 0]])
    missed = cover.deposit(points, np.full(4000, 2e-5), np.full(4000, 0.1))
    assert missed == 0.0
    assert cover.relax()
    assert cover.volume == pytest.approx(0.08, rel=1e-12)
    c = cover.columns
    x = c.lower[0] + c.cell * (c.column // c.shape[1] + 0.5)
    upper = np.abs(x) < 0.4
    if stays:
        assert cover.heights[upper].max() > 0.03
    else:
        assert cover.heights[upper & (x > -0.3)].max() <= config.film + config.slack + 1e-3
        assert (cover.heights * x).sum() / cover.heights.sum() < -0.6  # down the slope


def test_snow_on_a_table_leaves_the_floor_below_bare_and_falls_over_its_edges():
    cover = Cover.of(table(), DOMAIN, CoverConfig(repose_degrees=45.0))
    top = cover.columns.base > 0.5
    assert int(top.sum()) == 400  # 1 m^2 of squares of 5 cm, and the floor goes on below
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (500, 2)), np.full(500, 0.7)])
    cover.deposit(points, np.full(500, 2e-5), np.full(500, 0.05))
    cover.relax()
    assert cover.heights[~top].sum() == 0.0
    cover.deposit(np.array([[0.0, 0.0, 0.7]]), np.array([0.4]), np.array([0.1]))
    assert cover.relax()
    assert cover.volume == pytest.approx(0.41, rel=1e-12)
    assert cover.heights[~top].sum() > 0.1 / cover.columns.cell**2
    edge = np.abs(cover.columns.lower[0] + cover.columns.cell * (cover.columns.column // 80 + 0.5)) > 0.47
    assert cover.heights[top & edge].max() < 0.05


def test_sheets_end_at_drops_and_walls():
    c = Cover.of(table(), DOMAIN).columns
    top = c.base > 0.5
    assert (c.neighbours[top] == DROP).any() and not (c.neighbours[top] == WALL).any()
    assert not (c.neighbours[~top] == DROP).any()
    floor_beside = (~top)[:, None] & (c.neighbours >= 0)
    assert not top[c.neighbours[floor_beside]].any()  # the floor goes on under the table, not onto it


def test_what_lies_only_grows_where_nothing_is_put_on_top():
    cover, rng = Cover.of(plane(15.0), DOMAIN, CoverConfig(repose_degrees=35.0)), np.random.default_rng(1)
    before = cover.heights.copy()
    for _ in range(20):
        xy = rng.uniform(-1, 1, (50, 2))
        points = np.column_stack([xy, math.tan(math.radians(15)) * xy[:, 0]])
        cover.deposit(points, rng.uniform(0, 2e-4, 50), np.full(50, 0.08))
        cover.relax()
        assert (cover.heights >= before - 1e-12).all()
        before = cover.heights.copy()


def test_thickness_is_read_smoothly_and_the_slope_is_that_of_the_raised_surface():
    cover = Cover.of(plane(10.0), DOMAIN)
    c = cover.columns
    x = c.lower[0] + c.cell * (c.column // c.shape[1] + 0.5)
    cover.heights[:] = 0.2 + 0.1 * x
    at = np.random.default_rng(0).uniform(-1.5, 1.5, (300, 2))
    points = np.column_stack([at, math.tan(math.radians(10)) * at[:, 0]])
    np.testing.assert_allclose(cover.height(points), 0.2 + 0.1 * at[:, 0], atol=1e-9)
    rise = math.tan(math.radians(10)) + 0.1
    expected = np.array([-rise, 0, 1]) / math.hypot(rise, 1)
    np.testing.assert_allclose(cover.normal(points), np.broadcast_to(expected, (300, 3)), atol=1e-5)


def test_a_run_goes_on_from_a_snapshot():
    first = poured(Cover.of(plane(), DOMAIN), (0.0, 0.0), 0.01, 50)
    again = Cover.of(plane(), DOMAIN)
    again.restore(first.snapshot())
    for cover in (first, again):
        poured(cover, (0.1, 0.0), 0.01, 50)
    np.testing.assert_array_equal(first.heights, again.heights)


def test_hard_cases():
    empty = Cover.of(SurfaceMesh.empty(), DOMAIN)
    points = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert empty.deposit(points, np.ones(3), np.full(3, 0.1)) == 3.0
    assert empty.relax() and empty.volume == 0.0 and empty.thickest == 0.0
    cover = Cover.of(plane(), DOMAIN)
    assert cover.deposit(points, np.array([1e-3, 1.0, 2.0]), np.array([0.0, 0.1, 0.1])) == 3.0  # no number, and outside
    assert cover.volume == pytest.approx(1e-3)
    np.testing.assert_array_equal(cover.height(points[1:]), 0.0)
    cover.deposit(points[:1], np.array([10.0]), np.array([0.1]))
    done = [cover.relax() for _ in range(60)]  # as high as a house: more than one call may move
    assert not done[0] and done[-1]
    assert cover.volume == pytest.approx(10.001)
    with pytest.raises(ValueError, match="must be finite and not negative"):
        cover.deposit(points[:1], np.array([-1.0]), np.array([0.1]))
    flipped = SurfaceMesh(table().vertices, table().triangles[:, [0, 2, 1]])
    assert len(Cover.of(flipped, DOMAIN).columns) == 0  # nothing looks up
    with pytest.raises(ValueError, match="angle of repose"):
        CoverConfig(repose_degrees=90.0)
