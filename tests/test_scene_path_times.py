"""Which moment each picture of a camera path shows: as given where that can be, the whole weather where nothing is said."""

import math

import pytest

from pgsd_nerfstudio.scene.path_times import path_times
from pgsd_nerfstudio.scene.scene import SceneError


def moments(*given, seconds: float = 10.0, frames: int = 250):
    found = path_times(given, seconds=seconds, frames=frames)
    return list(found.times), found.remark


def test_times_from_0_to_1_are_used_as_they_are_and_nothing_is_said():
    assert moments(0.0, 0.25, 1.0) == ([0.0, 0.25, 1.0], None)
    assert moments(0.25) == ([0.25], None)


@pytest.mark.parametrize("given", [[0.0] * 480, [None] * 480, [0.7, 0.7 + 1e-9] * 240])
def test_equal_or_absent_times_let_the_whole_weather_pass_once(given):
    times, remark = moments(*given)
    assert times == pytest.approx([index / 479 for index in range(480)])
    assert remark is not None and "the whole weather passes along it" in remark


def test_a_missing_time_lies_between_its_neighbours():
    times, remark = moments(0.0, None, 0.5, None)
    assert times == pytest.approx([0.0, 0.25, 0.5, 0.5])
    assert remark == "2 of 4 frames of the camera path have no render_time: taken from those beside them"


@pytest.mark.parametrize(
    ("last", "unit"), [(10.0, "seconds"), (9.98, "seconds"), (249.0, "frames"), (250.0, "frames"), (120.0, "frames")]
)
def test_times_beyond_1_are_seconds_or_frames(last: float, unit: str):
    whole = {"seconds": 10.0, "frames": 249.0}[unit]
    times, remark = moments(0.0, last / 2, last)
    assert times == pytest.approx([0.0, last / 2 / whole, min(1.0, last / whole)])
    assert remark is not None and f"taken as {unit} of the weather's {whole:g}" in remark


def test_a_spline_that_swings_past_the_ends_is_held_there():
    assert moments(-0.04, 0.5, 1.13) == ([0.0, 0.5, 1.0], None)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ([0.0, 4000.0], "reaches 4000: expected 0 to 1 over the whole weather, seconds up to 10, or frames up to 249"),
        ([0.0, -3.0], "must not be negative, got -3"),
        ([0.0, math.nan], "must be a number in each frame of a camera path, got nan"),
        ([0.0, math.inf], "must be a number in each frame of a camera path, got inf"),
        ([], "needs at least one camera, found none"),
    ],
)
def test_what_is_no_time_of_the_weather_is_refused_in_a_sentence(given, sentence):
    with pytest.raises(SceneError, match=sentence):
        moments(*given)
