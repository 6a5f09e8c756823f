"""Covariances of Gaussians in space and the linearised perspective that projects them to the image plane, in plain torch.

The formulas are those of Zwicker et al., "EWA Splatting" (2002). All functions are differentiable, for any dtype and device.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotations of wxyz quaternions of any length; the quaternion zero gives the identity, where roma gives zero matrices."""
    # The bound is on the square and not on the root, since the root has no gradient at zero.
    w, x, y, z = (quats / quats.square().sum(dim=-1, keepdim=True).clamp_min(1e-24).sqrt()).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """Covariances in space without motion, in scene units squared."""
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    return axes @ axes.mT


def perspective_jacobians(
    points: Float[Tensor, "n 3"],  # in camera axes, z > 0
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    frustum_margin: float,
) -> Float[Tensor, "n 2 3"]:
    """Derivatives of pixels by points in camera axes, taken no further outside the image than `RasterConfig.frustum_margin`."""
    x, y, z = points.unbind(-1)
    focal, center, extent = K.diagonal()[:2], K[:2, 2], torch.tensor([width, height]).to(K)
    slack = frustum_margin * 0.5 * extent / focal
    slopes = torch.stack([x / z, y / z], dim=-1)
    slopes = torch.maximum(torch.minimum(slopes, (extent - center) / focal + slack), -center / focal - slack)
    zero = torch.zeros_like(z)
    across = torch.stack([focal[0] / z, zero, -focal[0] * slopes[:, 0] / z], dim=-1)
    down = torch.stack([zero, focal[1] / z, -focal[1] * slopes[:, 1] / z], dim=-1)
    return torch.stack([across, down], dim=-2)
