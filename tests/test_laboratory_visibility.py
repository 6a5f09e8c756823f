"""How visible a weather is: what counts as a changed pixel, and that flying particles alone make the difference."""

import pytest
import torch
from yard_scene import write_yard

import pgsd_nerfstudio
from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.laboratory.visibility import Shown, clear_row, shown, weather_along
from pgsd_nerfstudio.scene.camera_path import slow_path
from pgsd_nerfstudio.weather.prepared_scene import prepare_scene


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory):
    ply, data = write_yard(tmp_path_factory.mktemp("yard"))
    prepared = prepare_scene(pgsd_nerfstudio.load_scene(ply, data=data, metres_per_unit=1.0), "cpu")
    return prepared, slow_path(prepared.scene, frames=10)


def test_a_pixel_is_changed_if_one_of_its_channels_differs_by_more_than_three_in_a_hundred():
    without = torch.full((2, 2, 3), 0.5)
    weather = without.clone()
    weather[0, 0, 1] += 0.031
    weather[0, 1] -= 0.029
    weather[1, 1] -= 0.2
    assert Shown(weather, without, torch.zeros(2, 2)).changed == 0.5


@pytest.mark.slow
def test_only_pixels_that_particles_reach_are_changed(yard):
    prepared, path = yard
    snow = weather_along(prepared, effect("snowfall", intensity=1.0), path, 3)
    found = shown(snow, path[5], 2)
    differ = (found.weather - found.without).abs().amax(-1)
    assert 0.01 < found.changed < 0.9
    assert found.alpha[differ > 0.1].min() > 0.05 and (found.weather - found.without).max() > 0.1


@pytest.mark.slow
def test_all_effects_start_clear(yard):
    prepared, path = yard
    assert clear_row(prepared, path, path[5]).holds
