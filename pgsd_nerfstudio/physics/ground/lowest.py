"""How far down the simulated air must reach, so that particles also land on ground below the level of the cameras' feet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

RAYS = 128  # along each side of the plan
STRAY = 0.005  # share of the plan whose surface may be lower: holes and strays of a scan, where light leaks through the ground
ROOM = 0.2  # m of air below the lowest ground
DEEPEST = 20.0  # m below the bottom of the domain; ground farther down is too far away for particles to be seen on it


def down_to_ground(domain: Domain, surface: SurfaceMesh) -> Domain:
    """The domain, deepened where more than a two-hundredth of its plan has ground below its bottom or less than 20 cm above it.

    A domain whose bottom is above the ground at z = 0 stays as it is.

    Args:
        domain: the air around the cameras, in metres.
        surface: the mesh that particles land on, in metres.
    """
    if len(surface.triangles) == 0 or domain.lower[2] > 0:
        return domain
    lower, size, bottom = np.array(domain.lower[:2]), np.array(domain.size[:2]), domain.lower[2]
    at = lower + size * (np.stack(np.meshgrid(*[np.arange(RAYS)] * 2, indexing="ij"), -1).reshape(-1, 2) + 0.5) / RAYS
    from_below = np.column_stack([at, np.full(len(at), bottom - DEEPEST)])
    hits = surface.cast(from_below, torch.tensor([0.0, 0.0, 1.0]).expand(len(at), 3))
    ground = torch.isfinite(hits.distance) & (hits.normal[:, 2] > 0)
    if not ground.any():
        return domain
    lowest = bottom - DEEPEST + float(np.quantile(hits.distance[ground].numpy(), STRAY))
    return replace(domain, lower=(*domain.lower[:2], min(bottom, lowest - ROOM)))
