"""Sliders: single particles that slide down a surface under gravity and Coulomb friction, at most at their terminal speed.

A slider follows the closest point of the surface, LIFT above it on its own side. It flies again where the surface falls away,
and it lands when it has become slow. `dense` moves crowded sliders together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from pgsd_nerfstudio.physics.bodies import GRAVITY, Bodies
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

PARTS = 2  # straight pieces of a centimetre or two in which a slider follows the surface within a frame
DETACH = 0.02  # m above the surface at which a slider flies
BEYOND = 0.005  # m beyond an edge, sideways from the nearest point, at which a slider flies
SLOW = 0.05  # m/s below which a slider lands
SHORT = 0.01  # share of a path by which it ends before a surface
LIFT = 0.002  # m above the surface at which sliders move, so that rays of the next frame start outside of it


class Slid(NamedTuple):
    """Sliders after a frame."""

    bodies: Bodies
    rests: Bool[ndarray, " n"]
    """Sliders that have become slow."""
    flies: Bool[ndarray, " n"]
    """Sliders that have lost the surface."""


def slide(bodies: Bodies, surface: SurfaceMesh, friction: float, step: float) -> Slid:
    """Advance sliders by one step.

    Args:
        bodies: the sliders.
        surface: the mesh they slide on, in metres.
        friction: coefficient of Coulomb friction.
        step: s.
    """
    x, v = bodies.positions.astype(np.float64), bodies.velocities.astype(np.float64)
    begin, flies = x.copy(), np.zeros(len(x), bool)
    dt = step / PARTS
    _, normal = _nearest(surface, x)
    for _ in range(PARTS):
        v = accelerated(v, normal, bodies.speeds, friction, dt)
        moved = _stopped(surface, x, x + v * dt)
        new_at, new_normal = _nearest(surface, moved)
        gap = moved - new_at
        distance, upright = np.linalg.norm(gap, axis=1), np.abs((gap * new_normal).sum(1))
        # The gap is along the normal within a sheet and along the sheet past its edge. Corners of a rough mesh are in between.
        flies |= (distance > DETACH) | ((distance > BEYOND) & (upright < 0.7 * distance))
        onto = _stopped(surface, moved, new_at + LIFT * _outward(new_normal, gap))
        x = np.where(flies[:, None], moved, onto)
        normal = new_normal
    slow = np.linalg.norm(x - begin, axis=1) < SLOW * step
    moved = replace(bodies, positions=x.astype(np.float32), velocities=v.astype(np.float32))
    return Slid(moved, slow & ~flies, flies)


def _stopped(surface: SurfaceMesh, x: Float[ndarray, "n 3"], moved: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Ends of the paths from `x` to `moved`: each stops before the first surface, so that no slider crosses one in a corner."""
    path = moved - x
    if len(path) == 0 or len(surface.triangles) == 0:
        return moved
    share = (surface.first_hits(x, path).distance.astype(np.float64) - SHORT).clip(0.0, 1.0)
    return x + np.where(np.isfinite(share), share, 1.0)[:, None] * path


def accelerated(
    v: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"], speeds: Float[ndarray, " n"], friction: float, dt: float
) -> Float[ndarray, "n 3"]:
    """Velocity along a surface after a step of gravity and Coulomb friction.

    Args:
        v: velocity before, m/s.
        normal: unit normal of the surface at each particle.
        speeds: terminal speeds in m/s, which are not exceeded.
        friction: coefficient of Coulomb friction.
        dt: s.
    """
    along = v - (v * normal).sum(1, keepdims=True) * normal
    pull = np.array([0.0, 0.0, -GRAVITY]) + GRAVITY * normal[:, 2:] * normal
    along = along + pull * dt
    fast = np.linalg.norm(along, axis=1)
    slowed = (fast - friction * GRAVITY * np.abs(normal[:, 2]) * dt).clip(0.0).clip(max=np.maximum(speeds, 1e-6))
    return along * (slowed / fast.clip(1e-12))[:, None]


def _nearest(surface: SurfaceMesh, x: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"]]:
    found = surface.closest(torch.from_numpy(x.astype(np.float32)))
    return found.points.numpy().astype(np.float64), found.normals.numpy().astype(np.float64)


def _outward(normal: Float[ndarray, "n 3"], gap: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Normals on the side of the surface on which each particle is."""
    return np.where((normal * gap).sum(1, keepdims=True) < 0, -normal, normal)
