"""The answer of the frozen scene: the untouched scene before the weather, unchanged tensors, and each part in its place."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.effects.effect import EFFECTS, Effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.baked import baked
from pgsd_nerfstudio.response.coating import Coating
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.haze_field import HazeField
from pgsd_nerfstudio.response.landed import in_place
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0

GRID, UNIT = 12, 2.0  # Gaussians along a side of the floor; metres per scene unit
FRAME = Frame(UNIT, torch.eye(3), torch.zeros(3))


def floor() -> Gaussians:
    """Grey tiles that look up, seen from one side brighter; scene units."""
    at = torch.linspace(-1.0, 1.0, GRID)
    means = torch.cat([torch.cartesian_prod(at, at), torch.zeros(GRID**2, 1)], 1)
    n = len(means)
    colors = torch.zeros(n, 4, 3)
    colors[:, 0] = (0.4 - 0.5) / SH_C0
    colors[:, 3] = 0.05
    scales = torch.tensor([0.1, 0.1, 0.003]).expand(n, 3).clone()
    return Gaussians(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), 0.9), colors)


def camera(height: float = 1.5) -> Cameras:
    """Looks down at the floor, slanted."""
    viewmat = torch.tensor([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0.5], [0, 0.8, -0.6, height], [0, 0, 0, 1]])
    return Cameras(viewmat[None], torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])[None], 48, 32)


def answer(what: Effect, edits: Edits | None = None, sheltered: float = 0.0) -> Answer:
    """Of the floor in the open; a share of it is under a roof."""
    n = GRID**2
    open_to = (torch.arange(n) >= sheltered * n).float()
    exposure = Exposure(
        torch.tensor([0.0, 0, 1]).repeat(n, 1), torch.zeros(n, dtype=torch.bool), open_to, torch.ones(n), open_to
    )
    layers = Coating.of(what, exposure, UNIT * floor().means)
    haze = HazeField.of(what, FRAME, Domain((-3.0, -3, -0.3), (3.0, 3, 3)))
    return Answer(what, exposure, layers, None, torch.eye(3), UNIT, haze, edits, 10.0)


def picture(what: Answer, seconds: float) -> torch.Tensor:
    return CpuRasterizer(floor()).render(camera(), None, None, what.at(seconds)).rgb[0]


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_second_0_of_a_weather_that_starts_clear_is_the_untouched_scene_to_the_bit(name: str):
    clear = replace(EFFECTS[name], timeline=Timeline(onset=2.0))
    assert answer(clear).at(0.0) is None
    assert torch.equal(picture(answer(clear), 0.0), CpuRasterizer(floor()).render(camera()).rgb[0])
    assert not torch.equal(picture(answer(clear), 2.0), CpuRasterizer(floor()).render(camera()).rgb[0])


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_the_scenes_own_tensors_stay_as_they_are(name: str):
    frozen = floor()
    before = {k: v.clone() for k, v in frozen.tensors.items()}
    shown = answer(EFFECTS[name]).at(8.0)
    CpuRasterizer(frozen).render(camera(), None, None, shown)
    baked(shown, frozen)
    assert all(torch.equal(before[k], v) for k, v in frozen.tensors.items())


def bush(background: float, seconds: float, name: str = "rainfall") -> torch.Tensor:
    """Linear light of a dark bush with 1 - alpha = 0.16 before a black background, and of the empty picture around it."""
    bare = replace(effect(name), surface=replace(effect(name).surface, accumulates=False))
    alone = answer(bare).select(torch.tensor([0]))
    leaf = Gaussians(
        torch.tensor([[0.0, 0.0, 1.5]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[0.6, 0.6, 0.6]]),
        torch.tensor([0.84]),
        torch.full((1, 1, 3), (0.35 - 0.5) / SH_C0),
    )
    ahead = Cameras(torch.eye(4)[None], torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])[None], 48, 32)
    shown = alone.at(seconds) if seconds else None
    return linear(CpuRasterizer(leaf).render(ahead, None, torch.full((3,), background), shown).rgb[0])


@pytest.mark.parametrize("name", ["rainfall", "snowfall"])
def test_what_is_not_quite_opaque_does_not_let_the_far_haze_through(name):
    without = replace(effect(name), ambience=None)
    clear, later = bush(0.0, 0.0)[16, 24], bush(0.0, 2.0, name)[16, 24]
    air = answer(without).haze.at(2.0)
    depth = air.optical_depth(torch.tensor([[0.0, 0, 1.5]]), torch.eye(4), torch.eye(3), 48, 32)
    allowed = linear(torch.tensor(effect(name).haze.rgb)) * -torch.expm1(-depth)
    assert (later <= 1.3 * clear + allowed + 0.01).all()


def test_open_sky_shows_the_sky_of_the_weather():
    corner = bush(0.0, 2.0)[0, 0]
    assert (corner > 0.2).all() and bush(0.0, 0.0)[0, 0].max() < 0.02


def lit(what: Effect, seconds: float, **kwargs) -> torch.Tensor:
    """Colours of the floor without air or mirror."""
    shown = answer(what, **kwargs).at(seconds)
    rgb = torch.full((GRID**2, 3), 0.4)
    return rgb if shown is None else shown.lit(rgb, torch.arange(GRID**2), None)


def test_snow_whitens_what_it_reaches_and_only_that():
    snow = replace(effect("snowfall"), ambience=None)
    colors = lit(snow, 10.0, sheltered=0.5)
    roofed = torch.arange(GRID**2) < 0.5 * GRID**2
    assert torch.allclose(colors[roofed], torch.tensor(0.4), atol=1e-5)
    assert colors[~roofed].mean() > 0.7


def test_rain_darkens_and_the_darker_wetness_comes_with_time():
    rain = replace(effect("rainfall"), ambience=None)
    dry, early, late = (lit(rain, t).mean() for t in (0.0, 2.0, 10.0))
    assert dry == pytest.approx(0.4, abs=1e-5) and late < early < dry and late < 0.33


def test_wet_ground_mirrors_the_sky_at_grazing_angles_and_dry_ground_does_not():
    rgb, ids = torch.full((GRID**2, 3), 0.1), torch.arange(GRID**2)
    grazing, down = torch.tensor([1.0, 0.0, 0.05]), torch.tensor([0.0, 0.0, 1.0])
    towards = [torch.nn.functional.normalize(d, dim=0).expand(GRID**2, 3) for d in (grazing, down)]
    wet = answer(effect("rainfall")).at(10.0)
    dry = answer(effect("snowfall")).at(0.0)
    flat, steep = (wet.lit(rgb, ids, t).mean() for t in towards)
    assert flat > 1.5 * steep
    assert torch.equal(*(dry.lit(rgb, ids, t) for t in towards))


def test_ambience_is_light_times_a_factor_and_comes_with_the_weather():
    snow = effect("snowfall")
    dimmer = replace(snow.ambience, stops=-1.0, tint=(1.0, 1.0, 1.0), saturation=1.0)
    dark = replace(snow, ambience=dimmer, surface=replace(snow.surface, accumulates=False), timeline=Timeline(onset=4.0))
    assert lit(dark, 4.0).mean() == pytest.approx(0.4 * 0.5 ** (1 / 2.2), rel=1e-4)
    assert lit(dark, 2.0).mean() == pytest.approx(0.4 * 0.75 ** (1 / 2.2), rel=1e-4)


def test_clouds_soften_shadows_by_the_factor_of_the_sun():
    fog = replace(effect("fog"), ambience=replace(effect("fog").ambience, stops=0.0, tint=(1.0, 1, 1), saturation=1.0))
    factor = torch.linspace(0.5, 2.0, GRID**2)[:, None] * torch.tensor([1.0, 0.9, 0.8])
    shown = replace(answer(fog), softening=factor).at(5.0)
    colors = shown.lit(torch.full((GRID**2, 3), 0.4), torch.arange(GRID**2), None)
    assert torch.allclose(colors, 0.4 * factor ** (1 / 2.2), rtol=1e-4)


def test_without_ambience_and_accumulation_only_the_air_changes():
    snow = effect("snowfall")
    bare = replace(snow, ambience=None, haze=None, surface=replace(snow.surface, accumulates=False))
    assert answer(bare).at(5.0) is None


def test_edited_pictures_come_with_the_cover_and_end_as_they_are():
    n = GRID**2
    edits = Edits(torch.full((n, 3), 0.3), torch.full((n,), 0.5), torch.full((n, 3), 0.2))
    snow = replace(effect("snowfall"), ambience=None, haze=None)
    edited = answer(snow, edits, sheltered=0.5)
    early, end = edited.share_of_edits(2.0), edited.share_of_edits(10.0)
    assert (early <= end + 1e-6).all() and torch.allclose(end, torch.ones(n), atol=1e-5)
    assert float(early[-1]) != pytest.approx(
        float(early[0]), abs=0.01
    )  # under the roof with the weather, outside with the snow
    assert edited.at(0.0) is None or torch.equal(edited.at(0.0).altered(floor()).colors, floor().colors)
    assert (edited.at(10.0).altered(floor()).colors[:, 0] > floor().colors[:, 0]).all()


def test_an_answer_of_some_gaussians_is_that_part_of_all():
    whole = answer(effect("rainfall"))
    which = torch.arange(GRID**2) % 3 == 0
    some = whole.select(which)
    rgb = torch.full((GRID**2, 3), 0.4)
    expected = whole.at(6.0).lit(rgb, torch.arange(GRID**2), None)[which]
    found = some.at(6.0).lit(rgb[which], torch.arange(int(which.sum())), None)
    assert torch.allclose(found, expected, atol=1e-6)
    assert some.at(6.0).key != whole.at(6.0).key


def test_thicker_haze_hides_more():
    fog = answer(effect("fog"))
    clear, thick = (picture(fog.thicker(f), 5.0) for f in (0.0, 4.0))
    usual = picture(fog, 5.0)
    sky = torch.tensor(effect("fog").haze.rgb)
    apart = [float((p[8:24] - sky).abs().mean()) for p in (thick, usual, clear)]
    assert apart[0] < apart[1] < apart[2]


def test_baked_gaussians_look_like_the_moment_without_air():
    snow = replace(effect("snowfall"), haze=None)
    shown = answer(snow).at(6.0)
    direct = CpuRasterizer(floor()).render(camera(), None, None, shown)
    stored = CpuRasterizer(baked(shown, floor())).render(camera()).rgb[0]
    solid = direct.accumulation[0] > 0.98  # the sky is no Gaussian here
    assert solid.float().mean() > 0.3 and (direct.rgb[0] - stored)[solid].abs().mean() < 0.01
    assert baked(None, floor()).colors.equal(floor().colors)


@pytest.mark.mistyped
def test_collided_particles_take_the_light_of_their_place_and_lie_only_where_they_can():
    n = GRID**2
    exposure = answer(effect("snowfall")).exposure
    half = torch.where(UNIT * floor().means[:, 0] < 0, 0.1, 1.0)  # one side of the floor sees hardly any sky
    shaded = replace(answer(effect("snowfall")), exposure=replace(exposure, sky=half))
    look = ParticleLook(torch.ones(5), torch.ones(5, 3), torch.full((5, 3), 0.9))
    places = torch.tensor([[-1.5, 0.0, 0], [1.5, 0.0, 0], [-1.5, 0.5, 0], [1.5, 0.0, 0.3], [1.5, 0.2, 0]])
    flat, wall = [1.0, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0]
    history = SimpleNamespace(
        collided=torch.tensor([True, True, False, True, True]),
        rest_positions=places,
        rest_quats=torch.tensor([flat, flat, flat, flat, wall]),
        rest_covers=torch.zeros(5),
    )
    metric = FRAME.gaussians_to_metric(replace(floor(), colors=torch.zeros(n, 3)))
    found = in_place(InitialLook(look, look, 0.0), history, shaded, metric).collided
    assert len(half) == n and (found.rgb[0] < 0.85).all()
    assert torch.allclose(found.rgb[1], look.rgb[1], atol=1e-5) and torch.equal(found.rgb[2], look.rgb[2])
    assert found.opacity.tolist() == [1, 1, 1, 0, 0]  # the fourth hangs in the air, the fifth lies on a wall
    bare = replace(shaded, effect=replace(effect("snowfall"), ambience=None))
    assert torch.equal(in_place(InitialLook(look, look, 0.0), history, bare, metric).collided.rgb, look.rgb)


@pytest.mark.mistyped
def test_ash_is_darker_than_snow_under_the_same_sky():
    none = SimpleNamespace(collided=torch.zeros(4, dtype=torch.bool), rest_positions=torch.zeros(4, 3))
    metric = FRAME.gaussians_to_metric(replace(floor(), colors=torch.zeros(GRID**2, 3)))

    def shown(rgb: tuple[float, float, float]) -> torch.Tensor:
        look = ParticleLook(torch.ones(4), torch.ones(4, 3), torch.tensor(rgb).expand(4, 3))
        return linear(in_place(InitialLook(look, look, 0.0), none, answer(effect("snowfall")), metric).active.rgb)[0]

    snow, grey = (0.95, 0.97, 1.0), (0.42, 0.41, 0.40)
    share = linear(torch.tensor(grey)) / linear(torch.tensor(snow))
    assert (shown(grey) / shown(snow) / share).tolist() == pytest.approx([1.0] * 3, abs=0.3)  # 5 times as dark


@pytest.mark.mistyped
def test_the_layer_hides_flakes_that_landed_before_it_and_soon_after_contact_those_that_land_on_it():
    look = ParticleLook(torch.ones(3), torch.ones(3, 3), torch.full((3, 3), 0.9))
    whole = InitialLook(look, look, 0.0, torch.tensor([2.0, 2.0, math.inf]))
    run = SimpleNamespace(ends=torch.tensor([1, 100, 1]), fps=25.0)
    ids = torch.arange(3)
    assert whole.collided_at(run, 49, ids).opacity.tolist() == [1, 1, 1]
    assert whole.collided_at(run, 75, ids).opacity.tolist() == [0, 1, 1]
    assert whole.collided_at(run, 110, ids).opacity.tolist() == [0, 0, 1]
