"""What of a weather follows the scene: the legibility of snow and rain follows the air before what the cameras see."""

import numpy as np
import pytest
from yard_scene import look_inward, write_yard

import pgsd_nerfstudio
from pgsd_nerfstudio.effects import FOG, RAINFALL, SNOWFALL
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.weather.adapting import FAR, MOST, adapted, air_before
from pgsd_nerfstudio.weather.prepared_scene import prepare_scene


@pytest.fixture(scope="module", params=[0.4, 1.0, 3.0])
def yard(request, tmp_path_factory: pytest.TempPathFactory):
    ply, data = write_yard(tmp_path_factory.mktemp("yard"))
    scene = pgsd_nerfstudio.load_scene(ply, data=data, metres_per_unit=request.param)
    return request.param, prepare_scene(scene, "cpu")


def floor_depths() -> np.ndarray:
    """Depth of the floor of 6 x 6 in each pixel of one view, inf beside it, by intersecting its rays."""
    x, y = np.meshgrid((np.arange(96) + 0.5 - 48) / 80, (np.arange(64) + 0.5 - 32) / 80)
    rays = np.stack([x, -y, -np.ones_like(x)], -1) @ look_inward(0.0)[:3, :3].T
    center = look_inward(0.0)[:3, 3]
    depth = np.where(rays[..., 2] < -1e-6, -center[2] / np.minimum(rays[..., 2], -1e-6), np.inf)
    at = center + np.where(np.isfinite(depth), depth, 1e6)[..., None] * rays
    return np.where((np.abs(at[..., :2]) < 3.05).all(-1), depth, np.inf)


def test_the_air_before_a_floor_is_that_of_its_rays(yard):
    metres, prepared = yard
    expected = np.minimum(metres * floor_depths(), FAR).mean()
    assert air_before(prepared) == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL], ids=lambda effect: effect.name)
def test_little_air_is_made_up_for_by_area_and_it_is_said(yard, effect):
    metres, prepared = yard
    assert effect.adaptation.air is not None
    more = float(np.clip(effect.adaptation.air / np.minimum(metres * floor_depths(), FAR).mean(), 1, MOST))
    found, said = adapted(effect, prepared)
    assert found.appearance.area_factor == pytest.approx(more * effect.appearance.legibility, rel=0.06)
    assert (more > 1) == any("times more than usual" in sentence for sentence in said)
    assert adapted(found, prepared) == (found, [])  # what was found is not asked for again


def test_a_legibility_that_is_asked_for_stays(yard):
    asked, _ = EffectOptions(effect="rainfall", legibility=1.0).resolve()
    found, said = adapted(asked, yard[1])
    assert found.appearance.area_factor == 1.0 and said == []


def test_fog_takes_no_heed_of_it(yard):
    assert adapted(FOG, yard[1])[0].appearance == FOG.appearance
