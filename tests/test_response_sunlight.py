"""The sun found from shadows, against scenes whose light is known: a box on a plane in closed form, the baked courtyard."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import roma
import torch

from pgsd_nerfstudio.response.rays import open_sky, ray_starts
from pgsd_nerfstudio.response.sun_search import FEWEST
from pgsd_nerfstudio.response.sunlight import Sunlight, find_sunlight, lit, overcast_factor
from pgsd_nerfstudio.scene.courtyard.baking import SUN, SUN_LIGHT, sky_light
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.weather.loading import load_scene

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
LOW, HIGH = np.array([-0.5, -0.4, 0.0]), np.array([0.5, 0.4, 1.2])  # of the box, m
HALF = 2.5  # of the plane, m
NOON = Sunlight(direction=(0.6, 0.0, 0.8), ratio=5.0, bounce=0.2, explained=0.1, certainty=9.0)


class Lit(NamedTuple):
    """Points whose light is known."""

    points: torch.Tensor
    normals: torch.Tensor
    luminance: torch.Tensor
    surface: SurfaceMesh


def toward(elevation: float, azimuth: float) -> np.ndarray:
    """Unit direction; degrees."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def degrees_between(sun: Sunlight, direction: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, float(np.dot(sun.direction, direction)))))


def meets_box(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether rays meet the box, by slabs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (LOW - points) / directions, (HIGH - points) / directions
    return np.maximum(np.minimum(a, b).max(-1), 0.0) < np.maximum(a, b).min(-1) - 1e-9


def box_on_plane(ratio: float, sun: np.ndarray, count: int = 3000) -> Lit:
    """A yard with a box in it: its ground and the box's four sides and top, in patches of albedo, each point speckled."""
    rng = np.random.default_rng(3)
    ground = np.concatenate([rng.uniform(-HALF, HALF, (count, 2)), np.zeros((count, 1))], axis=1)
    inside = ((ground > LOW - 1e-9) & (ground < HIGH)).all(1)
    ground = ground[~inside]
    faces = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)]
    sides, outward = [], []
    for axis, end in faces:
        side = rng.uniform(LOW, HIGH, (count // 40, 3))
        side[:, axis] = (LOW, HIGH)[end][axis]
        sides.append(side)
        outward.append(np.tile((2 * end - 1) * np.eye(3)[axis], (len(side), 1)))
    points = np.concatenate([ground, *sides])
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (len(ground), 1)), *outward])
    # Sky: of the box, half above its sides and all above its top; of the ground, what the box leaves.
    turn, radius = rng.uniform(0, 2 * np.pi, 300), np.sqrt(rng.uniform(0, 1, 300))
    rays = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], 1)
    open_sky = np.where(normals[:, 2] > 0.5, 1.0, 0.5)
    open_sky[: len(ground)] = 1 - np.mean([meets_box(ground, ray[None]) for ray in rays], axis=0)
    direct = np.clip(normals @ sun, 0, None)
    direct[: len(ground)] *= ~meets_box(ground, sun[None])
    patches = rng.normal(0, 0.35, (40, 40, 40))[tuple(np.floor(points / 0.4).astype(int).T + 20)]
    albedo = 0.3 * np.exp(patches + rng.normal(0, 0.25, len(points)))
    place, facing, luminance = (torch.from_numpy(a).float() for a in (points, normals, albedo * (open_sky + ratio * direct)))
    return Lit(place, facing, luminance, yard_mesh())


def yard_mesh() -> SurfaceMesh:
    corners = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).double()
    box = torch.from_numpy(LOW) + corners * torch.from_numpy(HIGH - LOW)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3)]
    floor = HALF * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    triangles = [t for a, b, c, d in [*quads, (8, 9, 10, 11)] for t in ((a, b, c), (a, c, d))]
    return SurfaceMesh(torch.cat([box.float(), floor]), torch.tensor(triangles, dtype=torch.int32))


