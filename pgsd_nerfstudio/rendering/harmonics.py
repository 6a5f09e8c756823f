"""Colours of projected Gaussians on the CPU: `scene.spherical_harmonics.view_colors` as one kernel.

The coefficients are read once and in their order, before splats are sorted by depth: memory is what they cost.
"""

from __future__ import annotations

import math

import numpy as np

from pgsd_nerfstudio.rendering.compilation import inlined, kernel, share_out, workers
from pgsd_nerfstudio.rendering.projection import BLUE, LEFT, RED, RIGHT
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0

MOST = 25  # basis functions of degree 4


@inlined()
def _basis(x, y, z, count, basis):
    """The first `count` basis functions at a unit direction, as `scene.spherical_harmonics.sh_basis`."""
    basis[0] = SH_C0
    if count > 1:
        first = 0.48860251190292
        basis[1], basis[2], basis[3] = -first * y, first * z, -first * x
    if count > 4:
        z2, cos2, sin2 = z * z, x * x - y * y, 2.0 * x * y
        tilt, zonal2 = -1.092548430592079 * z, 0.9461746957575601 * z2 - 0.3153915652525201
        basis[4], basis[5], basis[6] = 0.5462742152960395 * sin2, tilt * y, zonal2
        basis[7], basis[8] = tilt * x, 0.5462742152960395 * cos2
    if count > 9:
        cos3, sin3 = x * cos2 - y * sin2, x * sin2 + y * cos2
        ring, slant = -2.285228997322329 * z2 + 0.4570457994644658, 1.445305721320277 * z
        zonal3, sector = z * (1.865881662950577 * z2 - 1.119528997770346), -0.5900435899266435
        basis[9], basis[10], basis[11], basis[12] = sector * sin3, slant * sin2, ring * y, zonal3
        basis[13], basis[14], basis[15] = ring * x, slant * cos2, sector * cos3
    if count > 16:
        cos4, sin4 = x * cos3 - y * sin3, x * sin3 + y * cos3
        ring4, slant4 = z * (-4.683325804901025 * z2 + 2.007139630671868), 3.31161143515146 * z2 - 0.47308734787878
        zonal4 = 1.984313483298443 * z * zonal3 - 1.006230589874905 * zonal2
        steep, sector4 = -1.770130769779931 * z, 0.6258357354491763
        basis[16], basis[17], basis[18], basis[19] = sector4 * sin4, steep * sin3, slant4 * sin2, ring4 * y
        basis[20], basis[21], basis[22] = zonal4, ring4 * x, slant4 * cos2
        basis[23], basis[24] = steep * cos3, sector4 * cos4


@kernel()
def _color(worker, workers, colors, means, center, splats):
    n, count = splats.shape[0], colors.shape[1]
    basis = np.zeros(MOST)
    for i in range(n * worker // workers, n * (worker + 1) // workers):
        if splats[i, LEFT] >= splats[i, RIGHT]:
            continue
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        _basis(x / length, y / length, z / length, count, basis)
        for c in range(3):
            total = 0.5
            for b in range(count):
                total += basis[b] * colors[i, b, c]
            splats[i, RED + c] = max(total, 0.0)


def color(
    colors: np.ndarray,  # [n, 3] float32 plain RGB or [n, k, 3] spherical harmonics
    means: np.ndarray,  # [n, 3] float32
    viewmat: np.ndarray,  # [4, 4] float64, world to camera
    splats: np.ndarray,  # [n, 16] float32, columns as in projection.py; written where a splat touches the image
) -> None:
    """Write the colours of projected Gaussians: plain colours unchanged, harmonics as max(sum + 0.5, 0).

    Raises:
        ValueError: the number of coefficients is not that of a degree of 0 to 4.
    """
    if colors.ndim == 2:
        splats[:, RED : BLUE + 1] = colors
        return
    if colors.shape[1] not in (1, 4, 9, 16, 25):
        raise ValueError(f"spherical harmonics have 1, 4, 9, 16 or 25 coefficients, found {colors.shape[1]}")
    center = -(viewmat[:3, :3] * viewmat[:3, 3:]).sum(0)  # a rotation's inverse, without the threads of a linear algebra
    share_out(_color, workers(), colors, means, center, splats)
