"""Flight of particles that fall through air without contact with each other.

Drag is linear about the terminal velocity: dv/dt = -(v - v_inf) / tau with tau = v_t / g, so a step through steady air is exact
whatever its length. The wind is taken at the middle of the step, which makes the step second order in changing air at the cost
of a first-order one. The settled velocity of each particle also turns on a small horizontal circle of its own (flutter).

The kernel is generic: it runs in float32, and in float64 in tests. `WindField.velocity` is the plain form of its wind. In open
country the kernel is compiled for `None` in place of the obstacles' arrays, so that obstacles cost nothing there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import GRAVITY
from pgsd_nerfstudio.physics.laws.boundary_layer import CALM

# sin(2 pi r) for |r| <= 1/4 as an odd polynomial, error below 4e-9: written out so that the loop over modes vectorises.
_SINE = (6.283185160088967, -41.34165503128624, 81.60100406452872, -76.54978208076217, 39.53670436361769)


SETTLE = 1e-3  # s; a thousand of the shortest relaxation times in the kernel


@dataclass(frozen=True)
class Flutter:
    """Flutter of n particles."""

    speed: Float[ndarray, " n"]
    """m/s."""
    hertz: Float[ndarray, " n"]
    """Turns per second; the sign is the sense of rotation."""
    phase: Float[ndarray, " n"]
    """Turns."""

    @staticmethod
    def none(count: int, dtype: type = np.float32) -> Flutter:
        """No flutter for `count` particles."""
        zero = np.zeros(count, dtype)
        return Flutter(zero, zero, zero)


def advance(
    position: Float[ndarray, "n 3"],
    velocity: Float[ndarray, "n 3"],
    speed: Float[ndarray, " n"],
    flutter: Flutter,
    wind: WindField,
    time: float,
    step: float,
) -> None:
    """Advance all particles by one step.

    Args:
        position: m, z up; changed in place.
        velocity: m/s; changed in place.
        speed: terminal speeds, m/s.
        flutter: of the particles.
        wind: the moving air.
        time: s, at the start of the step.
        step: s.
    """
    number = position.dtype.type
    middle = time + 0.5 * step
    mean = wind.at_reference(middle)
    profile = 1.0 / math.log1p(wind.reference_height / wind.roughness)
    constants = np.array(
        [step, middle, mean[0] * profile, mean[1] * profile, wind.roughness, CALM, GRAVITY, 0.5, 1.0, 0.25, 1e-6],
        position.dtype,
    )
    modes = np.concatenate([wind.waves, wind.swirls, wind.potentials, wind.phases_at(middle)[:, None]], 1)
    _advance(
        position,
        velocity,
        speed,
        flutter.speed,
        flutter.hertz,
        flutter.phase,
        np.ascontiguousarray(modes.T, dtype=position.dtype),
        constants,
        np.array(_SINE, number),
        *_obstacles(wind, mean, position.dtype),
    )


def air_velocity(points: Float[ndarray, "n 3"], wind: WindField, time: float) -> Float[ndarray, "n 3"]:
    """Velocity of the air in m/s, by the kernel that moves the particles.

    Args:
        points: m, z up; float32 or float64, which is also the precision of the result.
        wind: the moving air.
        time: s.
    """
    # Bodies without weight that start at rest have the velocity of the air after a step of many relaxation times, and the
    # kernel takes the wind where they start, in the middle of the step.
    velocity, nothing = np.zeros_like(points), np.zeros(len(points), points.dtype)
    advance(points.copy(), velocity, nothing, Flutter(nothing, nothing, nothing), wind, time - 0.5 * SETTLE, SETTLE)
    return velocity


def _obstacles(wind: WindField, mean: Float[ndarray, "2"], dtype: np.dtype) -> tuple[ndarray | None, ...]:
    """Lattice and nodes of the deflection for the kernel; None in open country."""
    if wind.deflection is None:
        return None, None, None, None
    nodes, ramp, calmed = wind.deflection.nodes(mean, dtype)
    last = np.subtract(ramp.shape, 3)
    lattice = np.array([*wind.deflection.first, 1 / wind.deflection.cell, *last], dtype)
    return lattice, nodes, ramp, calmed


@numba.njit(cache=True, nogil=True, inline="always")
def _cosine(turns, half, quarter, c):
    """cos(2 pi turns), without branches; constants are passed so that float32 stays float32."""
    r = quarter - abs(turns - np.floor(turns + half))  # math.floor would go through int64
    s = r * r
    return r * (c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * c[4]))))


@numba.njit(cache=True, nogil=True, inline="always")
def _node(place, last, zero):
    """First of the three nodes around a place, and the fraction of the distance to the second; NaN goes to node 0."""
    place = place if place > zero else zero
    place = place if place < last else last
    floor = np.floor(place)
    return int(floor), place - floor


@numba.njit(cache=True, nogil=True, inline="always")
def _deflected(nodes, rows, i, j, k, x, y, z, half, one):
    """Change of the mean wind by obstacles: each component is quadratic along its own axis and linear along the others.

    `nodes` is one list of numbers; unsigned indices spare the check whether they count from its end.
    """
    lx, ly, lz = (one - x, x), (one - y, y), (one - z, z)
    qx = (half * lx[0] * lx[0], half + x * lx[0], half * x * x)
    qy = (half * ly[0] * ly[0], half + y * ly[0], half * y * y)
    qz = (half * lz[0] * lz[0], half + z * lz[0], half * z * z)
    wind_x, wind_y, wind_z = one - one, one - one, one - one
    first = np.uint64((i * rows[1] + j) * rows[2] + k) * np.uint64(3)
    along_x, along_y = np.uint64(3 * rows[1] * rows[2]), np.uint64(3 * rows[2])
    for a in range(3):
        for b in range(2):
            at = first + np.uint64(a) * along_x + np.uint64(b) * along_y
            wind_x += qx[a] * ly[b] * (lz[0] * nodes[at] + lz[1] * nodes[at + np.uint64(3)])
            at = first + np.uint64(b) * along_x + np.uint64(a) * along_y
            wind_y += lx[b] * qy[a] * (lz[0] * nodes[at + np.uint64(1)] + lz[1] * nodes[at + np.uint64(4)])
    for a in range(2):
        for b in range(2):
            at = first + np.uint64(a) * along_x + np.uint64(b) * along_y + np.uint64(2)
            column = qz[0] * nodes[at] + qz[1] * nodes[at + np.uint64(3)] + qz[2] * nodes[at + np.uint64(6)]
            wind_z += lx[a] * ly[b] * column
    return wind_x, wind_y, wind_z


@numba.njit(cache=True, nogil=True, inline="always")
def _shelter(ramp, i, j, k, x, y, z, half, one):
    """Share of the turbulence that obstacles leave, and its gradient per node: smooth steps between eight nodes."""
    three, six = (one + half) / half, (one + one + one) / half
    step_x, step_y, step_z = x * x * (three - x - x), y * y * (three - y - y), z * z * (three - z - z)
    slope_x, slope_y, slope_z = six * x * (one - x), six * y * (one - y), six * z * (one - z)
    r00, r01, r10, r11 = ramp[i, j, k], ramp[i, j + 1, k], ramp[i + 1, j, k], ramp[i + 1, j + 1, k]
    up00, up01 = ramp[i, j, k + 1] - r00, ramp[i, j + 1, k + 1] - r01
    up10, up11 = ramp[i + 1, j, k + 1] - r10, ramp[i + 1, j + 1, k + 1] - r11
    r00, r01, r10, r11 = r00 + step_z * up00, r01 + step_z * up01, r10 + step_z * up10, r11 + step_z * up11
    r0, r1 = r00 + step_y * (r01 - r00), r10 + step_y * (r11 - r10)
    up0, up1 = up00 + step_y * (up01 - up00), up10 + step_y * (up11 - up10)
    side0, side1 = r01 - r00, r11 - r10
    return (
        r0 + step_x * (r1 - r0),
        slope_x * (r1 - r0),
        slope_y * (side0 + step_x * (side1 - side0)),
        slope_z * (up0 + step_x * (up1 - up0)),
    )


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})
def _advance(position, velocity, speed, sway, hertz, phase, modes, constants, c, lattice, nodes, ramp, calmed):
    step, middle, mean_x, mean_y, roughness, calm_height, gravity, half, one, quarter, least = constants
    zero = half - half
    if nodes is not None:
        first_x, first_y, first_z, inverse, last_x, last_y, last_z = lattice
        flat, rows = nodes.reshape(-1), nodes.shape
    for i in range(position.shape[0]):
        x = position[i, 0] + half * step * velocity[i, 0]
        y = position[i, 1] + half * step * velocity[i, 1]
        z = position[i, 2] + half * step * velocity[i, 2]
        height = max(z, zero)
        s = height / calm_height
        calm = s * s / (one + s * s)
        slope = (s + s) / (calm_height * (one + s * s) * (one + s * s))
        swirl_x, swirl_y, swirl_z, lifted_x, lifted_y, lifted_z = zero, zero, zero, zero, zero, zero
        for m in range(modes.shape[1]):
            turns = modes[0, m] * x + modes[1, m] * y + modes[2, m] * z + modes[9, m]
            cosine = _cosine(turns, half, quarter, c)
            sine = _cosine(turns - quarter, half, quarter, c)
            swirl_x += modes[3, m] * cosine
            swirl_y += modes[4, m] * cosine
            swirl_z += modes[5, m] * cosine
            lifted_x -= modes[7, m] * sine
            lifted_y += modes[6, m] * sine
            if nodes is not None:
                lifted_z += modes[8, m] * sine
        profile = np.log(one + height / roughness)
        turns = hertz[i] * middle + phase[i]
        if nodes is not None:
            i_x, share_x = _node((x - first_x) * inverse, last_x, zero)
            i_y, share_y = _node((y - first_y) * inverse, last_y, zero)
            i_z, share_z = _node((height - first_z) * inverse, last_z, zero)
            change_x, change_y, change_z = _deflected(flat, rows, i_x, i_y, i_z, share_x, share_y, share_z, half, one)
            if calmed[i_x, i_y, i_z]:
                shelter, rise_x, rise_y, rise_z = _shelter(ramp, i_x, i_y, i_z, share_x, share_y, share_z, half, one)
                change_x += inverse * calm * (rise_y * lifted_z + rise_z * lifted_x)
                change_y += inverse * calm * (rise_z * lifted_y - rise_x * lifted_z)
                change_z -= inverse * calm * (rise_x * lifted_x + rise_y * lifted_y)
                calm, slope = calm * shelter, slope * shelter
        settled_x = calm * swirl_x + slope * lifted_x + profile * mean_x + sway[i] * _cosine(turns, half, quarter, c)
        settled_y = calm * swirl_y + slope * lifted_y + profile * mean_y + sway[i] * _cosine(turns - quarter, half, quarter, c)
        settled_z = calm * swirl_z - speed[i]
        if nodes is not None:
            settled_x += change_x
            settled_y += change_y
            settled_z += change_z
        # Relaxation time, bounded from below: particles of almost no terminal speed (fog) follow the wind at once.
        tau = max(speed[i] / gravity, least)
        decay = np.exp(-step / tau)
        reach = tau * (one - decay)
        for axis, settled in ((0, settled_x), (1, settled_y), (2, settled_z)):
            relative = velocity[i, axis] - settled
            position[i, axis] += settled * step + relative * reach
            velocity[i, axis] = settled + relative * decay