@pytest.fixture(scope="module")
def courtyard() -> Lit:
    """The built-in scene with its film curve undone, so that luminance is what the baking computed."""
    scene = load_scene("demo")
    assert scene.mesh is not None
    surface = SurfaceMesh(scene.frame.to_metric(scene.mesh[0]), scene.mesh[1])
    # The thin axis of its surfels is the third and points to the open side.
    rotations = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(scene.gaussians.quats))
    normals = rotations[:, :, 2] @ scene.frame.rotation.T
    rgb = (scene.gaussians.colors[:, 0] * 0.28209479 + 0.5).clamp(0, 1).double()
    film = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    # film = e (1 + e / 6) / (1 + e), with e the exposed radiance
    exposed = 3 * (film - 1 + ((1 - film) ** 2 + 2 / 3 * film).sqrt())
    return Lit(scene.frame.to_metric(scene.gaussians.means), normals, (exposed @ torch.from_numpy(LUMINANCE)).float(), surface)


@pytest.fixture(scope="module")
def courtyard_sun(courtyard) -> Sunlight:
    sun = find_sunlight(*courtyard)
    assert sun is not None
    return sun


@pytest.mark.parametrize(("elevation", "azimuth", "ratio", "exposure"), [(30.0, 140.0, 5.0, 1.0), (55.0, -70.0, 3.0, 0.002)])
def test_the_shadow_of_a_box_tells_where_the_sun_stands_and_how_strong_it_is_at_any_exposure(
    elevation, azimuth, ratio, exposure
):
    direction = toward(elevation, azimuth)
    yard = box_on_plane(ratio, direction)
    sun = find_sunlight(*yard._replace(luminance=exposure * yard.luminance))
    assert sun is not None and degrees_between(sun, direction) < 4
    assert sun.ratio == pytest.approx(ratio, rel=0.25)
    ground = yard.points[:, 2] == 0
    seen = lit(sun, yard.points, yard.normals, yard.surface)
    shadow = torch.from_numpy(meets_box(yard.points[ground].double().numpy(), direction[None]))
    assert ((seen[ground] < 0.5 * direction[2]) == shadow).float().mean() > 0.985


def test_a_box_without_a_sun_has_none():
    assert find_sunlight(*box_on_plane(0.0, toward(40, 0))) is None


def test_the_courtyards_sun_stands_where_it_was_put(courtyard_sun):
    assert degrees_between(courtyard_sun, SUN) < 5


def test_the_courtyards_sun_is_as_strong_as_it_was_baked(courtyard_sun):
    """Both as irradiance / pi: SUN_LIGHT is that already, the sky's is the cosine-weighted mean of its radiance."""
    rng = np.random.default_rng(0)
    turn, radius = rng.uniform(0, 2 * np.pi, 40000), np.sqrt(rng.uniform(0, 1, 40000))
    hemisphere = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], 1, dtype=np.float64)
    sky = sky_light(hemisphere).mean(0)
    assert courtyard_sun.ratio == pytest.approx(SUN_LIGHT @ LUMINANCE / (sky @ LUMINANCE), rel=0.3)


def test_the_courtyards_shadows_lie_where_they_are(courtyard, courtyard_sun):
    """Nine of ten ground points, judged by the true sun's rays from the middle and the edge of its disc."""
    ground = (courtyard.points[:, 2].abs() < 0.03) & (courtyard.normals[:, 2] > 0.95)
    ground &= courtyard.points[:, :2].norm(dim=1) < 7
    points, normals = courtyard.points[ground], courtyard.normals[ground]
    blocked = []
    for offset in [(0, 0, 0), *(0.045 * np.eye(3)[axis] * sign for axis in range(3) for sign in (-1, 1))]:
        ray = torch.from_numpy(SUN + np.asarray(offset)).float().expand(len(points), 3)
        above = torch.cat([points[:, :2], points[:, 2:].clamp_min(0) + 0.02], dim=1)
        blocked.append(torch.isfinite(courtyard.surface.cast(above, ray).distance))
    share = torch.stack(blocked).float().mean(0)
    seen = lit(courtyard_sun, points, normals, courtyard.surface) > 0.5 * courtyard_sun.direction[2]
    assert (share == 1).sum() > 1000 and (share == 0).sum() > 1000
    assert seen[share == 0].float().mean() > 0.9 and (~seen[share == 1]).float().mean() > 0.9


