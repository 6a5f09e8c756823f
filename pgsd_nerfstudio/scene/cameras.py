"""Pinhole cameras of one clip or one capture, in the convention of the rasterizers.

The matrices lead from the world to the camera, with OpenCV axes (x right, y down, z forward). nerfstudio's matrices lead from
the camera to the world, with OpenGL axes (x right, y up, z back); `Cameras.from_opengl` and `Cameras.opengl` convert.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene import rotations

OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


@dataclass(frozen=True)
class Cameras:
    """T pinhole cameras of one image size."""

    viewmats: Float[Tensor, "t 4 4"]
    """World to camera, OpenCV axes, scene units."""
    Ks: Float[Tensor, "t 3 3"]
    """Intrinsics in pixels; pixel centres lie at half-integers."""
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index: int | slice | Tensor) -> Cameras:
        """The chosen cameras; a single index keeps the leading dimension."""
        if isinstance(index, int):
            index = [index]  # type: ignore[assignment]
        return Cameras(self.viewmats[index], self.Ks[index], self.width, self.height)

    @staticmethod
    def from_opengl(c2w: Float[Tensor, "t rows 4"], Ks: Float[Tensor, "t 3 3"], width: int, height: int) -> Cameras:
        """Cameras from nerfstudio's matrices.

        Args:
            c2w: camera to world, OpenGL axes, scene units; three rows, or four of which the last does not matter.
            Ks: intrinsics in pixels.
            width: of the images in pixels.
            height: of the images in pixels.
        """
        full = torch.eye(4).repeat(c2w.shape[0], 1, 1).to(c2w)
        full[:, :3] = c2w[:, :3]
        return Cameras(torch.linalg.inv(full @ OPENGL_TO_OPENCV.to(c2w)), Ks, width, height)

    def opengl(self) -> Float[Tensor, "t 4 4"]:
        """Camera-to-world matrices with OpenGL axes, as nerfstudio has them."""
        return torch.linalg.inv(self.viewmats) @ OPENGL_TO_OPENCV.to(self.viewmats)

    @property
    def centers(self) -> Float[Tensor, "t 3"]:
        """Camera positions in scene units."""
        return torch.linalg.inv(self.viewmats)[:, :3, 3]

    def to(self, device: torch.device | str) -> Cameras:
        return Cameras(self.viewmats.to(device), self.Ks.to(device), self.width, self.height)

    def resized(self, width: int, height: int) -> Cameras:
        """The same views in another image size in pixels; what does not fit the new shape is cropped, never stretched.

        Raises:
            ValueError: a side has no pixel.
        """
        if width < 1 or height < 1:
            raise ValueError(f"a picture has at least 1x1 pixels, got {width}x{height}")
        zoom = max(width / self.width, height / self.height)
        Ks = self.Ks.clone()
        Ks[:, 0, 0] *= zoom
        Ks[:, 1, 1] *= zoom
        Ks[:, 0, 2] = (Ks[:, 0, 2] - self.width / 2) * zoom + width / 2
        Ks[:, 1, 2] = (Ks[:, 1, 2] - self.height / 2) * zoom + height / 2
        return Cameras(self.viewmats, Ks, width, height)


def level_axes(back: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3 3"]:
    """Camera-to-world rotations with OpenGL axes (columns right, up, back) of level cameras, in axes whose z is up.

    Args:
        back: unit vectors from what the cameras look at to the cameras, not straight up or down.
    """
    z = torch.tensor([0.0, 0.0, 1.0]).to(back).expand_as(back)
    right = torch.nn.functional.normalize(torch.linalg.cross(z, back), dim=1)
    return torch.stack([right, torch.linalg.cross(back, right), back], dim=2)


def interpolate(cameras: Cameras, first: int, last: int, frames: int) -> Cameras:
    """Cameras on the way from one view to another: centres on a straight line, rotations by slerp along the shorter arc.

    Args:
        cameras: the views to choose from.
        first: index of the view at the start.
        last: index of the view at the end.
        frames: number of cameras, both ends included.
    """
    poses = cameras.opengl()[[first, last]]
    at = torch.linspace(0.0, 1.0, frames, dtype=poses.dtype, device=poses.device)
    quats = rotations.rotmat_to_unitquat(poses[:, :3, :3])
    rotation = rotations.unitquat_to_rotmat(rotations.unitquat_slerp(quats[0], quats[1], at))
    center = torch.lerp(poses[0, :3, 3], poses[1, :3, 3], at[:, None])
    c2w = torch.cat([rotation, center[:, :, None]], dim=2)
    Ks = torch.lerp(cameras.Ks[first], cameras.Ks[last], at[:, None, None])
    return Cameras.from_opengl(c2w, Ks, cameras.width, cameras.height)
