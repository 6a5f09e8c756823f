"""Rotations as unit quaternions, matrices and rotation vectors, in plain torch, differentiable, over any leading axes.

Names and conventions are those of RoMa (Brégier, "Deep Regression on Manifolds: A 3D Rotation Case Study", 3DV 2021), by which
the tests judge them: quaternions are xyzw where nothing else is said. RoMa itself imports torch's compiler, which takes seconds
at the start of every command.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

Quats = Float[Tensor, "*n 4"]
Matrices = Float[Tensor, "*n 3 3"]
Vectors = Float[Tensor, "*n 3"]


def quat_wxyz_to_xyzw(wxyz: Quats) -> Quats:
    """The same quaternions with the real part last."""
    return torch.cat([wxyz[..., 1:], wxyz[..., :1]], dim=-1)


def quat_xyzw_to_wxyz(xyzw: Quats) -> Quats:
    """The same quaternions with the real part first."""
    return torch.cat([xyzw[..., 3:], xyzw[..., :3]], dim=-1)


def quat_product(p: Float[Tensor, "*#n 4"], q: Float[Tensor, "*#n 4"]) -> Tensor:
    """Hamilton's product [*n, 4]: the rotation q, then p."""
    p, q = torch.broadcast_tensors(p, q)
    vector = p[..., 3:] * q[..., :3] + q[..., 3:] * p[..., :3] + torch.linalg.cross(p[..., :3], q[..., :3])
    last = p[..., 3] * q[..., 3] - (p[..., :3] * q[..., :3]).sum(dim=-1)
    return torch.cat([vector, last[..., None]], dim=-1)


def quat_conjugation(quats: Quats) -> Quats:
    """The inverse rotations of unit quaternions."""
    return torch.cat([-quats[..., :3], quats[..., 3:]], dim=-1)


def quat_normalize(quats: Quats) -> Quats:
    """Quaternions of length one; one of length zero gives NaN."""
    return quats / torch.linalg.norm(quats, dim=-1, keepdim=True)


def unitquat_to_rotmat(quats: Quats) -> Matrices:
    """Rotation matrices of unit quaternions."""
    x, y, z, w = quats.unbind(-1)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, zw, xz, yw, yz, xw = x * y, z * w, x * z, y * w, y * z, x * w
    rows = [
        torch.stack([xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw)], dim=-1),
        torch.stack([2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw)], dim=-1),
        torch.stack([2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def rotmat_to_unitquat(matrices: Matrices) -> Quats:
    """Unit quaternions of rotation matrices; of q and -q, the one whose largest part is positive.

    The rows of 4 q q^T are linear in the matrix; the one with the largest diagonal entry is normalised, so a matrix that is not
    quite orthonormal will do (Markley, "Unit quaternion from rotation matrix", J. Guidance, Control, and Dynamics 31(2), 2008).
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.unbind(-2))
    rows = [
        torch.stack([1 + a - e - i, b + d, c + g, h - f], dim=-1),
        torch.stack([b + d, 1 + e - i - a, f + h, c - g], dim=-1),
        torch.stack([c + g, f + h, 1 + i - a - e, d - b], dim=-1),
        torch.stack([h - f, c - g, d - b, 1 + a + e + i], dim=-1),
    ]
    squares = torch.stack(rows, dim=-2)
    best = squares.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    return quat_normalize(squares.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :])


def rotvec_to_unitquat(vectors: Vectors) -> Quats:
    """Unit quaternions of rotation vectors (axis times angle in radians); zero gives exactly (0, 0, 0, 1)."""
    half = 0.5 * torch.linalg.norm(vectors, dim=-1, keepdim=True)
    return torch.cat([0.5 * torch.sinc(half / math.pi) * vectors, torch.cos(half)], dim=-1)


def unitquat_to_rotvec(quats: Quats) -> Vectors:
    """Rotation vectors, of angles up to pi, of unit quaternions."""
    quats = torch.where(quats[..., 3:] > 0, quats, -quats)
    sine, cosine = torch.linalg.norm(quats[..., :3], dim=-1, keepdim=True), quats[..., 3:]
    # Near zero the angle over its sine is 1; the other branch must not divide by zero there, nor in the gradient.
    small = sine < 1e-6
    safe = torch.where(small, 1.0, sine)
    return torch.where(small, 2.0, 2.0 * torch.atan2(safe, cosine) / safe) * quats[..., :3]


def rotvec_to_rotmat(vectors: Vectors) -> Matrices:
    """Rotation matrices of rotation vectors."""
    return unitquat_to_rotmat(rotvec_to_unitquat(vectors))


def rotmat_geodesic_distance(first: Float[Tensor, "*#n 3 3"], second: Float[Tensor, "*#n 3 3"]) -> Tensor:
    """Angles [*n] in radians between rotations: twice the arc sine of the matrices' distance over 2 sqrt 2."""
    return 2.0 * torch.asin((torch.linalg.matrix_norm(second - first) / math.sqrt(8.0)).clamp_max(1.0))


def unitquat_slerp(first: Float[Tensor, "4"], second: Float[Tensor, "4"], steps: Float[Tensor, " t"]) -> Float[Tensor, "t 4"]:
    """Unit quaternions on the shorter arc from one to another.

    Args:
        first: where step 0 is.
        second: where step 1 is.
        steps: shares of the way, 0..1.
    """
    cosine = (first * second).sum()
    second, cosine = torch.where(cosine < 0, -second, second), cosine.abs()
    sine = torch.linalg.norm(second - cosine * first)
    angle, at = torch.atan2(sine, cosine), steps[:, None]
    if float(sine) ** 2 < torch.finfo(first.dtype).eps:  # so near to each other that the arc is straight
        return quat_normalize((1 - at) * first + at * second)
    return quat_normalize(torch.sin((1 - at) * angle) / sine * first + torch.sin(at * angle) / sine * second)
