"""Which frame of the weather a camera of nerfstudio sees.

nerfstudio asks for one picture at a time and hands over one camera of its path, as a slice. A slice of a tensor knows the whole
(torch's `Tensor._base`), and with it the place in the path and the times of all its cameras. A camera by itself, as the viewer
makes it, has a time of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from torch import Tensor

from pgsd_nerfstudio.scene.path_times import path_times

VIEW = "view"
"""Entry of the metadata by which cameras of the capture's own views are known; it says nothing else."""


class PlaceInPath(NamedTuple):
    """One camera of a path."""

    index: int
    """Place in the path, from 0."""
    count: int
    """Cameras of the path."""


def place_in_path(camera: NerfstudioCameras) -> PlaceInPath | None:
    """The place of a camera in the path that it is a slice of; None where it is none, or is a view of the capture."""
    if camera.metadata is not None and VIEW in camera.metadata:
        return None
    place = _place(camera.camera_to_worlds)
    return place if place is not None and place.count > 1 else None


def marked_as_views(cameras: NerfstudioCameras) -> NerfstudioCameras:
    """The same cameras, known as views of the capture wherever nerfstudio takes them."""
    marks = torch.zeros(len(cameras), 1, dtype=torch.bool, device=cameras.camera_to_worlds.device)
    cameras.metadata = {**(cameras.metadata or {}), VIEW: marks}
    return cameras


class Moments:
    """The frames that cameras see, one after the other."""

    def __init__(self, seconds: float, frames: int, say: Callable[[str], None]) -> None:
        """Frames of a weather.

        Args:
            seconds: length of the weather.
            frames: of the weather.
            say: takes a line about the times of a path, once for each path.
        """
        self.seconds, self.frames, self._say = seconds, frames, say
        self._single = 0
        self._path: tuple[tuple[int, int], tuple[float, ...]] | None = None

    def at(self, time: float) -> int:
        """The frame nearest to a time 0..1."""
        return round(min(max(time, 0.0), 1.0) * (self.frames - 1))

    def of(self, camera: NerfstudioCameras) -> int:
        """The frame that a camera sees. One without a time that is by itself sees the next with each call, over and over.

        Args:
            camera: a single one.

        Raises:
            SceneError: the times of its path are no times within the weather.
        """
        place = place_in_path(camera)
        if place is not None and (camera.times is None or camera.times._base is not None):
            return self.at(self._times(camera, place)[place.index])
        if camera.times is not None:
            return self.at(float(camera.times.reshape(-1)[0]))
        self._single += 1
        return (self._single - 1) % self.frames

    def _times(self, camera: NerfstudioCameras, place: PlaceInPath) -> tuple[float, ...]:
        """Times of all cameras of a path, resolved when its first camera is asked for."""
        key = camera.camera_to_worlds.untyped_storage().data_ptr(), place.count
        if self._path is None or self._path[0] != key or place.index == 0:
            whole = None if camera.times is None else camera.times._base
            given = [None] * place.count if whole is None else whole.reshape(-1).tolist()
            found = path_times(given, seconds=self.seconds, frames=self.frames)
            if found.remark is not None:
                self._say(found.remark)
            self._path = key, found.times
        return self._path[1]


def _place(slice_: Tensor) -> PlaceInPath | None:
    """Where a slice along the first dimension lies in the tensor that it was taken from."""
    whole = slice_._base
    if whole is None or whole.ndim != slice_.ndim or whole.shape[1:] != slice_.shape[1:] or slice_.shape[0] != 1:
        return None
    return PlaceInPath(int(slice_.storage_offset() - whole.storage_offset()) // whole.stride(0), whole.shape[0])
