"""Puddles in pictures: what they mirror, rings and crowns of drops, and that each can be switched off."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import RAINFALL, InitialLook, ParticleLook
from pgsd_nerfstudio.physics.bodies import DRIPPED, SLID, SPLASHED
from pgsd_nerfstudio.physics.ground.standing_water import StandingWater
from pgsd_nerfstudio.physics.laws.water_waves import crater_depth, elevation
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.rendering.moment import Viewpoint
from pgsd_nerfstudio.response.crowns import LIVES, crowns_of
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.impacts import Impacts
from pgsd_nerfstudio.response.landed import in_place
from pgsd_nerfstudio.response.light import mirrored
from pgsd_nerfstudio.response.mirrored_scene import MirroredScene
from pgsd_nerfstudio.response.puddles import Puddles, reflected
from pgsd_nerfstudio.response.ripples import DEPTH, SPREADS, Ripples, tilted
from pgsd_nerfstudio.response.wet_light import under_water
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

RED = (0.8, 0.2, 0.2)
DEEP = replace(RAINFALL, appearance=replace(RAINFALL.appearance, legibility=1.0))


def _wall() -> SurfaceMesh:
    """A wall 4 m high at y = 3 that faces -y."""
    corners = torch.tensor([[-20.0, 3, -1], [20, 3, -1], [20, 3, 4], [-20, 3, 4]])
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def _ground(side: int = 41) -> Gaussians:
    at = torch.linspace(-1, 1, side)
    means = torch.cartesian_prod(at, at)
    means = torch.cat([means, torch.zeros(len(means), 1)], 1)
    count = len(means)
    scales = torch.tensor([0.004, 0.004, 0.0005]).repeat(count, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 0.9), torch.full((count, 3), 0.4))


def _puddles(effect=DEEP) -> Puddles:
    """A pan of 2 m, 1 cm deep, before a red wall."""
    ground = _ground()
    cell = 0.05
    heights = np.full((60, 60), 0.01)
    heights[8:52, 8:52] = 0.0
    water = StandingWater.on(heights, np.array([-1.475, -1.475]), cell)
    red = linear(torch.tensor(RED)).repeat(4, 1)
    scene = MirroredScene(_wall(), red, torch.zeros(4, 8, 3), torch.ones(4, 8))
    count = len(ground)
    up = torch.tensor([0.0, 0, 1]).repeat(count, 1)
    ones = torch.ones(count)
    exposure = Exposure(up, torch.zeros(count, dtype=torch.bool), ones, ones, ones)
    return Puddles.of(effect, Frame(1.0, torch.eye(3), torch.zeros(3)), ground, exposure, water, scene)


def _mirror(puddles: Puddles, towards: torch.Tensor):
    count = len(puddles.points)
    now = puddles.at(8.0)
    assert now.share.min() == 1
    return now.mirror(torch.arange(count), towards.repeat(count, 1), torch.ones(count), 0.0)


@pytest.mark.parametrize("degrees", [20.0, 45.0, 70.0, 85.0])
def test_still_water_mirrors_the_wall_by_fresnels_law(degrees: float):
    """Rays towards +y meet the red wall below 4 m, and the open sky above it, of which there is no light here."""
    angle = np.radians(degrees)
    towards = torch.tensor([0.0, -np.sin(angle), np.cos(angle)]).float()
    light, kept = _mirror(_puddles(), towards)
    share = mirrored(torch.tensor([np.cos(angle)]).float())
    assert kept == pytest.approx(share.expand(len(kept)).numpy(), rel=1e-4)
    reach = (3 - _puddles().points[:, 1]) / np.tan(angle)
    met = reach < 4
    expected = torch.where(met[:, None], share * linear(torch.tensor(RED)), torch.zeros(3))
    clear = (reach - 4).abs() > 0.01
    bright = share > 0.004
    assert torch.allclose(light[clear], expected[clear] * bright, atol=1e-5)


def test_a_mirrored_direction_is_as_steep_as_the_view_and_never_below_the_horizon():
    towards = torch.nn.functional.normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)), dim=1).abs()
    up = torch.tensor([0.0, 0, 1]).repeat(100, 1)
    away = reflected(towards, up)
    assert torch.allclose(away[:, 2], towards[:, 2].clamp_min(0.01), atol=1e-3)
    assert (reflected(towards, tilted(np.full((100, 2), 0.5)))[:, 2] > 0).all()


def test_legible_water_mirrors_more_and_never_more_than_all():
    towards = torch.tensor([0.0, -np.sin(1.45), np.cos(1.45)]).float()
    looks = [replace(RAINFALL.appearance, legibility=legibility) for legibility in (1.0, 4.0, 81.0)]
    light = [_mirror(_puddles(replace(RAINFALL, appearance=look)), towards) for look in looks]
    assert light[1][1].mean() == pytest.approx(min(2 * float(light[0][1].mean()), 1.0), rel=1e-5)
    assert light[2][1].max() <= 1.0


def test_without_puddles_and_mirror_nothing_stands_and_the_sky_is_even():
    dry = _puddles(replace(RAINFALL, surface=replace(RAINFALL.surface, puddles=False)))
    assert dry.at(8.0).share.max() == 0
    plain = _puddles(replace(DEEP, surface=replace(DEEP.surface, mirror=False)))
    towards = torch.tensor([0.0, -np.sin(1.2), np.cos(1.2)]).float()
    light, kept = _mirror(plain, towards)
    assert DEEP.ambience is not None
    assert torch.allclose(light[0] / kept[0], linear(torch.tensor(DEEP.ambience.sky)), atol=1e-5)


def test_ground_under_water_is_darker_by_what_angstrom_says():
    """R = (1 - r_o)(1 - r_i) a / (1 - r_i a)."""
    light = torch.tensor([[0.3, 0.1, 0.0]])
    found = under_water(light, torch.ones(1))
    assert found[0, 0].item() == pytest.approx(0.934 * 0.523 * 0.3 / (1 - 0.477 * 0.3), rel=1e-3)
    assert torch.equal(under_water(light, torch.zeros(1)), light)


def test_slopes_of_ripples_are_those_of_their_ring():
    """One drop; the slope of the elevation by differences, in float64."""
    spread, depth = SPREADS[1], crater_depth(np.array([2e-6]), np.array([SPREADS[1]]))
    ripples = Ripples(np.array([1.0]), np.array([[0.2, -0.1]]), depth, np.array([1]))
    angle, radii = 0.7, np.array([0.03, 0.06, 0.09])
    points = np.array([0.2, -0.1]) + radii[:, None] * np.array([np.cos(angle), np.sin(angle)])
    for age in (0.101, 0.2345):
        rise = elevation(radii + 1e-6, age, spread, DEPTH) - elevation(radii - 1e-6, age, spread, DEPTH)
        expected = depth[0] * rise / 2e-6
        found = ripples.slopes(points, 1.0 + age)
        along = found @ np.array([np.cos(angle), np.sin(angle)])
        across = found @ np.array([-np.sin(angle), np.cos(angle)])
        assert along == pytest.approx(expected, abs=0.05 * np.abs(expected).max())
        assert np.abs(across).max() < 1e-9
    assert not ripples.slopes(points, 0.9).any() and not ripples.slopes(points, 3.0).any()


def _drop(represents: float = 1.0) -> ParticleHistory:
    """A drop of 3 mm at 8 m/s that meets the ground a quarter into its fourth step, and one that leaves the air."""
    heights = torch.tensor([1.04, 0.72, 0.40, 0.08, 0.0])
    falls = torch.stack([torch.full((5,), 0.1), torch.full((5,), 0.2), heights], 1)
    leaves = torch.stack([torch.zeros(5), torch.zeros(5), torch.tensor([3.0, 2.68, 2.36, 2.04, 1.72])], 1)
    flat = torch.zeros(2, dtype=torch.bool)
    return ParticleHistory(
        births=torch.tensor([0, 0]).int(),
        ends=torch.tensor([5, 5]).int(),
        collided=flat,
        offsets=torch.tensor([0, 5, 10]),
        positions=torch.cat([falls, leaves]),
        rest_positions=torch.zeros(2, 3),
        rest_quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        rest_extents=torch.zeros(2),
        rest_covers=torch.zeros(2),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        diameters=torch.full((2,), 0.003),
        represents=torch.full((2,), represents),
        reaches=torch.full((2,), 1e9),
        kinds=torch.zeros(2, dtype=torch.uint8),
        fps=25.0,
        frames=20,
    )


def test_an_impact_is_where_and_when_a_step_was_cut_short():
    impacts = Impacts.of(_drop())
    assert len(impacts) == 1
    assert impacts.times[0] == pytest.approx(3.25 / 25)
    assert impacts.places[0] == pytest.approx([0.1, 0.2, 0.0])
    assert impacts.speeds[0] == pytest.approx(8.0, rel=1e-4)
    many = Impacts.of(_drop(represents=4.0))
    assert len(many) == 4 and (np.diff(many.times) >= 0).all()
    assert (np.linalg.norm(many.places[:, :2] - [0.1, 0.2], axis=1) < 0.36).all()


def _view() -> Viewpoint:
    """From 1 m above the ground at y = -1.2 m, down to the middle."""
    forward = torch.nn.functional.normalize(torch.tensor([0.0, 1.2, -1.0]), dim=0)
    right = torch.tensor([1.0, 0, 0])
    turn = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -(turn @ torch.tensor([0.0, -1.2, 1.0]))
    return Viewpoint(viewmat, torch.tensor([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]), 320, 240)


def test_rings_and_crowns_are_drawn_where_the_drop_fell_and_only_while_they_last():
    struck = _puddles().struck_by(_drop())
    below = lambda ids: torch.full((len(ids), 3), 0.3)  # noqa: E731
    young = struck.at(0.15).drawn(_view(), below, 1.0)
    assert young is not None and young.antialiased
    away = (young.means[:, :2] - torch.tensor([0.1, 0.2])).norm(dim=1)
    assert away.max() < 0.15
    assert struck.at(0.05).drawn(_view(), below, 1.0) is None
    assert struck.at(2.0).drawn(_view(), below, 1.0) is None
    older = struck.at(0.35).drawn(_view(), below, 1.0)
    assert older is not None
    # The ring has moved out at about the least speed of energy on water, 18 cm/s, or faster.
    assert (older.means[:, :2] - torch.tensor([0.1, 0.2])).norm(dim=1).median() > away.median() + 0.02
    quiet = replace(DEEP, surface=replace(DEEP.surface, ripples=False, splash=None))
    assert _puddles(quiet).struck_by(_drop()).at(0.15).drawn(_view(), below, 1.0) is None


def _crown(age: float, legibility: float = 1.0) -> Gaussians:
    """Of a drop of 3 mm at 8 m/s."""
    drop = Impacts(np.array([1.0]), np.array([[0.1, 0.2, 0.0]]), np.array([0.003]), np.array([8.0]))
    ground, sky = torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([0.5, 0.6, 0.7])
    return crowns_of(drop, 1.0 + age * LIVES, ground, sky, 0.22, legibility)


@pytest.mark.parametrize("age", [0.02, 0.1, 0.5])
def test_a_crown_is_as_wide_and_high_as_it_is_in_nature(age: float):
    """Yarin & Weiss (1995) on a film of half a diameter, up to 1.6 diameters."""
    crown, drop = _crown(age), 0.003
    radius = (crown.means[:, :2] - torch.tensor([0.1, 0.2])).norm(dim=1)
    expected = min(drop * (2 / 3) ** 0.25 * np.sqrt(8.0 * age * LIVES / (drop / 2)), 1.6 * drop)
    assert radius.numpy() == pytest.approx(expected, rel=1e-3)
    top = crown.means[:, 2] + crown.scales[:, 2]
    assert top.max() <= 3.1 * drop + 0.002
    # A jet covers as much as a disc of 0.22 diameters does: 2 pi s^2.
    assert crown.scales[:, 0].numpy() == pytest.approx(0.36 * 0.22 * drop, rel=1e-5)
    assert _crown(age, 9.0).scales[:, 0].numpy() == pytest.approx(3 * 0.36 * 0.22 * drop, rel=1e-5)
    assert torch.equal(_crown(age, 9.0).means, crown.means)


def test_the_water_of_a_crown_shows_half_of_the_ground_and_half_of_the_sky():
    light = linear(_crown(0.3).colors)
    assert torch.allclose(light, torch.tensor([0.3, 0.4, 0.5]).expand(len(light), 3), atol=1e-4)


@pytest.mark.mistyped
def test_what_drips_or_slides_is_seen_at_its_own_size_and_what_falls_at_its_legible_one():
    kinds = torch.tensor([0, SPLASHED, DRIPPED, DRIPPED | SPLASHED, SLID], dtype=torch.uint8)
    history = SimpleNamespace(kinds=kinds, collided=torch.zeros(5, dtype=torch.bool))
    look = ParticleLook(torch.ones(5), torch.full((5, 3), 0.006), torch.ones(5, 3))
    appearance = replace(RAINFALL.appearance, legibility=4.0, nearness=2.25)
    answer = SimpleNamespace(
        effect=replace(RAINFALL, appearance=appearance), exposure=SimpleNamespace(loose=torch.zeros(1, dtype=torch.bool))
    )
    found = in_place(InitialLook(look, look, 0.0), history, answer, _ground(2)).active
    assert found.scales[:, 0].tolist() == pytest.approx([0.006, 0.006, 0.002, 0.006, 0.002])


def test_a_part_of_the_scene_keeps_its_own_puddles():
    puddles = _puddles()
    which = torch.arange(0, len(puddles.points), 3)
    some = puddles.each(lambda tensor: tensor[which])
    assert torch.equal(some.points, puddles.points[which])
    assert torch.equal(some.at(8.0).share, puddles.at(8.0).share[which])
    near, number = some.bottom.query(puddles.points[3, :2].numpy())
    assert near < 1e-6 and some.bottom_ids[number] == 1
