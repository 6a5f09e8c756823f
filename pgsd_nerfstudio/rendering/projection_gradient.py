"""The way back through the projection: gradients of Gaussians from those of their footprints, in double precision."""

from __future__ import annotations

import numpy as np
from numba import prange

from pgsd_nerfstudio.rendering.compilation import kernel, parallel_kernel
from pgsd_nerfstudio.rendering.projection import (
    BLUE,
    DEPTH,
    DIMMING,
    DROP,
    GREEN,
    OPACITY,
    PRECISION,
    RED,
    SHEAR,
    SMEAR,
    X,
    Y,
    covariance,
    on_screen,
    principal_axes,
    to_camera,
    turn,
    unit_quaternion,
)

GRADIENT_COLUMNS = 10
"""Columns of the gradient of a splat: those of the splat up to DEPTH."""


@kernel()
def _project_one_backward(
    mean, quat, scale, motion, moves, viewmat, lens, splat, gradient, to_mean, to_quat, to_scale, to_motion
):
    """Gradients of one Gaussian from its splat [16] and the gradient of that [10]."""
    x, y, z = to_camera(viewmat, mean)
    slope_x, slope_y = x / z, y / z
    bend_x, bend_y = min(lens.right, max(lens.left, slope_x)), min(lens.bottom, max(lens.top, slope_y))
    qw, qx, qy, qz, quat_scale = unit_quaternion(quat)
    axes = principal_axes(viewmat, qw, qx, qy, qz)
    a, b, c = covariance(axes, scale, bend_x, bend_y, z, lens)

    # With motion the splat's covariance is a0 + u^2, b0 + u v, c0 + v^2 of the still one and the motion's standard deviation.
    a0, b0, c0, u, v = a, b, c, 0.0, 0.0
    if moves:
        way = turn(viewmat, motion)
        u, v = on_screen(way, bend_x, bend_y, z, lens)
        u, v = SMEAR * u, SMEAR * v
        a, b, c = a + u * u, b + u * v, c + v * v

    # P, S, Q -> covariance.
    precision = 1.0 / (a - b * b / c)
    g_a = -precision * precision * gradient[PRECISION]
    g_b = -2.0 * b / c * g_a - gradient[SHEAR] / c
    g_c = (b * b * g_a + b * gradient[SHEAR] - gradient[DROP]) / (c * c)

    g_bend_x, g_bend_y, g_z = 0.0, 0.0, np.float64(gradient[DEPTH])
    stretch_x, stretch_y = lens.focal_x / z, lens.focal_y / z
    if moves:
        # The opacity was multiplied with sqrt(still / smeared): log-derivatives of the two determinants.
        half = 0.5 * gradient[OPACITY] * splat[OPACITY]
        still, smeared = half / (a0 * c0 - b0 * b0), half / (a * c - b * b)
        g_a, g_b, g_c = g_a - smeared * c, g_b + 2.0 * smeared * b, g_c - smeared * a
        g_u, g_v = SMEAR * (2.0 * g_a * u + g_b * v), SMEAR * (2.0 * g_c * v + g_b * u)
        g_z -= (g_u * u + g_v * v) / (SMEAR * z)
        g_bend_x -= g_u * stretch_x * way[2]
        g_bend_y -= g_v * stretch_y * way[2]
        g_x, g_y = g_u * stretch_x, g_v * stretch_y
        g_w = -g_x * bend_x - g_y * bend_y
        for n in range(3):
            to_motion[n] = viewmat[0, n] * g_x + viewmat[1, n] * g_y + viewmat[2, n] * g_w
        g_a, g_b, g_c = g_a + still * c0, g_b - 2.0 * still * b0, g_c + still * a0

    # Covariance -> the projected axes u, v -> scales, the axes in the world, and the linearisation.
    g = np.empty((3, 3))  # of the rotation matrix: [world axis, principal axis]
    for k in range(3):
        wz = axes[k][2]
        u, v = on_screen(axes[k], bend_x, bend_y, z, lens)
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
    means,
    quats,
    scales,
    motions,
    viewmat,
    lens,
    ids,
    splats,
    gradients,
    to_means,
    to_quats,
    to_scales,
    to_opacities,
    to_colors,
    to_motions,
):
    """Gradients of the Gaussians from those of their splats.

    `splats` [m, 16] and `gradients` [m, 10] float32 belong to the Gaussians `ids` [m]; other rows of the last six arrays stay
    as they are.
    """
    moves = motions.shape[0] > 0
    for m in prange(ids.shape[0]):
        i = ids[m]
        gradient = gradients[m]
        to_opacities[i] = gradient[OPACITY] * splats[m, DIMMING]
        to_colors[i, 0], to_colors[i, 1], to_colors[i, 2] = gradient[RED], gradient[GREEN], gradient[BLUE]
        motion, to_motion = (motions[i], to_motions[i]) if moves else (means[i], to_means[i])
        _project_one_backward(
            means[i],
            quats[i],
            scales[i],
            motion,
            moves,
            viewmat,
            lens,
            splats[m],
            gradient,
            to_means[i],
            to_quats[i],
            to_scales[i],
            to_motion,
        )
