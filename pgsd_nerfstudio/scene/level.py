"""Which way is up in a splat that came without cameras: the ground is its largest plane, with nearly everything on one side.

Trained Gaussians lie flat on surfaces, so that the shortest axis of each is a normal. Directions in which normals gather are
the candidates; for each, the level at which most of that area lies is its plane.
"""

from __future__ import annotations

import torch
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians

FLAT = 0.5  # a Gaussian has a normal if its shortest axis is at most so much of the next one
ALIGNED = 0.94  # cosine between a normal and the direction of its plane
LEVELS = 300  # bins over six radii of height
LEAST_SHARE = 0.03  # of the area that the largest plane must hold
CLEARLY = 3.0  # times as much area as the largest plane of any direction elsewhere
ONE_SIDED = 5.0  # times as many Gaussians above as below
APART = 0.9  # cosine below which two directions are different ones
SNAP = 0.9994  # cosine of 2 degrees: a direction this close to an axis is the axis
MOST_USED = 200_000  # Gaussians that are looked at


def middle_of(gaussians: Gaussians) -> tuple[Float64[Tensor, "3"], float]:
    """The middle of the opaque Gaussians and their median distance from it, in scene units.

    Args:
        gaussians: at least one, colours do not matter.
    """
    means, opaque = gaussians.means.double().cpu(), gaussians.opacities.cpu() > 0.5
    means = means[opaque] if opaque.any() else means
    middle = means.median(dim=0).values
    return middle, max(float((means - middle).norm(dim=1).median()), 1e-6)


def upright(gaussians: Gaussians) -> Float64[Tensor, "3"] | None:
    """The direction that is up, of length 1; None where no plane stands out as the ground.

    Args:
        gaussians: the frozen scene.
    """
    middle, radius = middle_of(gaussians)
    some = slice(None, None, max(1, len(gaussians) // MOST_USED))
    means, opacities = gaussians.means[some].double().cpu() - middle, gaussians.opacities[some].double().cpu()
    near = (opacities > 0.5) & (means.norm(dim=1) < 3 * radius)
    scales, order = gaussians.scales[some].double().cpu().sort(dim=1)
    flat = near & (scales[:, 0] <= FLAT * scales[:, 1])
    if int(flat.sum()) < 100:
        return None
    turned = rotations.unitquat_to_rotmat(
        rotations.quat_wxyz_to_xyzw(torch.nn.functional.normalize(gaussians.quats[some].double().cpu(), dim=1))
    )
    normals = turned.gather(2, order[:, :1, None].expand(-1, 3, 1)).squeeze(2)[flat]
    # One huge Gaussian must not be a plane by itself.
    areas = (scales[:, 1] * scales[:, 2]).clamp_max((0.03 * radius) ** 2)[flat] * opacities[flat]
    everything, on_planes = means[near], means[flat]
    axes = torch.eye(3, dtype=torch.float64)
    _, principal = torch.linalg.eigh((areas[:, None] * normals).T @ normals)
    found = [_plane(_gathered(normals, areas, start), normals, areas, on_planes, radius) for start in (*axes, *principal.T)]
    found.sort(key=lambda plane: -plane[1])
    up, share, level = found[0]
    others = [other for direction, other, _ in found if abs(float(direction @ up)) < APART]
    above, below = (float((side * (everything @ up - level) > 0.05 * radius).double().mean()) for side in (1, -1))
    if share < max(LEAST_SHARE, CLEARLY * max(others, default=0.0)) or max(above, below) < ONE_SIDED * min(above, below):
        return None
    up = up if above > below else -up
    return up.round() + 0.0 if float(up.abs().max()) > SNAP else up  # no -0, which would be told


def _gathered(
    normals: Float64[Tensor, "n 3"], areas: Float64[Tensor, " n"], start: Float64[Tensor, "3"]
) -> Float64[Tensor, "3"]:
    """The direction nearest to `start` in which normals gather: those far from it count less and less."""
    direction = start
    for _ in range(15):
        weight = areas * (normals @ direction).abs() ** 8
        direction = torch.linalg.eigh((weight[:, None] * normals).T @ normals)[1][:, 2]
    return direction


def _plane(
    direction: Float64[Tensor, "3"],
    normals: Float64[Tensor, "n 3"],
    areas: Float64[Tensor, " n"],
    means: Float64[Tensor, "n 3"],
    radius: float,
) -> tuple[Float64[Tensor, "3"], float, float]:
    """The largest plane across a direction: the direction, the plane's share of all area, and its height."""
    aligned = (normals @ direction).abs() > ALIGNED
    size = 6 * radius / LEVELS
    bins = ((means[aligned] @ direction + 3 * radius) / size).long().clamp(0, LEVELS - 1)
    held = torch.zeros(LEVELS, dtype=torch.float64).index_add(0, bins, areas[aligned])
    held = torch.nn.functional.avg_pool1d(held[None], 3, stride=1, padding=1)[0] * 3  # three neighbouring bins
    best = int(held.argmax())
    return direction, float(held[best] / areas.sum()), (best + 0.5) * size - 3 * radius
