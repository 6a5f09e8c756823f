"""Trajectories, times and pictures that the data manager serves."""

from pathlib import Path

import pytest
import torch
from plugin_scene import HEIGHT, VIEWS, WIDTH, grouped, write_scene

from pgsd_nerfstudio.plugin.datamanager import TrajectoryDataManager, TrajectoryDataManagerConfig, partners
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.storage import cache_dir

CLIP = {"clip_frames": 5, "clip_height": 16, "clip_width": 24}


@pytest.fixture(scope="module")
def manager(tmp_path_factory: pytest.TempPathFactory) -> TrajectoryDataManager:
    ply = write_scene(tmp_path_factory.mktemp("scene"))
    options = grouped(RunOptions(), {"load_scene": ply, "data": ply.parent, "seconds": 0.8, **CLIP})
    return TrajectoryDataManagerConfig(options=options).setup()


def test_a_trajectory_leads_from_one_training_view_to_another_at_the_clips_size(manager: TrajectoryDataManager):
    cameras, batch = manager.next_train(3)
    views = manager.prepared.scene.cameras.opengl()[:, :3]
    assert cameras.shape == (5,) and int(cameras.height[0]) == 16 and int(cameras.width[0]) == 24
    first, last = batch["views"]
    torch.testing.assert_close(cameras.camera_to_worlds[0], views[first], atol=1e-5, rtol=0)
    torch.testing.assert_close(cameras.camera_to_worlds[-1], views[last], atol=1e-5, rtol=0)


def test_windows_are_consecutive_frames_within_the_weather(manager: TrajectoryDataManager):
    starts = set()
    for step in range(60):
        cameras, batch = manager.next_train(step)
        frames = cameras.times[:, 0] * 19
        torch.testing.assert_close(frames, torch.arange(5.0) + batch["start"], atol=1e-4, rtol=0)
        starts.add(batch["start"])
    assert min(starts) == 0 and max(starts) == 15 and len(starts) > 10


def test_a_step_has_one_trajectory_and_evaluation_another(manager: TrajectoryDataManager):
    drawn = [manager.next_train(step)[1] for step in range(20)]
    assert drawn == [manager.next_train(step)[1] for step in range(20)]
    assert drawn != [manager.next_eval(step)[1] for step in range(20)]
    assert len({(batch["start"], batch["views"]) for batch in drawn}) > 15


def test_partners_are_the_nearest_views_and_never_the_view_itself(manager: TrajectoryDataManager):
    views = manager.prepared.scene.cameras
    assert sorted(partners(views, 2, 2).tolist()) == [1, 3]
    assert sorted(partners(views, 2, None).tolist()) == [0, 1, 3, 4, 5]
    assert partners(views[torch.tensor([0])], 0, None).tolist() == [0], "a single view goes nowhere"


def test_views_have_times_over_the_whole_weather(manager: TrajectoryDataManager):
    times = manager.eval_dataset.cameras.times
    assert manager.includes_time and times is not None and times.shape == (VIEWS, 1)
    assert (float(times[0]), float(times[-1])) == (0.0, 1.0)


def test_missing_photographs_are_rendered_once_and_kept(manager: TrajectoryDataManager, monkeypatch: pytest.MonkeyPatch):
    image = manager.train_dataset[0]["image"]
    rendered = manager.prepared.rasterizer.render(manager.prepared.scene.cameras[0]).rgb[0]
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert float((image - rendered).abs().max()) < 1 / 255
    assert manager.train_dataset.image_filenames[0].is_relative_to(cache_dir())
    monkeypatch.setattr(type(manager.train_dataset), "_render", None)
    torch.testing.assert_close(manager.train_dataset[0]["image"], image)


def test_photographs_come_in_the_size_of_their_camera(tmp_path: Path):
    from PIL import Image

    ply = write_scene(tmp_path)
    for index in range(VIEWS):
        Image.new("RGB", (2 * WIDTH, 2 * HEIGHT), (10 * index, 0, 0)).save(tmp_path / f"{index}.png")
    manager = TrajectoryDataManagerConfig(options=grouped(RunOptions(), {"load_scene": ply, "data": tmp_path, **CLIP})).setup()
    image = manager.train_dataset[4]["image"]
    assert image.shape == (HEIGHT, WIDTH, 3) and image[0, 0].tolist() == pytest.approx([40 / 255, 0, 0])