def test_an_overcast_courtyard_has_no_sun(courtyard):
    """Sky by the CIE's overcast law, (1 + 2 sin) / 3, times an albedo in patches; cast by rays of the test's own."""
    generator = torch.Generator().manual_seed(5)
    inside = courtyard.points.norm(dim=1) < 9
    points, normals = courtyard.points[inside], courtyard.normals[inside]
    light = torch.full((len(points),), 0.05)
    for _ in range(24):  # uniform points of a sphere, moved by the normal, are cosine-weighted about it
        ray = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=generator), dim=1) + normals
        ray = torch.nn.functional.normalize(ray, dim=1)
        missed = torch.isinf(courtyard.surface.cast(points + 0.02 * normals, ray).distance)
        light += missed * (1 + 2 * ray[:, 2].clamp_min(0)) / 3 * (ray[:, 2] > 0) / 24
    patch = torch.floor(points / 0.3).long() + 60
    albedo = (0.4 * torch.randn(120, 120, 120, generator=generator))[patch.clamp(0, 119).unbind(1)]
    albedo += 0.3 * torch.randn(len(points), generator=generator)
    assert find_sunlight(points, normals, light * albedo.exp(), courtyard.surface) is None


def test_open_ground_and_walls_see_their_halves_of_the_sky():
    yard = box_on_plane(1.0, toward(40, 0), count=2000)
    starts = ray_starts(yard.points, yard.normals, yard.surface)
    seen = open_sky(starts, yard.normals, yard.surface, 256, torch.Generator().manual_seed(0))[0]
    far = (yard.points[:, 2] == 0) & (yard.points[:, :2].norm(dim=1) > 2.2)
    wall, top = yard.normals[:, 2] == 0, yard.points[:, 2] > 1.199
    assert seen[far].min() > 0.9 and seen[top].min() == 1
    assert seen[wall].mean().item() == pytest.approx(0.5, abs=0.01)


def test_open_level_ground_keeps_its_light_under_any_clouds():
    for clouds in (0.0, 0.3, 1.0):
        factor = overcast_factor(NOON, torch.tensor([NOON.direction[2]]), torch.ones(1), clouds)
        assert factor.item() == pytest.approx(1.0, abs=1e-6)


def test_no_clouds_change_nothing_and_a_closed_sky_leaves_no_shadow():
    seen, sky = torch.tensor([0.0, 0.3, 0.8]), torch.full((3,), 0.7)
    assert torch.allclose(overcast_factor(NOON, seen, sky, 0.0), torch.ones(3))
    light = sky + NOON.bounce * (1 - sky) + NOON.ratio * seen
    after = overcast_factor(NOON, seen, sky, 1.0) * light
    assert after.max() - after.min() < 1e-5
    # 0.7 of a sky with the sun's 5 x 0.8 spread over it, and what bounces
    assert after[0].item() == pytest.approx(0.7 * (1 + 4.0) + 0.2 * 0.3, rel=1e-5)
    half = overcast_factor(NOON, seen, sky, 0.5)
    assert torch.allclose(half * light, (after + light) / 2)


def test_where_no_light_of_the_sky_comes_clouds_change_nothing():
    for sun in (NOON, replace(NOON, bounce=0.0)):
        assert overcast_factor(sun, torch.zeros(1), torch.zeros(1), 1.0).item() == pytest.approx(1.0)


def test_too_few_points_or_nothing_that_casts_shadows_is_no_sun():
    yard = box_on_plane(5.0, toward(30, 140), count=FEWEST // 2)
    assert find_sunlight(*yard) is None
    yard = box_on_plane(5.0, toward(30, 140), count=2000)
    assert find_sunlight(*yard._replace(surface=SurfaceMesh.empty())) is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"normals": torch.zeros(4, 3)}, r"normals must have shape \(5, 3\), found \(4, 3\)"),
        ({"luminance": torch.tensor([1.0, -0.25, 1, 1, 1])}, "1 values down to -0.25"),
        ({"points": torch.full((5, 3), math.nan)}, "15 values of the points are NaN"),
    ],
)
@pytest.mark.mistyped
def test_what_does_not_fit_together_is_refused(change, says):
    five = Lit(torch.zeros(5, 3), torch.zeros(5, 3), torch.ones(5), SurfaceMesh.empty())
    with pytest.raises(ValueError, match=says):
        find_sunlight(*five._replace(**change))


def test_clouds_are_a_share():
    with pytest.raises(ValueError, match=r"got 1\.5"):
        overcast_factor(NOON, torch.ones(1), torch.ones(1), 1.5)


def test_a_scene_of_one_colour_has_no_sun():
    yard = box_on_plane(5.0, toward(30, 140))
    assert find_sunlight(yard.points, yard.normals, torch.full_like(yard.luminance, 0.3), yard.surface) is None
