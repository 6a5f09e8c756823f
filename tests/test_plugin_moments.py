"""Which frame of the weather each camera sees that nerfstudio's own commands hand over, one at a time."""

from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path, get_path_from_json, get_spiral_path
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras

from pgsd_nerfstudio.plugin.moments import Moments, marked_as_views, place_in_path
from pgsd_nerfstudio.plugin.run_cameras import to_nerfstudio
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.scene import SceneError

SECONDS, FRAMES = 10.0, 250


def path(times: list) -> NerfstudioCameras:
    """A camera path as ns-render camera-path reads it; no render_time where None stands."""
    frame = {"camera_to_world": torch.eye(4).flatten().tolist(), "fov": 50, "aspect": 1.5}
    frames = [frame | ({} if time is None else {"render_time": time}) for time in times]
    return get_path_from_json({"render_width": 48.0, "render_height": 32.0, "camera_path": frames})


def views(count: int) -> NerfstudioCameras:
    c2w = torch.eye(4).repeat(count, 1, 1)
    c2w[:, 0, 3] = torch.arange(count)
    K = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    return to_nerfstudio(Cameras.from_opengl(c2w, K.repeat(count, 1, 1), 40, 30), torch.linspace(0, 1, count))


def rendered(cameras: NerfstudioCameras) -> Iterator[NerfstudioCameras]:
    """One camera after the other, as _render_trajectory_video of ns-render hands them to the model."""
    cameras.rescale_output_resolution(0.5)
    cameras = cameras.to("cpu")
    for index in range(cameras.size):
        with torch.no_grad():
            yield cameras[index : index + 1]


def shown(cameras: NerfstudioCameras) -> tuple[list[int], list[str]]:
    said: list[str] = []
    moments = Moments(SECONDS, FRAMES, said.append)
    return [moments.of(camera) for camera in rendered(cameras)], said


@pytest.mark.parametrize(
    "times", [[0.0] * 480, [None] * 480, [0.0] * 240 + [None] + [0.0] * 239], ids=["0", "none", "one missing"]
)
def test_a_path_of_480_frames_without_times_shows_the_weather_once(times: list):
    frames, said = shown(path(times))
    assert (frames[0], frames[-1], len(set(frames))) == (0, FRAMES - 1, FRAMES)
    assert frames == sorted(frames)
    assert len(said) == 1 and "the whole weather passes along it" in said[0]


def test_times_of_a_path_are_those_of_the_weather_and_nothing_is_said():
    assert shown(path([0.0, 0.5, 1.0, 0.25])) == ([0, 124, 249, 62], [])


def test_times_in_seconds_count_as_such():
    frames, said = shown(path([0.0, 5.0, 10.0]))
    assert frames == [0, 124, 249]
    assert len(said) == 1 and "taken as seconds" in said[0]


def test_times_that_are_none_of_the_weather_are_refused():
    with pytest.raises(SceneError, match="reaches 4000"):
        shown(path([0.0, 4000.0]))


def test_interpolate_shows_the_whole_weather_once():
    frames, said = shown(get_interpolated_camera_path(views(24), steps=10, order_poses=False))
    assert len(frames) == 230 and (frames[0], frames[-1]) == (0, FRAMES - 1)
    assert {after - before for before, after in pairwise(frames)} == {1, 2}
    assert len(said) == 1


def test_a_second_path_has_times_of_its_own():
    moments = Moments(SECONDS, FRAMES, lambda line: None)
    for count in (480, 7, 480):
        frames = [moments.of(camera) for camera in rendered(path([None] * count))]
        assert (frames[0], frames[-1]) == (0, FRAMES - 1)


def test_a_spiral_has_times():
    assert shown(get_spiral_path(views(3)[0:1], steps=3, radius=0.1)) == ([0, 124, 249], [])


def test_a_view_of_the_capture_is_no_place_in_a_path_and_keeps_its_time():
    capture = marked_as_views(views(5)).to("cpu")
    camera = capture[4:5]
    assert place_in_path(camera) is None
    assert shown(capture) == ([0, 62, 124, 187, 249], [])


def test_a_camera_by_itself_has_a_time_of_its_own_or_sees_the_next_frame():
    moments = Moments(SECONDS, FRAMES, lambda line: None)
    assert moments.of(path([0.5])[0:1]) == 124
    assert [moments.of(path([None])[0:1]) for _ in range(FRAMES + 2)] == [*range(FRAMES), 0, 1]
