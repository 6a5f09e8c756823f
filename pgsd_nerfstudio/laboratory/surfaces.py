"""Meshes on which figures of physics are measured."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.surface.mesh import SurfaceMesh

FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
"""Triangles of a square with four corners in order."""


def floor_and_table() -> SurfaceMesh:
    """A floor of 8 m and a table of 1.6 m at 0.75 m."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([4 * corners, 0.8 * corners + torch.tensor([0, 0, 0.75])])
    return SurfaceMesh(vertices, torch.cat([FACES, FACES + 4]))


def damaged_ball(center: Float[ndarray, "3"], radius: float) -> SurfaceMesh:
    """A ball with 5 % of its triangles missing and 30 % flipped.

    Args:
        center: m.
        radius: m.
    """
    rings, sides = 64, 128
    polar, turn = np.meshgrid(np.pi * np.arange(rings + 1) / rings, 2 * np.pi * np.arange(sides) / sides, indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    ring, side = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = (ring * sides + side).ravel(), (ring * sides + (side + 1) % sides).ravel()
    triangles = np.concatenate([np.stack([a, a + sides, b + sides], 1), np.stack([a, b + sides, b], 1)])
    rng = np.random.default_rng(0)
    triangles = np.where(rng.uniform(size=len(triangles))[:, None] < 0.3, triangles[:, ::-1], triangles)
    kept = triangles[rng.uniform(size=len(triangles)) >= 0.05]
    return SurfaceMesh(torch.from_numpy(center + radius * unit).float(), torch.from_numpy(kept.copy()).int())
