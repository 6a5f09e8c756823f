"""The backward pass of the projection: gradients of Gaussians from those of their footprints, in double precision."""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.rendering.compilation import kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import (
    DEPTH,
    DIMMING,
    DROP,
    OPACITY,
    PRECISION,
    RED,
    SHEAR,
    SMEAR,
    Lens,
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
"""Columns of the gradient of a splat: those of a splat up to DEPTH."""


@kernel(forceinline=True)
def _axis_backward(i, k, axis, scales, g_a, g_b, g_c, bend_x, bend_y, z, viewmat, lens, to_scales, g_z, g_bend_x, g_bend_y):
    """Gradient of principal axis k in the world; also writes that of its scale and adds to those of depth and linearisation."""
    u, v = on_screen(axis, bend_x, bend_y, z, lens)
    size = np.float64(scales[i, k])
    g_u = (2.0 * g_a * u + g_b * v) * size
    g_v = (2.0 * g_c * v + g_b * u) * size
    to_scales[i, k] = g_u * u + g_v * v
    g_u, g_v = g_u * size, g_v * size
    g_z -= (g_u * u + g_v * v) / z
    g_x, g_y = g_u * lens.focal_x / z, g_v * lens.focal_y / z
    g_bend_x -= g_x * axis[2]
    g_bend_y -= g_y * axis[2]
    g_w = -g_x * bend_x - g_y * bend_y
    world = (
        viewmat[0, 0] * g_x + viewmat[1, 0] * g_y + viewmat[2, 0] * g_w,
        viewmat[0, 1] * g_x + viewmat[1, 1] * g_y + viewmat[2, 1] * g_w,
        viewmat[0, 2] * g_x + viewmat[1, 2] * g_y + viewmat[2, 2] * g_w,
    )
    return world, g_z, g_bend_x, g_bend_y


@kernel(forceinline=True)
def _to_quaternion(i, p, q, r, qw, qx, qy, qz, quat_scale, to_quats):
    """Write the gradient of a quaternion from that of its rotation matrix, whose columns are p, q, r.

    Only the direction of a quaternion counts, so its gradient has no part along the quaternion.
    """
    g_w = 2.0 * (qx * (q[2] - r[1]) + qy * (r[0] - p[2]) + qz * (p[1] - q[0]))
    g_i = 2.0 * (-2.0 * qx * (q[1] + r[2]) + qy * (p[1] + q[0]) + qz * (p[2] + r[0]) + qw * (q[2] - r[1]))
    g_j = 2.0 * (qx * (p[1] + q[0]) - 2.0 * qy * (p[0] + r[2]) + qz * (q[2] + r[1]) + qw * (r[0] - p[2]))
    g_k = 2.0 * (qx * (p[2] + r[0]) + qy * (q[2] + r[1]) - 2.0 * qz * (p[0] + q[1]) + qw * (p[1] - q[0]))
    along = g_w * qw + g_i * qx + g_j * qy + g_k * qz
    to_quats[i, 0] = (g_w - along * qw) * quat_scale
    to_quats[i, 1] = (g_i - along * qx) * quat_scale
    to_quats[i, 2] = (g_j - along * qy) * quat_scale
    to_quats[i, 3] = (g_k - along * qz) * quat_scale


@kernel(forceinline=True)
def _project_one_backward(
    i,
    means,
    quats,
    scales,
    motions,
    moves,
    antialiased,
    missed,
    viewmat,
    lens,
    m,
    splats,
    gradients,
    to_means,
    to_quats,
    to_scales,
    to_motions,
):
    """Write the gradients of Gaussian i, which is splat m."""
    x, y, z = to_camera(viewmat, means, i)
    slope_x, slope_y = x / z, y / z
    bend_x, bend_y = min(lens.right, max(lens.left, slope_x)), min(lens.bottom, max(lens.top, slope_y))
    qw, qx, qy, qz, quat_scale = unit_quaternion(quats, i)
    axes = principal_axes(viewmat, qw, qx, qy, qz)
    a, b, c = covariance(axes, scales, i, bend_x, bend_y, z, lens)

    # With motion, the covariance is a0 + u^2, b0 + u v, c0 + v^2: the still one and the motion's standard deviation u, v.
    a0, b0, c0, u, v = a, b, c, 0.0, 0.0
    if moves:
        way = turn(viewmat, (motions[i, 0], motions[i, 1], motions[i, 2]))
        u, v = on_screen(way, bend_x, bend_y, z, lens)
        u, v = SMEAR * u, SMEAR * v
        a, b, c = a + u * u, b + u * v, c + v * v

    # From P, S, Q to the covariance.
    precision = 1.0 / (a - b * b / c)
    g_a = -precision * precision * gradients[m, PRECISION]
    g_b = -2.0 * b / c * g_a - gradients[m, SHEAR] / c
    g_c = (b * b * g_a + b * gradients[m, SHEAR] - gradients[m, DROP]) / (c * c)

    g_bend_x, g_bend_y, g_z = 0.0, 0.0, np.float64(gradients[m, DEPTH])
    stretch_x, stretch_y = lens.focal_x / z, lens.focal_y / z
    if moves or antialiased:
        # The opacity was multiplied by sqrt(still / smeared); these are log-derivatives of the two determinants.
        half = 0.5 * gradients[m, OPACITY] * (splats[m, OPACITY] - missed)
        if antialiased:
            a0, c0 = a0 - lens.blur, c0 - lens.blur
        still, smeared = half / (a0 * c0 - b0 * b0), half / (a * c - b * b)
        g_a, g_b, g_c = g_a - smeared * c, g_b + 2.0 * smeared * b, g_c - smeared * a
    if moves:
        g_u, g_v = SMEAR * (2.0 * g_a * u + g_b * v), SMEAR * (2.0 * g_c * v + g_b * u)
        g_z -= (g_u * u + g_v * v) / (SMEAR * z)
        g_bend_x -= g_u * stretch_x * way[2]
        g_bend_y -= g_v * stretch_y * way[2]
        g_x, g_y = g_u * stretch_x, g_v * stretch_y
        g_w = -g_x * bend_x - g_y * bend_y
        for n in range(3):
            to_motions[i, n] = viewmat[0, n] * g_x + viewmat[1, n] * g_y + viewmat[2, n] * g_w
    if moves or antialiased:
        g_a, g_b, g_c = g_a + still * c0, g_b - 2.0 * still * b0, g_c + still * a0

    # From the covariance to the projected axes, then to scales, linearisation and the axes in the world.
    first, g_z, g_bend_x, g_bend_y = _axis_backward(
        i, 0, axes[0], scales, g_a, g_b, g_c, bend_x, bend_y, z, viewmat, lens, to_scales, g_z, g_bend_x, g_bend_y
    )
    second, g_z, g_bend_x, g_bend_y = _axis_backward(
        i, 1, axes[1], scales, g_a, g_b, g_c, bend_x, bend_y, z, viewmat, lens, to_scales, g_z, g_bend_x, g_bend_y
    )
    third, g_z, g_bend_x, g_bend_y = _axis_backward(
        i, 2, axes[2], scales, g_a, g_b, g_c, bend_x, bend_y, z, viewmat, lens, to_scales, g_z, g_bend_x, g_bend_y
    )
    _to_quaternion(i, first, second, third, qw, qx, qy, qz, quat_scale, to_quats)

    # From the centre on the screen to slopes, camera axes and the world. A slope at its limit gets no gradient from the
    # linearisation.
    g_slope_x, g_slope_y = lens.focal_x * gradients[m, X], lens.focal_y * gradients[m, Y]
    if bend_x == slope_x:
        g_slope_x += g_bend_x
    if bend_y == slope_y:
        g_slope_y += g_bend_y
    g_x, g_y = g_slope_x / z, g_slope_y / z
    g_z -= g_x * slope_x + g_y * slope_y
    for n in range(3):
        to_means[i, n] = viewmat[0, n] * g_x + viewmat[1, n] * g_y + viewmat[2, n] * g_z


def project_backward(
    means: np.ndarray,  # [n, 3] float32
    quats: np.ndarray,  # [n, 4] float32
    scales: np.ndarray,  # [n, 3] float32
    motions: np.ndarray,  # [n, 3] or [0, 3] float32
    antialiased: bool,
    whole: bool,
    viewmat: np.ndarray,  # [4, 4] float64
    lens: Lens,
    ids: np.ndarray,  # [m] int32: the Gaussian of each splat
    splats: np.ndarray,  # [m, 16] float32
    gradients: np.ndarray,  # [m, 10] float32: of the splats
    *found: np.ndarray,  # float32, of means, quats, scales, opacities, colours, motions; rows not in `ids` stay as they are
) -> None:
    """Write the gradients of the Gaussians from those of their splats."""
    missed = lens.faint_alpha if whole else 0.0
    scene = means, quats, scales, motions, antialiased, missed, viewmat, lens
    share_out(_project_backward, workers(), *scene, ids, splats, gradients, *found)


@kernel()
def _project_backward(
    worker,
    workers,
    means,
    quats,
    scales,
    motions,
    antialiased,
    missed,
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
    n, moves = ids.shape[0], motions.shape[0] > 0
    for m in range(n * worker // workers, n * (worker + 1) // workers):
        i = ids[m]
        to_opacities[i] = gradients[m, OPACITY] * splats[m, DIMMING]
        for channel in range(3):
            to_colors[i, channel] = gradients[m, RED + channel]
        _project_one_backward(
            i,
            means,
            quats,
            scales,
            motions,
            moves,
            antialiased,
            missed,
            viewmat,
            lens,
            m,
            splats,
            gradients,
            to_means,
            to_quats,
            to_scales,
            to_motions,
        )
