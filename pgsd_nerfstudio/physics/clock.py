"""When and where a simulation takes place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.scene.camera_path import choose_views

if TYPE_CHECKING:
    from pgsd_nerfstudio.scene.scene import Scene


@dataclass(frozen=True)
class Clock:
    """Rendered time steps. Frame f shows the instant f / fps."""

    fps: float = 25.0
    frames: int = 250

    def __post_init__(self) -> None:
        if not self.fps > 0 or self.frames < 1:
            raise ValueError(f"a clock needs fps > 0 and at least one frame, got fps {self.fps:g} and {self.frames} frames")

    @property
    def step(self) -> float:
        """Seconds from frame to frame."""
        return 1.0 / self.fps

    @property
    def seconds(self) -> float:
        return self.frames / self.fps


@dataclass(frozen=True)
class Domain:
    """Axis-aligned box of air, in metres of the metric frame (z up)."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"a domain needs lower < upper on each axis, got {self.lower} and {self.upper} m")

    @property
    def size(self) -> tuple[float, float, float]:
        x, y, z = (b - a for a, b in zip(self.lower, self.upper, strict=True))
        return x, y, z

    @property
    def area(self) -> float:
        """Area of the horizontal cross-section, m^2."""
        return self.size[0] * self.size[1]

    @property
    def volume(self) -> float:
        """m^3."""
        return self.area * self.size[2]

    def contains(self, points: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Whether each point is in the box, its sides included.

        Args:
            points: in metres.
        """
        return ((points >= self.lower) & (points <= self.upper)).all(1)

    def distances(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Distance of each point from the box in metres, 0 inside.

        Args:
            points: in metres.
        """
        outside = np.maximum(np.asarray(self.lower) - points, points - np.asarray(self.upper)).clip(0.0)
        return np.linalg.norm(outside, axis=1)


SIGHT = 20.0  # m; a particle farther from every camera than this is not seen
LOOK_AHEAD = 5.0  # m; how far the domain reaches in front of a camera: flakes farther away are fainter than noise
MARGIN = 1.5  # m around the cameras and the points before them, so that flakes pass close to the lens too
ABOVE = 2.0  # m above the highest camera
BELOW = 0.3  # m below the ground
WIDEST = 20.0  # m; a wider domain would thin the particles out beyond use


def domain_of(scene: Scene) -> Domain:
    """The domain that the scene's cameras look through, from the ground to above the highest camera.

    It is at most 20 m wide. Where cameras stand so far apart that most do not look into the 20 m in their middle, as around a
    building or from a drone, it lies around the two views between which a preview moves, or around the last one if these are
    more than 20 m apart. Ground that is so far below all of its cameras that no particle on it is seen is left out.
    """
    cameras = scene.cameras
    centers = scene.frame.to_metric(cameras.centers.float()).cpu().numpy().astype(np.float64)
    forward = cameras.viewmats[:, 2, :3].float() @ scene.frame.rotation.to(cameras.viewmats.device).float().T
    ahead = centers + LOOK_AHEAD * forward.cpu().numpy()
    middle, half = _plan(centers, ahead)
    if (np.abs(ahead[:, :2] - middle) <= half).all(1).mean() < 0.5:
        shown = list(choose_views(cameras, scene.frame))
        if np.linalg.norm(centers[shown[0]] - centers[shown[1]]) > WIDEST:
            shown = shown[1:]
        centers, ahead = centers[shown], ahead[shown]
        middle, half = _plan(centers, ahead)
    bottom, top = max(float(centers[:, 2].min()) - SIGHT, 0.0) - BELOW, max(float(centers[:, 2].max()) + ABOVE, 3.0)
    lower3 = (float(middle[0] - half[0]), float(middle[1] - half[1]), bottom)
    return Domain(lower3, (float(middle[0] + half[0]), float(middle[1] + half[1]), top))


def _plan(centers: Float[ndarray, "t 3"], ahead: Float[ndarray, "t 3"]) -> tuple[Float[ndarray, "2"], Float[ndarray, "2"]]:
    """Middle and half widths of the plan around cameras and the points before them, in metres."""
    seen = np.concatenate([centers, ahead])[:, :2]
    lower, upper = seen.min(0) - MARGIN, seen.max(0) + MARGIN
    return (lower + upper) / 2, np.clip((upper - lower) / 2, 2.0, WIDEST / 2)
