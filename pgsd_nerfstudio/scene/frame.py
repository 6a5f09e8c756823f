"""The metric frame of a scene: scene units to metres, z up, the ground at z = 0.

A capture knows neither scale nor gravity. Up is estimated from the way the cameras were held, the ground from the lowest opaque
Gaussians below them, and the scale from the height at which people hold a camera, unless it is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

CAMERA_HEIGHT = 1.5  # m above the ground, of a camera held by a standing person
SNAP = 2.0  # degrees: an estimated up this close to +z is +z
ORIENTED_WITHIN = 25.0  # degrees: if up cannot be estimated well, a +z this close to the cameras' mean up is trusted
MIN_SPREAD = 0.05  # mean square of the horizontal axes across their main direction: views from an arc of 45 degrees
SKY = 10.0  # a Gaussian so many times farther away than the median is sky
CELLS = 32  # ground samples across the area inside the cameras' ring
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
"""Directions that have a name."""


@dataclass(frozen=True, eq=False)
class Frame:
    """x_metric = metres_per_unit * rotation @ (x_scene - origin), with z up and gravity along -z."""

    metres_per_unit: float
    """Length of one scene unit in metres."""
    rotation: Float[Tensor, "3 3"]
    """Scene axes to metric axes."""
    origin: Float[Tensor, "3"]
    """Scene point of metric zero. It lies on the ground, below the point that the cameras look at."""
    source: str = ""
    """One sentence that tells how up, ground and scale were found."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.metres_per_unit) and self.metres_per_unit > 0):
            raise ValueError(f"metres per scene unit must be a positive number, got {self.metres_per_unit}")

    def to_metric(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Scene points in metres; differentiable, on the points' device."""
        return self.vectors_to_metric(points - self.origin.to(points))

    def to_scene(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Metric points in scene units; differentiable, on the points' device."""
        return self.vectors_to_scene(points) + self.origin.to(points)

    def vectors_to_metric(self, vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Displacements or velocities of scene units in metres: rotated and scaled, not shifted."""
        return vectors @ (self.metres_per_unit * self.rotation.T).to(vectors)

    def vectors_to_scene(self, vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Metric displacements or velocities in scene units: rotated and scaled, not shifted."""
        return vectors @ (self.rotation / self.metres_per_unit).to(vectors)

    def cameras_to_metric(self, cameras: Cameras) -> Cameras:
        """The same views with centres and depths in metres."""
        rotation, shift = cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, 3]
        viewmats = cameras.viewmats.clone()
        viewmats[:, :3, :3] = rotation @ self.rotation.T.to(rotation)
        viewmats[:, :3, 3] = self.metres_per_unit * (rotation @ self.origin.to(rotation) + shift)
        return replace(cameras, viewmats=viewmats)

    def gaussians_to_metric(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in scene units as Gaussians in metres, the inverse of `gaussians_to_scene`; differentiable.

        Raises:
            ValueError: the colours are spherical harmonics above degree 0, as for `gaussians_to_scene`.
        """
        scales = gaussians.scales * self.metres_per_unit
        return _converted(gaussians, self.rotation, self.to_metric, self.vectors_to_metric, scales)

    def gaussians_to_scene(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in metres as Gaussians in scene units; differentiable.

        Raises:
            ValueError: the colours are spherical harmonics above degree 0. These depend on the viewing direction and would have
                to be rotated too; the weather only adds Gaussians of plain RGB.
        """
        scales = gaussians.scales / self.metres_per_unit
        return _converted(gaussians, self.rotation.T, self.to_scene, self.vectors_to_scene, scales)


def _converted(
    gaussians: Gaussians,
    rotation: Float[Tensor, "3 3"],
    points: Callable[[Tensor], Tensor],
    vectors: Callable[[Tensor], Tensor],
    scales: Float[Tensor, "n 3"],
) -> Gaussians:
    """Gaussians in other axes: centres and displacements by the two functions, orientations by the rotation."""
    if gaussians.sh_degree:
        raise ValueError(f"only Gaussians of plain colour change frames, found SH colours of degree {gaussians.sh_degree}")
    turn = rotations.rotmat_to_unitquat(rotation.double()).to(gaussians.quats)  # xyzw
    quats = rotations.quat_product(turn.expand(len(gaussians), 4), rotations.quat_wxyz_to_xyzw(gaussians.quats))
    return replace(
        gaussians,
        means=points(gaussians.means),
        quats=rotations.quat_xyzw_to_wxyz(quats),
        scales=scales,
        displacements=None if gaussians.displacements is None else vectors(gaussians.displacements),
    )


def direction(up: str | Sequence[float]) -> tuple[float, float, float]:
    """The direction that is meant by the name of an axis (x, -y and so on) or by three numbers; of length 1.

    Raises:
        ValueError: it is neither, or the numbers are zero or not finite.
    """
    try:
        numbers = AXES[up] if isinstance(up, str) else tuple(float(value) for value in up)
        x, y, z = numbers
        length = math.hypot(x, y, z)
        if not 0 < length < math.inf:
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"up must be one of {', '.join(AXES)}, or three numbers that are not all zero, got {up!r}") from error
    return x / length, y / length, z / length


def estimate_frame(
    cameras: Cameras,
    gaussians: Gaussians,
    metres_per_unit: float | None = None,
    up: tuple[float, float, float] | None = None,
) -> Frame:
    """Estimate the metric frame of a capture.

    Up is perpendicular to the cameras' horizontal axes, or +z if that is nearly the same. The ground is taken as level.

    Args:
        cameras: the training views, in scene units.
        gaussians: the frozen scene, in scene units.
        metres_per_unit: length of a scene unit. None: it is chosen so that the cameras' median height above the ground is
            1.5 m.
        up: direction in scene axes, of any length. None: it is estimated from the way the cameras were held.

    Raises:
        ValueError: there are no cameras, they stand on the ground, `metres_per_unit` is not positive, or `up` is no direction.
    """
    if len(cameras) == 0:
        raise ValueError("a frame needs at least one camera, found none")
    if up is None:
        upward, up_source = _up(cameras)
    else:
        upward = torch.tensor(direction(up), dtype=torch.float64)
        up_source = f"up is taken as {_numbers(upward)}"
    centers = cameras.centers.double()
    middle, radius = attention(cameras, gaussians)
    camera_height = (centers @ upward).median()
    ground, ground_source = ground_level(gaussians, upward, middle, radius, camera_height)
    height = float(camera_height - ground)
    if metres_per_unit is None:
        if not 0 < height < math.inf:
            raise ValueError("the cameras stand on the ground, which gives no scale")
        metres_per_unit = CAMERA_HEIGHT / height
        scale_source = f"scale from cameras taken as {CAMERA_HEIGHT} m above the ground"
    else:
        scale_source = f"scale as given, which puts the cameras {metres_per_unit * height:.2f} m above the ground"
    origin = middle + (ground - middle @ upward) * upward
    return Frame(
        float(metres_per_unit),
        rotation_to_z(upward).float(),
        origin.float(),
        f"{up_source}; {ground_source}; {scale_source}: 1 scene unit = {metres_per_unit:.4g} m",
    )


def _up(cameras: Cameras) -> tuple[Float[Tensor, "3"], str]:
    """The direction perpendicular to the right-hand axes of all cameras, since cameras may look down but are rarely rolled.

    This needs views from several sides. With fewer, up is +z if the capture was oriented to it, else the mean of the cameras'
    own up directions.
    """
    axes = torch.linalg.inv(cameras.viewmats.double())[:, :3, :3]
    right, mean_up = axes[:, :, 0], torch.nn.functional.normalize(-axes[:, :, 1].mean(0), dim=0)  # OpenCV's y points down
    up, spread = mean_up, torch.zeros(3, dtype=torch.float64)
    for _ in range(20):  # the weights minimise absolute deviations, so that a few cameras held sideways do not tilt the result
        weight = 1 / (right @ up).abs().clamp_min(1e-2)[:, None]
        spread, vectors = torch.linalg.eigh((weight * right).T @ right / weight.sum())
        up = vectors[:, 0] * (vectors[:, 0] @ mean_up).sign()
    from_z = math.degrees(math.acos(float(up[2].clamp(-1, 1))))
    if spread[1] > max(MIN_SPREAD, 10 * spread[0]) and up @ mean_up > 0.5:
        if from_z > SNAP:
            return up, f"up is perpendicular to the cameras' horizontal axes ({_numbers(up)})"
    elif math.degrees(math.acos(float(mean_up[2].clamp(-1, 1)))) > ORIENTED_WITHIN:
        return mean_up, f"up is the cameras' mean up ({_numbers(mean_up)})"
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return z, "up is +z, to which the cameras are oriented"


def _numbers(vector: Float[Tensor, "3"]) -> str:
    return ", ".join(f"{value:.2f}" for value in vector.tolist())


def attention(cameras: Cameras, gaussians: Gaussians) -> tuple[Float[Tensor, "3"], float]:
    """The point nearest to all optical axes (least squares) and the cameras' median distance from it.

    Cameras that look outward or all in one direction have no such point before them. For them the point lies half the median
    distance of the Gaussians ahead of their mean position, and that median is the distance. The sky does not count.

    Args:
        cameras: at least one, in scene units.
        gaussians: the frozen scene, in scene units.
    """
    centers, forward = cameras.centers.double(), torch.linalg.inv(cameras.viewmats.double())[:, :3, 2]
    middle = centers.mean(0)
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    system = across.mean(0)
    if torch.linalg.eigvalsh(system)[0] > 1e-3:
        point = torch.linalg.solve(system, (across @ centers[:, :, None]).mean(0)).squeeze(1)
        if (((point - centers) * forward).sum(1) > 0).double().mean() > 0.5:
            return point, float((centers - point).norm(dim=1).median())
    distances = (gaussians.means.double().cpu() - middle).norm(dim=1)
    while (sky := distances > SKY * (distances.median() if len(distances) else 1.0)).any():
        distances = distances[~sky]
    reach = distances.median() if len(distances) else torch.tensor(1.0)
    return middle + 0.5 * reach * forward.mean(0), float(reach)


def ground_level(
    gaussians: Gaussians, up: Float[Tensor, "3"], middle: Float[Tensor, "3"], radius: float, camera_height: Float[Tensor, ""]
) -> tuple[Float[Tensor, ""], str]:
    """Height of the ground along `up`: the level on which most of the area inside the cameras' ring has its lowest Gaussians.

    Only opaque Gaussians count. The second value tells how the ground was found.
    """
    axes = rotation_to_z(up)
    local = (gaussians.means.double().cpu() - middle) @ axes.T
    heights = local[:, 2] + middle @ up
    opaque = (gaussians.opacities.cpu() > 0.5) & (gaussians.scales.cpu().amax(1) < 0.2 * radius)
    inside = opaque & (local[:, :2].norm(dim=1) < radius) & (heights < camera_height) & (heights > camera_height - 4 * radius)
    if int(inside.sum()) < 20:
        level = camera_height - radius / 2
        return level, "no opaque Gaussians below the cameras, so the ground is taken half a ring's radius below them"
    # Each cell has one vote, so that a finely modelled table does not outvote a plain floor. A cell votes for its tenth
    # percentile, which ignores stray Gaussians below the floor.
    cell = ((local[inside, :2] / radius + 1) * (CELLS / 2)).long().clamp(0, CELLS - 1)
    order = torch.argsort(heights[inside], stable=True)
    cell_id, sorted_heights = (cell[:, 0] * CELLS + cell[:, 1])[order], heights[inside][order]
    by_cell = torch.argsort(cell_id, stable=True)
    _, counts = torch.unique_consecutive(cell_id[by_cell], return_counts=True)
    first = counts.cumsum(0) - counts
    votes = sorted_heights[by_cell][first + counts // 10]
    tolerance = 0.02 * radius
    near = (votes[:, None] - votes[None, :]).abs() < tolerance
    level = votes[near.sum(1).argmax()]
    for _ in range(3):
        level = votes[(votes - level).abs() < tolerance].median()
    share = float(((votes - level).abs() < tolerance).double().mean())
    return level, f"ground from the lowest opaque Gaussians inside the cameras' ring ({share:.0%} of its area is level)"


def rotation_to_z(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes `up` to +z."""
    z = torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype)
    axis = torch.linalg.cross(up, z)
    sine, cosine = axis.norm(), up @ z
    if sine < 1e-9:
        return torch.eye(3, dtype=up.dtype) if cosine > 0 else torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=up.dtype))
    return rotations.rotvec_to_rotmat(axis / sine * torch.atan2(sine, cosine))
