"""Projection of Gaussians to the image plane, where each has an elliptical footprint.

The perspective is linearised at the centre (Zwicker et al., "EWA Splatting", 2002), so the footprint is again a Gaussian with
covariance [[a, b], [b, c]]. Its exponent is kept as a sum of two squares, from the distribution of y and that of x given y,

    sigma(dx, dy) = 1/2 [ P (dx + S dy)^2 + Q dy^2 ],   P = 1 / (a - b^2 / c),  S = -b / c,  Q = 1 / c,

which stays exact in single precision where the usual A dx^2 + 2 B dx dy + C dy^2 of a long thin splat cancels to noise. The
projection itself runs in double precision: it is a small part of the time, and a float64 reference judges it.

A Gaussian that moves by d while the shutter is open is smeared: a uniform distribution of length |d| has the variance
|d|^2 / 12, so the motion enters the footprint like a fourth axis of that variance. The smeared footprint is larger and its peak
lower by sqrt(det / det'), so that it takes as much light as the moving Gaussian does on average over the exposure. In the same
way the blur of a pixel lowers the peak of an antialiased Gaussian: det is then that of the footprint before the blur. The peak
of what is whole rises by faint_alpha at the end (see motion_blur.py, which has the formulas).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pgsd_nerfstudio.rendering.compilation import kernel, share_out, workers
from pgsd_nerfstudio.rendering.rasterizer import TILE, RasterConfig

# Columns of a projected Gaussian ("splat"): 16 floats, one cache line.
X, Y = 0, 1  # centre, pixels
PRECISION, SHEAR, DROP = 2, 3, 4  # P, S, Q of the exponent
OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
DEPTH = 9  # along the camera's z axis, scene units
CUTOFF = 10  # largest sigma at which alpha reaches min_alpha or faint_alpha
LEFT, RIGHT, TOP, BOTTOM = 11, 12, 13, 14  # pixels that may be touched, end exclusive; LEFT = RIGHT if there are none
DIMMING = 15  # factor of the opacity for the motion, and for the blur of what is antialiased
COLUMNS = 16

SMEAR = 1.0 / math.sqrt(12.0)
"""Standard deviation of a uniform distribution of length one."""


class Lens(NamedTuple):
    """One camera and the rules of projection, as plain numbers for the kernels."""

    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    width: int
    height: int
    left: float
    """Slopes x/z and y/z beyond which the perspective is linearised at the limit instead."""
    right: float
    top: float
    bottom: float
    near: float
    far: float
    blur: float
    square: bool
    radius_sigmas: float
    min_alpha: float
    faint_alpha: float


def lens(K: np.ndarray, width: int, height: int, config: RasterConfig) -> Lens:
    """The lens of a camera.

    Args:
        K: [3, 3] intrinsics in pixels.
        width: of the image in pixels.
        height: of the image in pixels.
        config: the rules of projection.
    """
    (focal_x, _, center_x), (_, focal_y, center_y) = K[:2].tolist()
    slack_x, slack_y = 0.5 * config.frustum_margin * width / focal_x, 0.5 * config.frustum_margin * height / focal_y
    return Lens(
        focal_x=focal_x,
        focal_y=focal_y,
        center_x=center_x,
        center_y=center_y,
        width=width,
        height=height,
        left=-center_x / focal_x - slack_x,
        right=(width - center_x) / focal_x + slack_x,
        top=-center_y / focal_y - slack_y,
        bottom=(height - center_y) / focal_y + slack_y,
        near=float(config.near),
        far=float(config.far),
        blur=float(config.blur),
        square=config.footprint == "square",
        radius_sigmas=float(config.radius_sigmas),
        min_alpha=float(config.min_alpha),
        faint_alpha=float(config.faint_alpha),
    )


@kernel(forceinline=True)
def to_camera(viewmat, means, i):
    """Mean i in camera axes."""
    x = viewmat[0, 0] * means[i, 0] + viewmat[0, 1] * means[i, 1] + viewmat[0, 2] * means[i, 2] + viewmat[0, 3]
    y = viewmat[1, 0] * means[i, 0] + viewmat[1, 1] * means[i, 1] + viewmat[1, 2] * means[i, 2] + viewmat[1, 3]
    z = viewmat[2, 0] * means[i, 0] + viewmat[2, 1] * means[i, 1] + viewmat[2, 2] * means[i, 2] + viewmat[2, 3]
    return x, y, z


@kernel(forceinline=True)
def unit_quaternion(quats, i):
    """Quaternion i as w, x, y, z of length one, and the factor that it was scaled by."""
    w, x, y, z = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    scale = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-24))
    return w * scale, x * scale, y * scale, z * scale, scale


@kernel(forceinline=True)
def principal_axes(viewmat, w, x, y, z):
    """The three principal axes of a Gaussian with this rotation, each a triple in camera axes."""
    xx, yy, zz = x * x, y * y, z * z
    first = (1 - 2 * (yy + zz), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (xx + zz), 2 * (y * z + w * x))
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (xx + yy))
    return turn(viewmat, first), turn(viewmat, second), turn(viewmat, third)


@kernel(forceinline=True)
def turn(viewmat, v):
    """A direction in camera axes."""
    return (
        viewmat[0, 0] * v[0] + viewmat[0, 1] * v[1] + viewmat[0, 2] * v[2],
        viewmat[1, 0] * v[0] + viewmat[1, 1] * v[1] + viewmat[1, 2] * v[2],
        viewmat[2, 0] * v[0] + viewmat[2, 1] * v[1] + viewmat[2, 2] * v[2],
    )


@kernel(forceinline=True)
def on_screen(axis, bend_x, bend_y, z, lens):
    """A short vector in camera axes projected to pixels."""
    return lens.focal_x / z * (axis[0] - bend_x * axis[2]), lens.focal_y / z * (axis[1] - bend_y * axis[2])


@kernel(forceinline=True)
def covariance(axes, scales, i, bend_x, bend_y, z, lens):
    """a, b, c of the footprint, blur included."""
    u0, v0 = on_screen(axes[0], bend_x, bend_y, z, lens)
    u1, v1 = on_screen(axes[1], bend_x, bend_y, z, lens)
    u2, v2 = on_screen(axes[2], bend_x, bend_y, z, lens)
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    u0, u1, u2, v0, v1, v2 = u0 * s0, u1 * s1, u2 * s2, v0 * s0, v1 * s1, v2 * s2
    a = lens.blur + u0 * u0 + u1 * u1 + u2 * u2
    c = lens.blur + v0 * v0 + v1 * v1 + v2 * v2
    return a, u0 * v0 + u1 * v1 + u2 * v2, c


@kernel(forceinline=True)
def _pixels(low, high, extent):
    """Pixels whose centres lie in [low, high], clipped to the image: the first, and one past the last."""
    first = min(max(math.ceil(low - 0.5), 0.0), float(extent))
    last = min(max(math.floor(high - 0.5) + 1.0, 0.0), float(extent))
    return first, last


@kernel(forceinline=True)
def _tiles(low, high, extent):
    """Pixels of the tiles that [low, high] touches, clipped to the image; none if it does not touch the image."""
    if high <= 0.0 or low >= extent:
        return 0.0, 0.0
    return max(math.floor(low / TILE) * TILE, 0.0), min(math.ceil(high / TILE) * TILE, float(extent))


@kernel(forceinline=True)
def _out_of_sight(px, py, size, bend_x, bend_y, z, lens):
    """Whether even a ball of this size would not touch the image; most Gaussians out of sight need no further work."""
    stretch = max(lens.focal_x, lens.focal_y) / z * size
    variance = lens.blur + stretch * stretch * (1.0 + bend_x * bend_x + bend_y * bend_y)
    reach = max(lens.radius_sigmas, 3.5) * math.sqrt(variance + 0.1) + 2.0
    return px + reach < 0.0 or px - reach > lens.width or py + reach < 0.0 or py - reach > lens.height


@kernel(forceinline=True)
def _half_sides(a, b, c, cutoff, lens):
    """Half sides in whole pixels of the rectangle that decides which tiles a splat enters."""
    if lens.square:
        middle = 0.5 * (a + c)
        radius = math.ceil(lens.radius_sigmas * math.sqrt(middle + math.sqrt(max(0.01, middle * middle - a * c + b * b))))
        return radius, radius
    sigmas = min(lens.radius_sigmas, math.sqrt(2.0 * cutoff))
    return math.ceil(sigmas * math.sqrt(a)), math.ceil(sigmas * math.sqrt(c))


@kernel(forceinline=True)
def _project_one(i, means, quats, scales, opacity, motions, moves, antialiased, whole, viewmat, lens, splats):
    """Write the geometry of splat i."""
    threshold = lens.faint_alpha if whole else lens.min_alpha
    splats[i, LEFT] = 0.0
    splats[i, RIGHT] = 0.0
    x, y, z = to_camera(viewmat, means, i)
    splats[i, DEPTH] = z
    if not (lens.near <= z <= lens.far) or not opacity > 0.0 or (opacity < threshold and not whole):
        return
    slope_x, slope_y = x / z, y / z
    bend_x, bend_y = min(lens.right, max(lens.left, slope_x)), min(lens.bottom, max(lens.top, slope_y))
    px, py = lens.focal_x * slope_x + lens.center_x, lens.focal_y * slope_y + lens.center_y
    size = max(scales[i, 0], scales[i, 1], scales[i, 2])
    if moves:
        size += math.sqrt(motions[i, 0] ** 2 + motions[i, 1] ** 2 + motions[i, 2] ** 2)
    if _out_of_sight(px, py, size, bend_x, bend_y, z, lens):
        return
    qw, qx, qy, qz, _ = unit_quaternion(quats, i)
    a, b, c = covariance(principal_axes(viewmat, qw, qx, qy, qz), scales, i, bend_x, bend_y, z, lens)
    dimming = 1.0
    if antialiased or moves:
        grown = a * c - b * b
        still = (a - lens.blur) * (c - lens.blur) - b * b if antialiased else grown
    if moves:
        u, v = on_screen(turn(viewmat, (motions[i, 0], motions[i, 1], motions[i, 2])), bend_x, bend_y, z, lens)
        u, v = SMEAR * u, SMEAR * v
        # The determinant by the matrix determinant lemma, without the cancellation of a c - b^2 in a thin streak.
        grown = grown + c * u * u - 2.0 * b * u * v + a * v * v
        a, b, c = a + u * u, b + u * v, c + v * v
    if antialiased or moves:
        dimming = math.sqrt(max(still, 0.0) / grown)
        opacity = opacity * dimming
    if not opacity > 0.0:
        return
    if whole:
        opacity += threshold
    spread = a - b * b / c
    if not spread > 0.0 or opacity < threshold:
        return
    cutoff = math.log(opacity / threshold)
    half_width, half_height = _half_sides(a, b, c, cutoff, lens)
    reach_x, reach_y = math.sqrt(2.0 * cutoff * a) + 1e-3, math.sqrt(2.0 * cutoff * c) + 1e-3
    tile_left, tile_right = _tiles(px - half_width, px + half_width, lens.width)
    tile_top, tile_bottom = _tiles(py - half_height, py + half_height, lens.height)
    left, right = _pixels(px - reach_x, px + reach_x, lens.width)
    top, bottom = _pixels(py - reach_y, py + reach_y, lens.height)
    left, right = max(left, tile_left), min(right, tile_right)
    top, bottom = max(top, tile_top), min(bottom, tile_bottom)
    if left < right and top < bottom:
        splats[i, X], splats[i, Y] = px, py
        splats[i, PRECISION], splats[i, SHEAR], splats[i, DROP] = 1.0 / spread, -b / c, 1.0 / c
        splats[i, OPACITY], splats[i, CUTOFF], splats[i, DIMMING] = opacity, cutoff, dimming
        splats[i, LEFT], splats[i, RIGHT], splats[i, TOP], splats[i, BOTTOM] = left, right, top, bottom


def project(
    means: np.ndarray,  # [n, 3] float32
    quats: np.ndarray,  # [n, 4] float32
    scales: np.ndarray,  # [n, 3] float32
    opacities: np.ndarray,  # [n] float32
    motions: np.ndarray,  # [n, 3] float32, or [0, 3] where nothing moves
    antialiased: bool,
    whole: bool,
    viewmat: np.ndarray,  # [4, 4] float64
    lens: Lens,
    splats: np.ndarray,  # [n, 16] float32, written
) -> None:
    """Write the geometry of all splats and leave their colours as they are."""
    share_out(_project, workers(), means, quats, scales, opacities, motions, antialiased, whole, viewmat, lens, splats)


@kernel()
def _project(worker, workers, means, quats, scales, opacities, motions, antialiased, whole, viewmat, lens, splats):
    n, moves = means.shape[0], motions.shape[0] > 0
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        opacity = np.float64(opacities[i])
        _project_one(i, means, quats, scales, opacity, motions, moves, antialiased, whole, viewmat, lens, splats)
