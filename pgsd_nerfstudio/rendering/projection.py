"""Gaussians to the image plane: the elliptical footprint of each on the screen, and the way back for gradients.

Zwicker et al., "EWA Splatting" (2002): the perspective is linearised at the centre, so the footprint is again a Gaussian with
covariance [[a, b], [b, c]]. Its exponent is kept as a sum of two squares, from the distribution of y and that of x given y,

    sigma(dx, dy) = 1/2 [ P (dx + S dy)^2 + Q dy^2 ],   P = 1 / (a - b^2 / c),  S = -b / c,  Q = 1 / c,

which stays exact in single precision where the usual A dx^2 + 2 B dx dy + C dy^2 of a long thin splat cancels to noise. The
projection itself runs in double precision: it is a small part of the time and judged against a float64 reference.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from pgsd_nerfstudio.rendering.compilation import kernel, parallel_kernel
from pgsd_nerfstudio.rendering.rasterizer import TILE, RasterConfig

# Columns of a projected Gaussian ("splat"): 16 floats, one cache line.
X, Y = 0, 1  # centre, pixels
PRECISION, SHEAR, DROP = 2, 3, 4  # P, S, Q of the exponent
OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
DEPTH = 9  # along the camera's z axis, scene units
CUTOFF = 10  # largest sigma at which alpha reaches min_alpha
LEFT, RIGHT, TOP, BOTTOM = 11, 12, 13, 14  # pixels that may be touched, end exclusive; LEFT = RIGHT where none
COLUMNS = 16

# Columns of the gradient of a splat: as above up to DEPTH.
GRADIENT_COLUMNS = 10


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
    radius_sigmas: float
    min_alpha: float


def lens(K: np.ndarray, width: int, height: int, config: RasterConfig) -> Lens:
    """The lens of a camera with intrinsics `K` [3, 3]."""
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
        radius_sigmas=float(config.radius_sigmas),
        min_alpha=float(config.min_alpha),
    )


@kernel()
def _to_camera(viewmat, mean):
    """A point in camera axes."""
    x = viewmat[0, 0] * mean[0] + viewmat[0, 1] * mean[1] + viewmat[0, 2] * mean[2] + viewmat[0, 3]
    y = viewmat[1, 0] * mean[0] + viewmat[1, 1] * mean[1] + viewmat[1, 2] * mean[2] + viewmat[1, 3]
    z = viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3]
    return x, y, z


@kernel()
def _unit_quaternion(quat):
    """w, x, y, z of length one, and the factor that made it so."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    scale = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-24))
    return w * scale, x * scale, y * scale, z * scale, scale


@kernel()
def _principal_axes(viewmat, w, x, y, z):
    """The three axes of a Gaussian with this rotation, in camera axes: one triple each."""
    xx, yy, zz = x * x, y * y, z * z
    first = (1 - 2 * (yy + zz), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (xx + zz), 2 * (y * z + w * x))
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (xx + yy))
    return _turn(viewmat, first), _turn(viewmat, second), _turn(viewmat, third)


@kernel()
def _turn(viewmat, v):
    """A direction in camera axes."""
    return (
        viewmat[0, 0] * v[0] + viewmat[0, 1] * v[1] + viewmat[0, 2] * v[2],
        viewmat[1, 0] * v[0] + viewmat[1, 1] * v[1] + viewmat[1, 2] * v[2],
        viewmat[2, 0] * v[0] + viewmat[2, 1] * v[1] + viewmat[2, 2] * v[2],
    )


@kernel()
def _covariance(axes, scale, bend_x, bend_y, z, lens):
    """a, b, c of the footprint, blur included."""
    a, b, c = lens.blur, 0.0, lens.blur
    for k in range(3):
        u = lens.focal_x / z * (axes[k][0] - bend_x * axes[k][2]) * scale[k]
        v = lens.focal_y / z * (axes[k][1] - bend_y * axes[k][2]) * scale[k]
        a += u * u
        b += u * v
        c += v * v
    return a, b, c


@kernel()
def _pixels(low, high, extent):
    """Pixels whose centres lie in [low, high], clipped to the image: first and one past the last."""
    first = min(max(math.ceil(low - 0.5), 0.0), float(extent))
    last = min(max(math.floor(high - 0.5) + 1.0, 0.0), float(extent))
    return first, last


