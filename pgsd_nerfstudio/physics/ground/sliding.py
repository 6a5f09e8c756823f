"""Particles that slide down a surface one by one: gravity along it, Coulomb friction, no faster than they would fall.

A slider follows the closest point of the surface, LIFT above it on the side on which it is. Where the surface falls away
beneath it, it flies again; where it has become slow it lies still. What many of them do together is the business of `dense`.
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

PARTS = 2  # of a frame: the surface is followed in straight pieces of a centimetre or two
DETACH = 0.02  # m above the surface at which a slider has lost it
BEYOND = 0.005  # m beyond an edge, sideways from the nearest point, at which it has lost it too
SLOW = 0.05  # m/s
SHORT = 0.01  # share of a way by which it ends before the surface that it meets
LIFT = 0.002  # m above the surface on which sliders move, so that rays of the next frame begin outside


class Slid(NamedTuple):
    """Sliders after a frame."""

    bodies: Bodies
    rests: Bool[ndarray, " n"]
    flies: Bool[ndarray, " n"]


def slide(bodies: Bodies, surface: SurfaceMesh, friction: float, step: float) -> Slid:
    """Advance sliders by `step` seconds."""
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
        # Within a sheet the gap is upright; past its edge it lies along the sheet. Corners of a rough mesh are in between.
        flies |= (distance > DETACH) | ((distance > BEYOND) & (upright < 0.7 * distance))
        onto = _stopped(surface, moved, new_at + LIFT * _outward(new_normal, gap))
        x = np.where(flies[:, None], moved, onto)
        normal = new_normal
    slow = np.linalg.norm(x - begin, axis=1) < SLOW * step
    moved = replace(bodies, positions=x.astype(np.float32), velocities=v.astype(np.float32))
    return Slid(moved, slow & ~flies, flies)


def _stopped(surface: SurfaceMesh, x: Float[ndarray, "n 3"], moved: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Where the ways from `x` end: before the first surface that they would cross. Nothing changes sides in a corner."""
    way = moved - x
    hits = surface.cast(torch.from_numpy(x.astype(np.float32)), torch.from_numpy(way.astype(np.float32)))
    share = (hits.distance.numpy().astype(np.float64) - SHORT).clip(0.0, 1.0)
    return x + np.where(np.isfinite(share), share, 1.0)[:, None] * way


def accelerated(
    v: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"], speeds: Float[ndarray, " n"], friction: float, dt: float
) -> Float[ndarray, "n 3"]:
    """Velocity along the surface after `dt` seconds of gravity and friction; terminal speed `speeds` is not exceeded."""
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
    """Normals turned to the side on which the particle is."""
    return np.where((normal * gap).sum(1, keepdims=True) < 0, -normal, normal)
