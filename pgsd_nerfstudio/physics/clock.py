"""When and where a simulation takes place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

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


LOOK_AHEAD = 5.0  # m; how far the domain reaches in front of a camera: flakes farther away are fainter than noise
MARGIN = 1.5  # m around the cameras and the points before them, so that flakes pass close to the lens too
ABOVE = 2.0  # m above the highest camera
WIDEST = 20.0  # m; a wider domain would thin the particles out beyond use


def domain_of(scene: Scene) -> Domain:
    """The domain that the scene's cameras look through, from the ground to above the highest camera."""
    cameras = scene.cameras
    centers = scene.frame.to_metric(cameras.centers.float()).cpu().numpy().astype(np.float64)
    forward = cameras.viewmats[:, 2, :3].float() @ scene.frame.rotation.to(cameras.viewmats.device).float().T
    ahead = centers + LOOK_AHEAD * forward.cpu().numpy()
    seen = np.concatenate([centers, ahead])[:, :2]
    lower, upper = seen.min(0) - MARGIN, seen.max(0) + MARGIN
    middle, half = (lower + upper) / 2, np.clip((upper - lower) / 2, 2.0, WIDEST / 2)
    top = max(float(centers[:, 2].max()) + ABOVE, 3.0)
    lower3 = (float(middle[0] - half[0]), float(middle[1] - half[1]), -0.3)
    return Domain(lower3, (float(middle[0] + half[0]), float(middle[1] + half[1]), top))
