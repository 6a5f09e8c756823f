"""Which particles of a frame a camera can show: what lies behind or beside it need not become Gaussians.

A particle is kept if a ball around it touches the picture, by the rule with which the projection leaves out what is out of
sight and with a pixel to spare; so leaving it out changes no picture. The ball's standard deviation is the largest one of the
particle plus the way that it makes while the shutter is open.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame
from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.air.reach import FADE
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians

LENS = 0.3  # m; nearer than this to the camera's centre nothing that flies is drawn
SPARE = 1.0  # pixels around the picture: single precision moves a centre by less


class Eye(NamedTuple):
    """One camera in metres of the metric frame, as plain numbers for the kernel."""

    viewmat: np.ndarray
    """[3, 4] float64, metric frame to camera axes (OpenCV), metres."""
    focal_x: float
    """Pixels, as the following."""
    focal_y: float
    center_x: float
    center_y: float
    width: float
    height: float
    near: float
    """Metres along the axis, below which nothing is drawn."""
    far: float
    blur: float
    """Pixels squared of the blur of a pixel."""
    sigmas: float
    """Standard deviations at which a footprint ends."""
    margin: float
    """As `RasterConfig.frustum_margin`."""

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Position of the camera in metres."""
        return -self.viewmat[:, :3].T @ self.viewmat[:, 3]

    @staticmethod
    def of(camera: Cameras, config: RasterConfig, frame: Frame) -> Eye:
        """The eye of a camera.

        Args:
            camera: one camera in scene units.
            config: rules of the rasterizer that will show what is kept; lengths in scene units.
            frame: the metric frame of the scene.

        Raises:
            ValueError: there is not exactly one camera.
        """
        if len(camera) != 1:
            raise ValueError(f"an eye is one camera, got {len(camera)}")
        metres_per_unit = frame.metres_per_unit
        viewmat = frame.cameras_to_metric(camera).viewmats[0, :3].double().numpy(force=True)
        viewmat = np.ascontiguousarray(viewmat)
        (focal_x, _, center_x), (_, focal_y, center_y) = camera.Ks[0, :2].tolist()
        sides = float(camera.width), float(camera.height)
        near, far = config.near * metres_per_unit, config.far * metres_per_unit
        rules = near, far, config.blur, config.radius_sigmas, config.frustum_margin
        return Eye(viewmat, focal_x, focal_y, center_x, center_y, *sides, *rules)


class Extents(NamedTuple):
    """Largest standard deviations of all particles, in metres."""

    active: Float[np.ndarray, " p"]
    collided: Float[np.ndarray, " p"]

    @staticmethod
    def of(look: InitialLook, widening: float = 1.0) -> Extents:
        """Of a look on the CPU; what spreads after it has landed ends with the larger size.

        Args:
            look: of all particles.
            widening: factor on the size of the active ones.
        """
        active, collided = (state.scales.amax(1).numpy(force=True) for state in (look.active, look.collided))
        return Extents(widening * active, collided)


def fading_in(
    positions: Float[Tensor, "n 3"], reaches: Float[Tensor, " n"], sizes: Float[Tensor, " n"], center: Float[Tensor, "3"]
) -> Float[Tensor, " n"]:
    """Factor on the opacity of flying particles: 0 farther from the camera than their reach, 1 from 1 / (1 + FADE) of it on.

    Right before the lens a particle is out of focus and spread over so much of the picture that it is not seen: between twice
    LENS and LENS it fades out. A parcel of fog does so between four standard deviations and two, so that the picture does not
    jump as the camera enters it.

    Args:
        positions: metres.
        reaches: `ParticleHistory.reaches` of the particles, metres.
        sizes: largest standard deviations of the particles, metres.
        center: position of the camera, metres.
    """
    distances = (positions - center).norm(dim=1).clamp_min(1e-6)
    before = distances / (2.0 * sizes).clamp_min(LENS) - 1.0
    return ((reaches / distances - 1.0) / FADE).clamp(0.0, 1.0) * before.clamp(0.0, 1.0)


def faded_in(instant: RolloutFrame, reaches: Float[Tensor, " p"], eye: Eye) -> Gaussians:
    """The Gaussians of a frame as one camera sees them: flying particles within their reach; differentiable.

    Args:
        instant: of the roll-out.
        reaches: `ParticleHistory.reaches`, metres.
        eye: the camera.
    """
    gaussians, flying = instant.gaussians, len(instant.active)
    center = torch.from_numpy(eye.center).to(gaussians.means)
    sizes = gaussians.scales[:flying].detach().amax(1)
    near = fading_in(gaussians.means[:flying], reaches[instant.active], sizes, center)
    factors = torch.cat([near, near.new_ones(len(gaussians) - flying)])
    return replace(gaussians, opacities=gaussians.opacities * factors)


