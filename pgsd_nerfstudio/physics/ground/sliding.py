"""Sliders: single particles that slide down a surface under gravity and Coulomb friction, at most at their terminal speed.

A slider follows the closest point of the surface, LIFT above it on its own side. It flies again where the surface falls away,
and it lands when it has become slow. `dense` moves crowded sliders together.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.bodies import GRAVITY, Bodies
from pgsd_nerfstudio.surface.short_ways import blended, corners_of, first_met, grid_of, nearest, normal_at
from pgsd_nerfstudio.surface.triangle_cells import TriangleCells

PARTS = 2  # straight pieces of a centimetre or two in which a slider follows the surface within a frame
DETACH = 0.02  # m above the surface at which a slider flies
BEYOND = 0.005  # m beyond an edge, sideways from the nearest point, at which a slider flies
SLOW = 0.05  # m/s below which a slider lands
SHORT = 0.01  # share of a path by which it ends before a surface
FAR = 0.3  # m from the surface, as on deep cover, within which a slider still finds it
LIFT = 0.002  # m above the surface at which sliders move, so that rays of the next frame start outside of it


class Slid(NamedTuple):
    """Sliders after a frame."""

    bodies: Bodies
    rests: Bool[ndarray, " n"]
    """Sliders that have become slow."""
    flies: Bool[ndarray, " n"]
    """Sliders that have lost the surface."""


def slide(bodies: Bodies, ground: TriangleCells, friction: float, step: float) -> Slid:
    """Advance sliders by one step.

    Args:
        bodies: the sliders.
        ground: triangles of the surface that they slide on.
        friction: coefficient of Coulomb friction.
        step: s.
    """
    x, v = bodies.positions.astype(np.float64), bodies.velocities.astype(np.float64)
    lists = ground.clearance.parts.reshape(-1), ground.first, ground.members
    mesh = ground.triangles.reshape(-1), ground.vertices.reshape(-1), ground.normals.reshape(-1)
    rests, flies = _slide(x, v, bodies.speeds.astype(np.float64), friction, step, grid_of(ground), *lists, *mesh)
    moved = replace(bodies, positions=x.astype(np.float32), velocities=v.astype(np.float32))
    return Slid(moved, rests, flies)


@kernel()
def _slide(positions, velocities, speeds, friction, step, grid, parts, first, members, triangles, vertices, normals):
    """Move sliders in place; returns which of them rest and which fly."""
    rests, flies = np.zeros(len(positions), np.bool_), np.zeros(len(positions), np.bool_)
    dt = step / PARTS
    for n in range(len(positions)):
        x, y, z = positions[n]
        v_x, v_y, v_z = velocities[n]
        _, which, u, v = nearest(x, y, z, FAR, grid, first, members, triangles, vertices)
        free = which < 0
        normal = (0.0, 0.0, 1.0)
        if which >= 0:
            a, b, c = corners_of(triangles, which)
            normal = normal_at(vertices, normals, a, b, c, u, v)
        for _ in range(PARTS):
            if not free:
                v_x, v_y, v_z = _accelerated(v_x, v_y, v_z, normal, speeds[n], friction, dt)
            x, y, z = _stopped(x, y, z, v_x * dt, v_y * dt, v_z * dt, grid, parts, first, members, triangles, vertices)
            if free:
                continue
            distance, which, u, v = nearest(x, y, z, DETACH, grid, first, members, triangles, vertices)
            if which < 0:
                free = True
                continue
            a, b, c = corners_of(triangles, which)
            at_x, at_y, at_z = blended(vertices, a, b, c, u, v)
            normal = normal_at(vertices, normals, a, b, c, u, v)
            upright = (x - at_x) * normal[0] + (y - at_y) * normal[1] + (z - at_z) * normal[2]
            # The gap is along the normal within a sheet and along the sheet past its edge. Corners of a rough mesh are between.
            if distance > BEYOND and abs(upright) < 0.7 * distance:
                free = True
                continue
            lift = LIFT if upright >= 0.0 else -LIFT
            to_x, to_y, to_z = at_x + lift * normal[0], at_y + lift * normal[1], at_z + lift * normal[2]
            x, y, z = _stopped(x, y, z, to_x - x, to_y - y, to_z - z, grid, parts, first, members, triangles, vertices)
        way = math.sqrt((x - positions[n, 0]) ** 2 + (y - positions[n, 1]) ** 2 + (z - positions[n, 2]) ** 2)
        rests[n], flies[n] = way < SLOW * step and not free, free
        positions[n, 0], positions[n, 1], positions[n, 2] = x, y, z
        velocities[n, 0], velocities[n, 1], velocities[n, 2] = v_x, v_y, v_z
    return rests, flies


@kernel()
def _stopped(x, y, z, way_x, way_y, way_z, grid, parts, first, members, triangles, vertices):
    """End of a path: it stops before the first surface, so that no slider crosses one in a corner."""
    length = math.sqrt(way_x * way_x + way_y * way_y + way_z * way_z)
    if length == 0.0:
        return x, y, z
    inverse, reach = 1.0 / length, length * (1.0 + SHORT)
    d_x, d_y, d_z = way_x * inverse, way_y * inverse, way_z * inverse
    at, which, _, _ = first_met(x, y, z, d_x, d_y, d_z, reach, grid, parts, first, members, triangles, vertices)
    share = min(max(at * inverse - SHORT, 0.0), 1.0) if which >= 0 else 1.0
    return x + share * way_x, y + share * way_y, z + share * way_z


@kernel(inline="always")
def _accelerated(v_x, v_y, v_z, normal, speed, friction, dt):
    """Velocity along a surface after a step of gravity and Coulomb friction; `speed` is not exceeded."""
    n_x, n_y, n_z = normal
    into = v_x * n_x + v_y * n_y + v_z * n_z
    v_x += GRAVITY * n_z * n_x * dt - into * n_x
    v_y += GRAVITY * n_z * n_y * dt - into * n_y
    v_z += (GRAVITY * n_z * n_z - GRAVITY) * dt - into * n_z
    fast = math.sqrt(v_x * v_x + v_y * v_y + v_z * v_z)
    slowed = min(max(fast - friction * GRAVITY * abs(n_z) * dt, 0.0), max(speed, 1e-6))
    share = slowed / max(fast, 1e-12)
    return v_x * share, v_y * share, v_z * share
