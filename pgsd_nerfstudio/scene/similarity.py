"""Gaussians moved as a whole: turned, mirrored, scaled and shifted, their harmonics with them."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import sh_basis

TOLERANCE = 1e-4  # how far from equal the scales of the axes may be, and their products from zero


def moved(gaussians: Gaussians, transform: Float64[Tensor, "4 4"]) -> Gaussians:
    """Gaussians where x is at A x + b, A of `transform` being a rotation or a mirroring times a scale.

    Args:
        gaussians: with any colours; displacements move along.
        transform: homogeneous, acting on columns.

    Raises:
        ValueError: it stretches one direction more than another, or its last row is not 0 0 0 1.
    """
    linear, shift = transform[:3, :3], transform[:3, 3]
    scale = float(linear.norm()) / 3**0.5
    if not (0 < scale < torch.inf) or not torch.isfinite(shift).all() or transform[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError("a transform must be of finite numbers, with the last row 0 0 0 1, and shrink nothing to a point")
    turn = linear / scale
    if (turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max() > TOLERANCE:
        raise ValueError("a transform must scale all directions alike; this one stretches or shears")
    # An ellipsoid is its own mirror image through its centre, so that a mirroring may be replaced by minus itself.
    rotation = turn if torch.linalg.det(turn) > 0 else -turn
    x, y, z, w = rotations.rotmat_to_unitquat(rotation).tolist()
    by = gaussians.quats.new_tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    exact = gaussians.means.double() @ linear.T + shift
    movement = gaussians.displacements
    return replace(
        gaussians,
        means=exact.to(gaussians.means.dtype),
        quats=gaussians.quats @ by.T,
        scales=gaussians.scales * scale,
        colors=gaussians.colors if gaussians.colors.ndim == 2 else turned_harmonics(gaussians.colors, turn),
        displacements=None if movement is None else (movement.double() @ linear.T).to(movement.dtype),
    )


def turned_harmonics(coefficients: Float[Tensor, "n k 3"], turn: Float64[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients c' with which direction `turn` d shows what direction d showed with c.

    The basis functions of a degree at turned directions are combinations of those of the same degree at the directions
    themselves, whichever signs and order the basis has; they are found by solving for them at a few directions.

    Args:
        coefficients: of degree 0 to 4.
        turn: a rotation or a mirroring.
    """
    degree = round(coefficients.shape[1] ** 0.5) - 1
    golden = torch.arange(64, dtype=torch.float64) + 0.5
    height, angle = 1 - golden / 32, golden * torch.pi * (1 + 5**0.5)
    across = (1 - height**2).sqrt()
    directions = torch.stack([across * angle.cos(), across * angle.sin(), height], dim=1)
    before, after = sh_basis(degree, directions), sh_basis(degree, directions @ turn.T)
    parts = [coefficients[:, :1]]
    for level in range(1, degree + 1):
        band = slice(level**2, (level + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, band], before[:, band]).solution.to(coefficients)
        parts.append(torch.einsum("jk,nkc->njc", matrix, coefficients[:, band]))
    return torch.cat(parts, dim=1)