def in_sight(
    history: ParticleHistory, frame: int, extents: Extents, exposure: float, eye: Eye
) -> tuple[Int[Tensor, " n"], Int[Tensor, " m"]]:
    """Ids of the active particles within reach and of the collided particles that a camera can show, both ascending.

    Args:
        history: on the CPU.
        frame: index of the frame.
        extents: of the particles, active and collided.
        exposure: seconds that the shutter is open.
        eye: the camera.
    """
    active, collided = _in_sight(
        history.births.numpy(),
        history.ends.numpy(),
        history.collided.numpy(),
        history.offsets.numpy(),
        history.positions.numpy(),
        history.rest_positions.numpy(),
        history.reaches.numpy(),
        frame,
        extents.active,
        extents.collided,
        exposure * history.fps,
        eye,
    )
    return torch.from_numpy(active), torch.from_numpy(collided)


@kernel()
def _in_sight(
    births, ends, has_collided, offsets, positions, rest_positions, reaches, frame, active_extents, collided_extents, share, eye
):
    """`share` of the way from one frame to the next is made while the shutter is open."""
    n = births.shape[0]
    active, collided, rows = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    n_flying, n_active, n_collided = 0, 0, 0
    for i in range(n):
        if births[i] > frame:
            continue
        if frame < ends[i]:
            active[n_flying] = i
            rows[n_flying] = offsets[i] + frame - births[i]
            n_flying += 1
        elif has_collided[i] and _seen(rest_positions[i], math.inf, collided_extents[i], 0.0, eye):
            collided[n_collided] = i
            n_collided += 1
    # The positions of a frame lie far apart in memory. A loop that does nothing but fetch them waits for many at once.
    places = np.empty((n_flying, 3), positions.dtype)
    for k in range(n_flying):
        row = rows[k]
        places[k, 0], places[k, 1], places[k, 2] = positions[row, 0], positions[row, 1], positions[row, 2]
    for k in range(n_flying):
        i = active[k]
        seen = _seen(places[k], reaches[i], active_extents[i], 0.0, eye)
        if share > 0.0 and not seen and _seen(places[k], reaches[i], math.inf, 0.0, eye):
            # The way of this or of a neighbouring frame (see ParticleHistory.displacement_at): the longest of them.
            way = 0.0
            for row in range(max(rows[k] - 1, offsets[i] + 1), min(rows[k] + 1, offsets[i + 1] - 1) + 1):
                x = positions[row, 0] - positions[row - 1, 0]
                y = positions[row, 1] - positions[row - 1, 1]
                z = positions[row, 2] - positions[row - 1, 2]
                way = max(way, math.sqrt(x * x + y * y + z * z))
            seen = _seen(places[k], reaches[i], active_extents[i], share * way, eye)
        if seen:
            active[n_active] = i
            n_active += 1
    return active[:n_active].copy(), collided[:n_collided].copy()


@kernel(inline="always")
def _seen(point, reach, extent, way, eye):
    """Whether a ball around a point, of standard deviation `extent` + `way`, touches the picture within reach of the camera."""
    m = eye.viewmat
    px, py, pz = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    if z < eye.near * 0.999 or z > eye.far:
        return False
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
    if x * x + y * y + z * z > reach * reach:
        return False
    slope_x, slope_y = x / z, y / z
    slack_x, slack_y = 0.5 * eye.margin * eye.width / eye.focal_x, 0.5 * eye.margin * eye.height / eye.focal_y
    bend_x = min((eye.width - eye.center_x) / eye.focal_x + slack_x, max(-eye.center_x / eye.focal_x - slack_x, slope_x))
    bend_y = min((eye.height - eye.center_y) / eye.focal_y + slack_y, max(-eye.center_y / eye.focal_y - slack_y, slope_y))
    stretch = max(eye.focal_x, eye.focal_y) / z * (extent + way)
    variance = eye.blur + stretch * stretch * (1.0 + bend_x * bend_x + bend_y * bend_y)
    radius = max(eye.sigmas, 3.5) * math.sqrt(variance + 0.1) + 2.0 + SPARE
    u, v = eye.focal_x * slope_x + eye.center_x, eye.focal_y * slope_y + eye.center_y
    return u + radius >= 0.0 and u - radius <= eye.width and v + radius >= 0.0 and v - radius <= eye.height
