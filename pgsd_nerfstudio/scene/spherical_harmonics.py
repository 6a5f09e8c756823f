"""View-dependent colours: real spherical harmonics in the basis and sign convention of 3D Gaussian splatting.

The evaluation follows Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2(2), 2013; degrees are 0 to 4 as in gsplat 1.4.0.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.2820947917738781
"""The constant basis function, 1 / sqrt(4 pi)."""


def sh_basis(degree: int, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """The (degree + 1)^2 basis functions at unit directions.

    Raises:
        ValueError: the degree is not 0..4.
    """
    if not 0 <= degree <= 4:
        raise ValueError(f"spherical harmonics of degree 0 to 4 are supported, found {degree}")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        first = 0.48860251190292
        basis += [-first * y, first * z, -first * x]
    if degree >= 2:
        z2 = z * z
        cos2, sin2 = x * x - y * y, 2.0 * x * y
        tilt = -1.092548430592079 * z
        zonal2 = 0.9461746957575601 * z2 - 0.3153915652525201
        basis += [0.5462742152960395 * sin2, tilt * y, zonal2, tilt * x, 0.5462742152960395 * cos2]
    if degree >= 3:
        cos3, sin3 = x * cos2 - y * sin2, x * sin2 + y * cos2
        ring, tilt = -2.285228997322329 * z2 + 0.4570457994644658, 1.445305721320277 * z
        zonal3 = z * (1.865881662950577 * z2 - 1.119528997770346)
        sector = -0.5900435899266435
        basis += [sector * sin3, tilt * sin2, ring * y, zonal3, ring * x, tilt * cos2, sector * cos3]
    if degree >= 4:
        cos4, sin4 = x * cos3 - y * sin3, x * sin3 + y * cos3
        ring, tilt = z * (-4.683325804901025 * z2 + 2.007139630671868), 3.31161143515146 * z2 - 0.47308734787878
        zonal4 = 1.984313483298443 * z * zonal3 - 1.006230589874905 * zonal2
        steep, sector = -1.770130769779931 * z, 0.6258357354491763
        basis += [
            sector * sin4,
            steep * sin3,
            tilt * sin2,
            ring * y,
            zonal4,
            ring * x,
            tilt * cos2,
            steep * cos3,
            sector * cos4,
        ]
    return torch.stack(basis, dim=-1)


def view_colors(
    colors: Tensor,  # [n, 3] plain RGB or [n, k, 3] spherical harmonics
    means: Float[Tensor, "n 3"],
    viewmat: Float[Tensor, "4 4"],
) -> Float[Tensor, "n 3"]:
    """RGB of Gaussians as one camera sees them: plain colours unchanged, harmonics as max(sum + 0.5, 0)."""
    if colors.ndim == 2:
        return colors
    center = torch.linalg.inv(viewmat.double())[:3, 3].to(means)
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    basis = sh_basis(round(colors.shape[1] ** 0.5) - 1, directions)
    return (torch.einsum("nk,nkc->nc", basis, colors) + 0.5).clamp_min(0.0)
