"""Trajectories, times and pictures that the data manager serves."""

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from plugin_scene import HEIGHT, VIEWS, WIDTH, grouped, write_scene

from pgsd_nerfstudio.plugin.datamanager import TrajectoryDataManager, TrajectoryDataManagerConfig, partners, path_views
from pgsd_nerfstudio.plugin.environment import RunError
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
    for dataset, count in ((manager.train_dataset, VIEWS), (manager.eval_dataset, round(2.4 * 0.8))):
        times = dataset.cameras.times
        assert manager.includes_time and times is not None and times.shape == (count, 1)
        assert (float(times[0]), float(times[-1])) == (0.0, 1.0)
    assert len(manager.fixed_indices_eval_dataloader) == VIEWS


@pytest.mark.parametrize(("count", "seconds"), [(40, 10.0), (12, 10.0), (6, 4.0), (1, 2.0), (300, 60.0), (40, 0.1)])
def test_interpolating_between_evaluation_views_takes_as_long_as_the_weather(count: int, seconds: float):
    """As nerfstudio's RenderInterpolated counts: 10 steps a transition, 24 frames per second over all views."""
    views = path_views(count, seconds)
    duration = 10 * len(views) / 24
    assert abs(duration - seconds) <= 10 / 24 / 2 or len(views) == 2
    assert set(views) <= set(range(count)) and views[0] == 0
    if count < len(views):
        assert all(abs(after - before) <= 1 for before, after in pairwise(views)), "back and forth, without a jump"
    else:
        assert views == sorted(set(views)) and views[-1] == count - 1


def test_smaller_views_are_asked_for_by_a_factor(manager: TrajectoryDataManager):
    config = TrajectoryDataManagerConfig(options=manager.config.options)
    config.dataparser.downscale_factor = 2.0  # as ns-render dataset --downscale-factor 2 sets it
    smaller = config.setup().train_dataset
    assert smaller[0]["image"].shape == (HEIGHT // 2, WIDTH // 2, 3)
    torch.testing.assert_close(smaller.cameras.fx, manager.train_dataset.cameras.fx / 2)
    config.dataparser.downscale_factor = -1.0
    with pytest.raises(RunError, match="--downscale-factor must be positive, got -1"):
        config.setup()


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
