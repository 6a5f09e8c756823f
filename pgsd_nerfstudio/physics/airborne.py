"""Particles that fall through air without touching each other.

Linear drag about the terminal velocity: dv/dt = -(v - v_inf) / tau with tau = v_t / g, so a step through steady air is exact
whatever its length. The wind is taken at the middle of the step, which makes changing air second order at the cost of first.
Each flake also sways sideways on a small circle of its own (flutter), as its settled velocity does.

The kernel is generic: float32 at work, float64 in tests. `WindField.velocity` is the plain form of the wind within.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.physics.wind import CALM, WindField

GRAVITY = 9.81  # m/s^2

# sin(2 pi r) for |r| <= 1/4 as an odd polynomial, error below 4e-9: written out so that the loop over modes vectorises.
_SINE = (6.283185160088967, -41.34165503128624, 81.60100406452872, -76.54978208076217, 39.53670436361769)


@dataclass(frozen=True)
class Flutter:
    """The swaying of n particles."""

    speed: Float[ndarray, "n"]
    """m/s."""
    hertz: Float[ndarray, "n"]
    phase: Float[ndarray, "n"]
    """Turns."""

    @staticmethod
    def none(count: int, dtype: type = np.float32) -> Flutter:
        zero = np.zeros(count, dtype)
        return Flutter(zero, zero, zero)


def advance(
    position: Float[ndarray, "n 3"],  # m, z up; changed in place
    velocity: Float[ndarray, "n 3"],  # m/s; changed in place
    speed: Float[ndarray, "n"],  # terminal, m/s
    flutter: Flutter,
    wind: WindField,
    time: float,  # s, at the start of the step
    step: float,  # s
) -> None:
    """Advance all particles by `step` seconds."""
    number = position.dtype.type
    middle = time + 0.5 * step
    mean_x, mean_y = wind.at_reference(middle)
    profile = 1.0 / math.log1p(wind.reference_height / wind.roughness)
    constants = np.array(
        [step, middle, mean_x * profile, mean_y * profile, wind.roughness, CALM, GRAVITY, 0.5, 1.0, 0.25, 1e-6], position.dtype
    )
    modes = np.concatenate([wind.waves, wind.swirls, wind.potentials[:, :2], wind.phases_at(middle)[:, None]], 1)
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
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _cosine(turns, half, quarter, c):
    """cos(2 pi turns), without branches; constants are passed so that float32 stays float32."""
    r = quarter - abs(turns - np.floor(turns + half))  # math.floor would go through int64
    s = r * r
    return r * (c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * c[4]))))


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})
def _advance(position, velocity, speed, sway, hertz, phase, modes, constants, c):
    step, middle, mean_x, mean_y, roughness, calm_height, gravity, half, one, quarter, least = constants
    zero = half - half
    for i in range(position.shape[0]):
        x = position[i, 0] + half * step * velocity[i, 0]
        y = position[i, 1] + half * step * velocity[i, 1]
        z = position[i, 2] + half * step * velocity[i, 2]
        height = max(z, zero)
        s = height / calm_height
        calm = s * s / (one + s * s)
        slope = (s + s) / (calm_height * (one + s * s) * (one + s * s))
        swirl_x, swirl_y, swirl_z, lifted_x, lifted_y = zero, zero, zero, zero, zero
        for m in range(modes.shape[1]):
            turns = modes[0, m] * x + modes[1, m] * y + modes[2, m] * z + modes[8, m]
            cosine = _cosine(turns, half, quarter, c)
            sine = _cosine(turns - quarter, half, quarter, c)
            swirl_x += modes[3, m] * cosine
            swirl_y += modes[4, m] * cosine
            swirl_z += modes[5, m] * cosine
            lifted_x -= modes[7, m] * sine
            lifted_y += modes[6, m] * sine
        profile = np.log1p(height / roughness)
        turns = hertz[i] * middle + phase[i]
        settled_x = calm * swirl_x + slope * lifted_x + profile * mean_x + sway[i] * _cosine(turns, half, quarter, c)
        settled_y = calm * swirl_y + slope * lifted_y + profile * mean_y + sway[i] * _cosine(turns - quarter, half, quarter, c)
        settled_z = calm * swirl_z - speed[i]
        # Relaxation time; particles that hardly fall (fog) follow the wind at once instead of dividing by zero.
        tau = max(speed[i] / gravity, least)
        decay = np.exp(-step / tau)
        reach = tau * (one - decay)
        for axis, settled in ((0, settled_x), (1, settled_y), (2, settled_z)):
            relative = velocity[i, axis] - settled
            position[i, axis] += settled * step + relative * reach
            velocity[i, axis] = settled + relative * decay