@kernel()
def _tiles(low, high, extent):
    """Pixels of the tiles that [low, high] touches, clipped to the image; none if it does not touch the image."""
    if high <= 0.0 or low >= extent:
        return 0.0, 0.0
    return max(math.floor(low / TILE) * TILE, 0.0), min(math.ceil(high / TILE) * TILE, float(extent))


@kernel()
def _project_one(mean, quat, scale, opacity, viewmat, lens, splat):
    """Geometry of one splat [16]."""
    splat[LEFT] = 0.0
    splat[RIGHT] = 0.0
    x, y, z = _to_camera(viewmat, mean)
    splat[DEPTH] = z
    if z < lens.near or z > lens.far or opacity < lens.min_alpha:
        return
    slope_x, slope_y = x / z, y / z
    bend_x, bend_y = min(lens.right, max(lens.left, slope_x)), min(lens.bottom, max(lens.top, slope_y))
    qw, qx, qy, qz, _ = _unit_quaternion(quat)
    a, b, c = _covariance(_principal_axes(viewmat, qw, qx, qy, qz), scale, bend_x, bend_y, z, lens)
    spread = a - b * b / c
    if not spread > 0.0:
        return
    px, py = lens.focal_x * slope_x + lens.center_x, lens.focal_y * slope_y + lens.center_y
    middle = 0.5 * (a + c)
    radius = math.ceil(lens.radius_sigmas * math.sqrt(middle + math.sqrt(max(0.01, middle * middle - spread * c))))
    cutoff = math.log(opacity / lens.min_alpha)
    reach_x, reach_y = math.sqrt(2.0 * cutoff * a) + 1e-3, math.sqrt(2.0 * cutoff * c) + 1e-3
    tile_left, tile_right = _tiles(px - radius, px + radius, lens.width)
    tile_top, tile_bottom = _tiles(py - radius, py + radius, lens.height)
    left, right = _pixels(px - reach_x, px + reach_x, lens.width)
    top, bottom = _pixels(py - reach_y, py + reach_y, lens.height)
    left, right = max(left, tile_left), min(right, tile_right)
    top, bottom = max(top, tile_top), min(bottom, tile_bottom)
    if left < right and top < bottom:
        splat[X], splat[Y] = px, py
        splat[PRECISION], splat[SHEAR], splat[DROP] = 1.0 / spread, -b / c, 1.0 / c
        splat[OPACITY], splat[CUTOFF] = opacity, cutoff
        splat[LEFT], splat[RIGHT], splat[TOP], splat[BOTTOM] = left, right, top, bottom


@parallel_kernel()
def project(means, quats, scales, opacities, viewmat, lens, splats):
    """Fill the geometry of `splats` [n, 16]; colours are left alone.

    means [n, 3], quats [n, 4], scales [n, 3], opacities [n] float32; viewmat [4, 4] float64.
    """
    for i in prange(means.shape[0]):
        _project_one(means[i], quats[i], scales[i], np.float64(opacities[i]), viewmat, lens, splats[i])


