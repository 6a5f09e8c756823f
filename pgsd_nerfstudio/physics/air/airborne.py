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

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import GRAVITY
from pgsd_nerfstudio.physics.laws.boundary_layer import CALM

# For |r| <= 1/2 sin(pi r) is r times a polynomial of r^2, and cos(pi r) is one, with errors below 4e-9 and 3e-10. They are
# written out so that loops vectorise.
_SINE = (3.1415925798039193, -5.167706866061563, 2.550031191732045, -0.5980441830182845, 0.07721836436962909)
_COSINE = (
    0.999999999779958,
    -4.934802137082356,
    4.058709159615874,
    -1.3352120034160795,
    0.23493731456299083,
    -0.02439632439532769,
)
BLOCK = 64  # particles whose turbulence is summed together, mode by mode; a vector holds sixteen

KEPT = 32  # steps whose wind is kept
Instant = tuple[ndarray | tuple[np.floating, ...] | None, ...]
"""Modes, constants, polynomials and obstacles as the kernel takes them."""
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
    kept: dict[tuple[float, float], Instant] | None = None,
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
        kept: takes what this step needs of the wind and hands it to later ones of the same time, step and precision; None: it
            is made anew.
    """
    found = None if kept is None else kept.get((time, step))
    if found is None:
        found = _instant(wind, time, step, position.dtype)
        if kept is not None:
            while len(kept) >= KEPT:
                del kept[next(iter(kept))]
            kept[time, step] = found
    _advance(position, velocity, speed, flutter.speed, flutter.hertz, flutter.phase, *found)


def _instant(wind: WindField, time: float, step: float, dtype: np.dtype) -> Instant:
    """What the kernel needs of a wind for a step."""
    number, middle = dtype.type, time + 0.5 * step
    mean = wind.at_reference(middle)
    profile = 1.0 / math.log1p(wind.reference_height / wind.roughness)
    constants = np.array(
        [step, middle, mean[0] * profile, mean[1] * profile, wind.roughness, CALM, GRAVITY, 0.5, 1.0, 1e-6], dtype
    )
    modes = np.concatenate([wind.waves, wind.swirls, wind.potentials, wind.phases_at(middle)[:, None]], 1)
    if len(modes) % 2:  # the kernel takes two at once
        modes = np.concatenate([modes, np.zeros_like(modes[:1])])
    polynomials = tuple(number(value) for value in _SINE), tuple(number(value) for value in _COSINE)
    return np.ascontiguousarray(modes.T, dtype=dtype), constants, *polynomials, *_obstacles(wind, mean, dtype)


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


@kernel(inline="always")
def _circle(turns, half, sine, cosine):
    """cos(2 pi turns) and sin(2 pi turns), without branches, from those of half the angle.

    Constants are passed so that float32 stays float32.
    """
    r = turns - np.floor(turns + half)  # math.floor would go through int64
    s = r * r
    y = r * (sine[0] + s * (sine[1] + s * (sine[2] + s * (sine[3] + s * sine[4]))))
    x = cosine[0] + s * (cosine[1] + s * (cosine[2] + s * (cosine[3] + s * (cosine[4] + s * cosine[5]))))
    double = y + y
    return half + half - double * y, double * x


@kernel(inline="always")
def _node(place, last, zero):
    """First of the three nodes around a place, and the fraction of the distance to the second; NaN goes to node 0."""
    place = place if place > zero else zero
    place = place if place < last else last
    floor = np.floor(place)
    return int(floor), place - floor


@kernel(inline="always")
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


@kernel(inline="always")
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


@kernel(fastmath={"contract", "reassoc", "nsz", "arcp"})
def _advance(position, velocity, speed, sway, hertz, phase, modes, constants, sine, cosine, lattice, nodes, ramp, calmed):
    step, middle, mean_x, mean_y, roughness, calm_height, gravity, half, one, least = constants
    zero = half - half
    if nodes is not None:
        first_x, first_y, first_z, inverse, last_x, last_y, last_z = lattice
        flat, rows = nodes.reshape(-1), nodes.shape
    count = position.shape[0]
    middles = np.empty((3, BLOCK), position.dtype)
    sums = np.empty((6, BLOCK), position.dtype)
    xs, ys, zs = middles[0], middles[1], middles[2]
    swirls_x, swirls_y, swirls_z, lifts_x, lifts_y, lifts_z = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    for start in range(0, count, BLOCK):
        for b in range(BLOCK):
            i = min(start + b, count - 1)
            xs[b] = position[i, 0] + half * step * velocity[i, 0]
            ys[b] = position[i, 1] + half * step * velocity[i, 1]
            zs[b] = position[i, 2] + half * step * velocity[i, 2]
        sums[:] = zero
        for m in range(0, modes.shape[1], 2):
            u, v = modes[:, m], modes[:, m + 1]
            u_x, u_y, u_z, u_phase, v_x, v_y, v_z, v_phase = u[0], u[1], u[2], u[9], v[0], v[1], v[2], v[9]
            u_3, u_4, u_5, u_6, u_7, u_8 = u[3], u[4], u[5], u[6], u[7], u[8]
            v_3, v_4, v_5, v_6, v_7, v_8 = v[3], v[4], v[5], v[6], v[7], v[8]
            for b in range(BLOCK):
                u_cos, u_sin = _circle(u_x * xs[b] + u_y * ys[b] + u_z * zs[b] + u_phase, half, sine, cosine)
                v_cos, v_sin = _circle(v_x * xs[b] + v_y * ys[b] + v_z * zs[b] + v_phase, half, sine, cosine)
                swirls_x[b] += u_3 * u_cos + v_3 * v_cos
                swirls_y[b] += u_4 * u_cos + v_4 * v_cos
                swirls_z[b] += u_5 * u_cos + v_5 * v_cos
                lifts_x[b] += u_7 * u_sin + v_7 * v_sin
                lifts_y[b] += u_6 * u_sin + v_6 * v_sin
                if nodes is not None:
                    lifts_z[b] += u_8 * u_sin + v_8 * v_sin
        for b in range(min(BLOCK, count - start)):
            i = start + b
            x, y, z = xs[b], ys[b], zs[b]
            height = max(z, zero)
            s = height / calm_height
            calm = s * s / (one + s * s)
            slope = (s + s) / (calm_height * (one + s * s) * (one + s * s))
            swirl_x, swirl_y, swirl_z = swirls_x[b], swirls_y[b], swirls_z[b]
            lifted_x, lifted_y, lifted_z = -lifts_x[b], lifts_y[b], lifts_z[b]
            profile = np.log(one + height / roughness)
            sway_x, sway_y = _circle(hertz[i] * middle + phase[i], half, sine, cosine)
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
            settled_x = calm * swirl_x + slope * lifted_x + profile * mean_x + sway[i] * sway_x
            settled_y = calm * swirl_y + slope * lifted_y + profile * mean_y + sway[i] * sway_y
            settled_z = calm * swirl_z - speed[i]
            if nodes is not None:
                settled_x += change_x
                settled_y += change_y
                settled_z += change_z
            # Relaxation time, bounded from below: particles of almost no terminal speed (fog) follow the wind at once.
            tau = max(speed[i] / gravity, least)
            decay = np.exp(-step / tau)
            reach = tau * (one - decay)
            part_x, part_y, part_z = velocity[i, 0] - settled_x, velocity[i, 1] - settled_y, velocity[i, 2] - settled_z
            position[i, 0] += settled_x * step + part_x * reach
            position[i, 1] += settled_y * step + part_y * reach
            position[i, 2] += settled_z * step + part_z * reach
            velocity[i, 0] = settled_x + part_x * decay
            velocity[i, 1] = settled_y + part_y * decay
            velocity[i, 2] = settled_z + part_z * decay
