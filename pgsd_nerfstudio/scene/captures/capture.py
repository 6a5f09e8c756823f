"""What a file says of the views of a capture: where they were taken, through which lens, and where the photographs lie."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.lenses import Lens
from pgsd_nerfstudio.scene.captures.photographs import Photograph
from pgsd_nerfstudio.scene.errors import SceneError

FARTHEST = 1e12  # scene units from the origin; georeferenced scenes lie at some 1e7
ROUNDED = 0.02  # largest error of an axis by rounding: three decimals in a text give 0.002
EXACT = 1e-4  # a rotation whose axes are this good is taken as it is


@dataclass(frozen=True, eq=False)
class Placement:
    """One way in which the coordinates of a splat may follow from those of its cameras."""

    name: str
    """What was done to the cameras, as it is told: "turned back by applied_transform"."""
    move: Float64[Tensor, "4 4"]
    """Rotation times scale, and shift: from the cameras' coordinates to the splat's."""


@dataclass(frozen=True, eq=False)
class Capture:
    """The views of a capture, in the order of their photographs' names."""

    poses: Float64[Tensor, "t 4 4"]
    """Camera to world, OpenGL axes as nerfstudio's, in the file's own coordinates."""
    photographs: tuple[Photograph, ...]
    """One for each view."""
    placements: tuple[Placement, ...] = ()
    """Other coordinates in which a splat of this capture may be, the likeliest first."""
    applied: Float64[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))
    """What was done to the original world before these poses (applied_transform), without its scale."""
    applied_scale: float = 1.0

    def __len__(self) -> int:
        return self.poses.shape[0]

    def moved(self, move: Float64[Tensor, "4 4"]) -> Capture:
        """The same capture in other coordinates.

        Args:
            move: rotation times scale, and shift.
        """
        poses = moved_poses(self.poses, move)
        back = torch.linalg.inv(move)
        return replace(self, poses=poses, placements=tuple(Placement(p.name, p.move @ back) for p in self.placements))

    def cameras(self) -> Cameras:
        """Pinholes with the focal lengths of the lenses; where image sizes differ, all take the most frequent one (cropped,
        never stretched)."""
        lenses = [photograph.lens for photograph in self.photographs]
        (width, height), _ = Counter((lens.width, lens.height) for lens in lenses).most_common(1)[0]
        Ks = torch.stack([_pinhole(lens, width, height) for lens in lenses])
        opencv = self.poses @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        return Cameras(torch.linalg.inv(opencv).float(), Ks.float(), width, height)


def moved_poses(poses: Float[Tensor, "t 4 4"], move: Float64[Tensor, "4 4"]) -> Float64[Tensor, "t 4 4"]:
    """Camera-to-world matrices in other coordinates; their rotations stay such.

    Args:
        poses: camera to world.
        move: rotation times scale, and shift.
    """
    moved = move @ poses.double()
    moved[:, :3, :3] /= torch.linalg.det(move[:3, :3]) ** (1 / 3)
    return moved


def checked_poses(matrices: Float64[Tensor, "t 4 4"], names: Sequence[str], source: Path) -> Float64[Tensor, "t 4 4"]:
    """Poses whose rotations are such.

    A common factor of the three axes, which Blender writes for scaled cameras, is taken out, and axes that were rounded in a
    text are made perpendicular again. nerfstudio does the first for rays and neither for splats.

    Args:
        matrices: camera to world, as a file gives them; the last row does not matter.
        names: of the views, for messages.
        source: the file.

    Raises:
        SceneError: a matrix holds a NaN, lies too far away, or is mirrored, singular or sheared.
    """
    poses = matrices.clone()
    poses[:, 3] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    _refuse(~torch.isfinite(poses).flatten(1).all(1), names, source, "holds a NaN or infinity")
    _refuse(poses[:, :3, 3].abs().amax(1) > FARTHEST, names, source, f"lies more than {FARTHEST:g} units from the origin")
    axes = poses[:, :3, :3]
    _refuse(
        (axes.abs().amax((1, 2)) > FARTHEST) | (axes.norm(dim=1).amin(1) < 1e-12),
        names,
        source,
        "has axes of no length or of too great a one",
    )
    volume = torch.linalg.det(axes)
    scale = volume.abs() ** (1 / 3)
    _refuse(scale < 1e-3 * axes.norm(dim=1).amax(1), names, source, "is singular: its axes lie in one plane")
    _refuse(volume < 0, names, source, "is mirrored: its axes are left-handed")
    axes = torch.where((scale - 1).abs()[:, None, None] > EXACT, axes / scale[:, None, None], axes)
    error = (axes.transpose(1, 2) @ axes - torch.eye(3, dtype=torch.float64)).abs().amax((1, 2))
    _refuse(error > ROUNDED, names, source, "is sheared: its axes are not perpendicular and of one length")
    u, _, vh = torch.linalg.svd(axes)
    poses[:, :3, :3] = torch.where(error[:, None, None] > EXACT, u @ vh, axes)
    return poses


def _refuse(bad: Tensor, names: Sequence[str], source: Path, why: str) -> None:
    if bool(bad.any()):
        first, others = names[int(bad.to(torch.uint8).argmax())], int(bad.sum()) - 1
        more = f" (and of {others} more)" if others else ""
        raise SceneError(f"{source}: the pose of {first}{more} {why}; write the cameras again, or take it out of the file")


def _pinhole(lens: Lens, width: int, height: int) -> Float64[Tensor, "3 3"]:
    return Cameras(torch.eye(4, dtype=torch.float64)[None], lens.K[None], lens.width, lens.height).resized(width, height).Ks[0]