@kernel()
def _project_one_backward(mean, quat, scale, viewmat, lens, gradient, to_mean, to_quat, to_scale):
    """Gradients of one Gaussian from that of its splat [10]."""
    x, y, z = _to_camera(viewmat, mean)
    slope_x, slope_y = x / z, y / z
    bend_x, bend_y = min(lens.right, max(lens.left, slope_x)), min(lens.bottom, max(lens.top, slope_y))
    qw, qx, qy, qz, quat_scale = _unit_quaternion(quat)
    axes = _principal_axes(viewmat, qw, qx, qy, qz)
    a, b, c = _covariance(axes, scale, bend_x, bend_y, z, lens)

    # P, S, Q -> covariance.
    precision = 1.0 / (a - b * b / c)
    g_a = -precision * precision * gradient[PRECISION]
    g_b = -2.0 * b / c * g_a - gradient[SHEAR] / c
    g_c = (b * b * g_a + b * gradient[SHEAR] - gradient[DROP]) / (c * c)

    # Covariance -> the projected axes u, v -> scales, the axes in the world, and the linearisation.
    stretch_x, stretch_y = lens.focal_x / z, lens.focal_y / z
    g_bend_x, g_bend_y, g_z = 0.0, 0.0, np.float64(gradient[DEPTH])
    g = np.empty((3, 3))  # of the rotation matrix: [world axis, principal axis]
    for k in range(3):
        wx, wy, wz = axes[k]
        u = stretch_x * (wx - bend_x * wz)
        v = stretch_y * (wy - bend_y * wz)
        g_u = (2.0 * g_a * u + g_b * v) * scale[k]
        g_v = (2.0 * g_c * v + g_b * u) * scale[k]
        to_scale[k] = g_u * u + g_v * v
        g_u, g_v = g_u * scale[k], g_v * scale[k]
        g_z -= (g_u * u + g_v * v) / z
        g_bend_x -= g_u * stretch_x * wz
        g_bend_y -= g_v * stretch_y * wz
        g_wx, g_wy = g_u * stretch_x, g_v * stretch_y
        g_wz = -g_wx * bend_x - g_wy * bend_y
        for n in range(3):
            g[n, k] = viewmat[0, n] * g_wx + viewmat[1, n] * g_wy + viewmat[2, n] * g_wz

    # Rotation -> quaternion, without the part along it: only the direction of a quaternion counts.
    g_w = 2.0 * (qx * (g[2, 1] - g[1, 2]) + qy * (g[0, 2] - g[2, 0]) + qz * (g[1, 0] - g[0, 1]))
    g_i = 2.0 * (
        -2.0 * qx * (g[1, 1] + g[2, 2]) + qy * (g[1, 0] + g[0, 1]) + qz * (g[2, 0] + g[0, 2]) + qw * (g[2, 1] - g[1, 2])
    )
    g_j = 2.0 * (
        qx * (g[1, 0] + g[0, 1]) - 2.0 * qy * (g[0, 0] + g[2, 2]) + qz * (g[2, 1] + g[1, 2]) + qw * (g[0, 2] - g[2, 0])
    )
    g_k = 2.0 * (
        qx * (g[2, 0] + g[0, 2]) + qy * (g[2, 1] + g[1, 2]) - 2.0 * qz * (g[0, 0] + g[1, 1]) + qw * (g[1, 0] - g[0, 1])
    )
    along = g_w * qw + g_i * qx + g_j * qy + g_k * qz
    to_quat[0] = (g_w - along * qw) * quat_scale
    to_quat[1] = (g_i - along * qx) * quat_scale
    to_quat[2] = (g_j - along * qy) * quat_scale
    to_quat[3] = (g_k - along * qz) * quat_scale

    # Centre on the screen -> slopes -> camera space -> world. A slope at its limit takes nothing from the linearisation.
    g_slope_x, g_slope_y = lens.focal_x * gradient[X], lens.focal_y * gradient[Y]
    if bend_x == slope_x:
        g_slope_x += g_bend_x
    if bend_y == slope_y:
        g_slope_y += g_bend_y
    g_x, g_y = g_slope_x / z, g_slope_y / z
    g_z -= g_x * slope_x + g_y * slope_y
    for n in range(3):
        to_mean[n] = viewmat[0, n] * g_x + viewmat[1, n] * g_y + viewmat[2, n] * g_z


@parallel_kernel()
def project_backward(
    means, quats, scales, viewmat, lens, ids, gradients, to_means, to_quats, to_scales, to_opacities, to_colors
):
    """Gradients of the Gaussians from those of their splats.

    `gradients` [m, 10] float32 belongs to the Gaussians `ids` [m]; other rows of the last five arrays stay as they are.
    """
    for m in prange(ids.shape[0]):
        i = ids[m]
        gradient = gradients[m]
        to_opacities[i] = gradient[OPACITY]
        to_colors[i, 0], to_colors[i, 1], to_colors[i, 2] = gradient[RED], gradient[GREEN], gradient[BLUE]
        _project_one_backward(means[i], quats[i], scales[i], viewmat, lens, gradient, to_means[i], to_quats[i], to_scales[i])
