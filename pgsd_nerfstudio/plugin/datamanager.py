"""Serves camera trajectories instead of rays: the way from one training view to another, with a window of the weather."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Int
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.data.datamanagers.base_datamanager import DataManager, VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from torch import Tensor

from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.opening import open_scene
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.plugin.run_cameras import to_nerfstudio
from pgsd_nerfstudio.plugin.views import Views
from pgsd_nerfstudio.scene.cameras import Cameras, interpolate

OTHER = 1_000_003  # added to the seed, gives trajectories that training does not see
NEAREST = 6  # views to which a trajectory may lead
EVAL_VIEWS = 12  # as many, evenly chosen, are measured
# `ns-render interpolate` makes 10 pictures from each evaluation view to the next, and its video lasts 10/24 s for each view.
STEPS, FRAME_RATE = 10, 24


@dataclass
class ViewsConfig(DataParserConfig):
    """The little that ns-render dataset asks of a dataparser's configuration."""

    downscale_factor: float | None = None
    """Factor by which pictures are smaller than those of the scene's cameras."""


@dataclass
class TrajectoryDataManagerConfig(VanillaDataManagerConfig):
    """Vanilla by type, since ns-render spiral and dataset ask for that."""

    _target: type = field(default_factory=lambda: TrajectoryDataManager)
    dataparser: tyro.conf.Suppress[Any] = field(default_factory=ViewsConfig)
    options: tyro.conf.Suppress[RunOptions] = field(default_factory=RunOptions.unset)
    run_folder: tyro.conf.Suppress[Path | None] = None
    made_in: tyro.conf.Suppress[Path | None] = None
    """Where the run's folder was when it was made."""


class TrajectoryDataManager(VanillaDataManager):
    """Trajectories for training; the scene's views, each with a time, for everything else."""

    config: TrajectoryDataManagerConfig
    train_dataset: Views
    eval_dataset: Views

    def __init__(
        self,
        config: TrajectoryDataManagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **kwargs: Any,
    ) -> None:
        """Open the scene.

        Raises:
            SceneError: it cannot be used.
        """
        self.config, self.device, self.test_mode = config, device, test_mode
        self.world_size, self.local_rank = world_size, local_rank
        self.includes_time = True
        self.prepared = open_scene(config.options, device, config.run_folder, config.made_in)
        count, smaller = len(self.prepared.scene.cameras), config.dataparser.downscale_factor or 1.0
        if not 0 < smaller < float("inf"):
            raise RunError(f"--downscale-factor must be positive, got {smaller:g}")
        self.train_dataset = Views(self.prepared, list(range(count)), smaller)
        self.eval_dataset = Views(self.prepared, path_views(count, config.options.simulation.seconds), smaller)
        self.train_dataparser_outputs = self.train_dataset._dataparser_outputs
        DataManager.__init__(self)
        chosen = torch.linspace(0, count - 1, min(EVAL_VIEWS, count)).round().long()
        self.evaluated = Views(self.prepared, chosen.tolist(), smaller)
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(input_dataset=self.evaluated, device=device)
        self.eval_dataloader = FixedIndicesEvalDataloader(input_dataset=self.evaluated, device=device)

    def setup_train(self) -> None:
        """Nothing to load: trajectories are made when they are asked for."""

    def setup_eval(self) -> None:
        """Nothing to load."""

    def next_train(self, step: int) -> tuple[NerfstudioCameras, dict[str, Any]]:
        """A trajectory of one clip; depends on the seed and the step only, so that a resumed run goes on as it would have."""
        return self._trajectory(step, self.config.options.training_seed)

    def next_eval(self, step: int) -> tuple[NerfstudioCameras, dict[str, Any]]:
        """A trajectory that training never sees."""
        return self._trajectory(step, self.config.options.training_seed + OTHER)

    def next_eval_image(self, step: int) -> tuple[NerfstudioCameras, dict[str, Any]]:
        """One evaluation view with its picture, in turn."""
        return self.eval_dataloader.get_camera(step % len(self.eval_dataloader.input_dataset))

    def _trajectory(self, step: int, seed: int) -> tuple[NerfstudioCameras, dict[str, Any]]:
        options, views = self.config.options, self.prepared.scene.cameras
        clips, weather_frames = options.clips, options.simulation.frames
        frames, height, width = clips.clip_frames, clips.clip_height, clips.clip_width
        if frames is None or height is None or width is None:
            raise RuntimeError("the clip's size is not known before the video prior is opened")
        draw = torch.Generator().manual_seed(seed * OTHER + step)
        first = int(torch.randint(len(views), (), generator=draw))
        others = partners(views, first, None if clips.trajectory == "any" else NEAREST)
        last = int(others[torch.randint(len(others), (), generator=draw)])
        start = int(torch.randint(weather_frames - frames + 1, (), generator=draw))
        times = torch.arange(start, start + frames) / (weather_frames - 1)
        path = interpolate(views, first, last, frames).resized(width, height)
        return to_nerfstudio(path, times).to(self.device), {"start": start, "views": (first, last)}

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a clip."""
        clips = self.config.options.clips
        return (clips.clip_frames or 0) * (clips.clip_height or 0) * (clips.clip_width or 0)

    def get_eval_rays_per_batch(self) -> int:
        """Pixels of a clip."""
        return self.get_train_rays_per_batch()

    def get_datapath(self) -> Path:
        """Where the viewer keeps camera paths: with the run, since the scene may lie where nobody may write."""
        return self.config.run_folder or Path()


def path_views(count: int, seconds: float) -> list[int]:
    """Views along which `ns-render interpolate` takes as long as the weather lasts, in the order of the capture.

    Args:
        count: number of training views. Where they are too few, the path leads back and forth.
        seconds: length of the weather.
    """
    wanted = max(2, round(seconds * FRAME_RATE / STEPS))
    if wanted <= count:
        return torch.linspace(0, count - 1, wanted).round().long().tolist()
    there = list(range(count))
    round_trip = there + there[-2:0:-1]
    return [round_trip[index % len(round_trip)] for index in range(wanted)]


def partners(views: Cameras, first: int, nearest: int | None) -> Int[Tensor, " n"]:
    """Views to which a trajectory may lead: all others, or the nearest in place and direction.

    Args:
        views: all training views.
        first: number of the view from which it leads.
        nearest: how many of the nearest; None: all.
    """
    c2w = views.opengl()
    away = (c2w[:, :3, 3] - c2w[first, :3, 3]).norm(dim=1)
    turned = (c2w[:, :3, 2] - c2w[first, :3, 2]).norm(dim=1)
    distance = away / away.mean().clamp_min(1e-9) + turned
    distance[first] = float("inf")
    count = len(views) - 1
    if count == 0:
        return torch.tensor([first])
    return distance.argsort()[: count if nearest is None else min(nearest, count)]
