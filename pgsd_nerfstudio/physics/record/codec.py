"""Compression of trajectories: one byte per coordinate where a particle moves smoothly, three or seven where it does not.

Positions are rounded once to a lattice, and the lattice points, whole numbers, are stored exactly. Each point is predicted from
the two before it on the same trajectory, 2 x(t-1) - x(t-2), and the remainder, the second difference, is stored in one byte.
The first point is predicted as zero, the second as the first. A difference too large for one byte leaves a mark there and goes
into a list of two-byte numbers; a difference too large for that leaves a mark there too and goes into a list of four-byte
numbers. The prediction uses only numbers that the decoder has as well, so errors do not accumulate.

The quantum is 2^-14 m (0.06 mm) as long as all coordinates are within 2^10 m of the origin. Beyond that it is the finest power
of two with which coordinates are at most 2^24 quanta. So float32 holds each lattice point exactly, and second differences, at
most 2^26, always fit into four bytes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.kernels import kernel

FINEST = -14  # binary exponent of the smallest quantum in metres
MOST = 2**24  # quanta up to which float32 holds every whole number
_ONE, _TWO = -(2**7), -(2**15)  # marks of a number that is in the next wider list


class Steps(NamedTuple):
    """Second differences of m positions in quanta, ordered by particle, axis and frame; see the module."""

    one: Int[ndarray, " m*3"]
    """int8; -128 marks the next number of `two`."""
    two: Int[ndarray, " e"]
    """int16; -32768 marks the next number of `four`."""
    four: Int[ndarray, " f"]
    """int32."""
    exponent: int
    """The quantum is 2 to this power in metres."""


def encode(positions: Float[ndarray, "m 3"], offsets: Int[ndarray, " p+1"]) -> Steps:
    """Encode trajectories.

    Args:
        positions: float32, m.
        offsets: particle i has the rows offsets[i] .. offsets[i+1].

    Raises:
        ValueError: a position is NaN or infinite, or the offsets do not ascend from 0 to m.
    """
    exponent = _exponent(positions, offsets)
    one, two, four = _encode(positions, offsets, 2.0**-exponent)
    return Steps(one, two, four, exponent)


def decode(steps: Steps, offsets: Int[ndarray, " p+1"]) -> Float[ndarray, "m 3"]:
    """Decode trajectories into float32 positions in metres.

    Args:
        steps: what `encode` returned.
        offsets: particle i has the rows offsets[i] .. offsets[i+1].

    Raises:
        ValueError: the steps are not those of trajectories with these offsets.
    """
    _check_offsets(offsets, len(steps.one) // 3)
    positions = np.empty((len(steps.one) // 3, 3), np.float32)
    needed = np.count_nonzero(steps.one == _ONE), np.count_nonzero(steps.two == _TWO)
    found = len(steps.two), len(steps.four)
    if needed != found or len(steps.one) % 3:
        raise ValueError(
            f"{len(steps.one)} steps, a multiple of 3, must come with {needed[0]} of two and {needed[1]} of four bytes, "
            f"found {found[0]} and {found[1]}"
        )
    _decode(steps.one, steps.two, steps.four, offsets, 2.0**steps.exponent, positions)
    return positions


def quantised(positions: Float[ndarray, "m 3"], offsets: Int[ndarray, " p+1"]) -> Float[ndarray, "m 3"]:
    """Positions rounded to the lattice, as `decode` returns them; rounded positions stay the same bit for bit.

    Args:
        positions: float32, m.
        offsets: particle i has the rows offsets[i] .. offsets[i+1].

    Raises:
        ValueError: as in `encode`.
    """
    exponent = _exponent(positions, offsets)
    rounded = np.empty_like(positions)
    _round(positions, 2.0**-exponent, 2.0**exponent, rounded)
    return rounded


def _exponent(positions: Float[ndarray, "m 3"], offsets: Int[ndarray, " p+1"]) -> int:
    """Binary exponent of the quantum for these positions."""
    if positions.dtype != np.float32:
        raise ValueError(f"positions must be float32, found {positions.dtype}")
    _check_offsets(offsets, len(positions))
    largest, row = _survey(positions)
    if row >= 0:
        particle = int(np.searchsorted(offsets, row, side="right")) - 1
        raise ValueError(
            f"positions of particle {particle} are not finite {row - int(offsets[particle])} frames after its birth: "
            f"{positions[row].tolist()}"
        )
    return exponent_for(largest)


def exponent_for(largest: float) -> int:
    """Binary exponent of the quantum in metres for positions with this largest absolute coordinate in metres."""
    if largest <= math.ldexp(MOST, FINEST):
        return FINEST
    # The smallest exponent with which `largest` is at most MOST quanta. Float32 is no finer there, so `largest` is a lattice
    # point already: rounded positions have the same largest coordinate and therefore the same quantum.
    mantissa, exponent = math.frexp(largest / MOST)
    return exponent - 1 if mantissa == 0.5 else exponent


def _check_offsets(offsets: Int[ndarray, " p+1"], rows: int) -> None:
    if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) < 0).any():
        ends = f"{len(offsets)} from {offsets[0]} to {offsets[-1]}" if len(offsets) else "none"
        raise ValueError(f"offsets must ascend from 0 to {rows}, found {ends}")


@kernel()
def _survey(positions):
    """Largest absolute coordinate, and the first row that is not finite, or -1."""
    largest = 0.0
    for row in range(len(positions)):
        for axis in range(3):
            size = abs(positions[row, axis])
            if not size < np.inf:
                return largest, row
            largest = max(largest, size)
    return largest, -1


@kernel()
def _round(positions, quanta, quantum, rounded):
    for row in range(len(positions)):
        for axis in range(3):
            # The way through a whole number, as in decoding, avoids a negative zero.
            rounded[row, axis] = np.int64(np.rint(positions[row, axis] * quanta)) * quantum


@kernel()
def _encode(positions, offsets, quanta):
    one = np.empty(3 * len(positions), np.int8)
    two, four = np.empty(8 * len(offsets), np.int16), np.empty(4 * len(offsets), np.int32)
    n = twos = fours = 0
    for particle in range(len(offsets) - 1):
        first, stop = offsets[particle], offsets[particle + 1]
        for axis in range(3):
            last = before = np.int64(0)
            for row in range(first, stop):
                here = np.int64(np.rint(positions[row, axis] * quanta))
                step = here - 2 * last + before
                before = here if row == first else last  # the first point is taken as if the particle had been at rest
                last = here
                if abs(step) < 2**7:
                    one[n] = step
                    n += 1
                    continue
                one[n] = -(2**7)
                n += 1
                if twos == len(two):
                    two = np.concatenate((two, np.empty_like(two)))
                two[twos] = step if abs(step) < 2**15 else -(2**15)
                twos += 1
                if abs(step) >= 2**15:
                    if fours == len(four):
                        four = np.concatenate((four, np.empty_like(four)))
                    four[fours] = step
                    fours += 1
    return one, two[:twos].copy(), four[:fours].copy()


@kernel()
def _decode(one, two, four, offsets, quantum, positions):
    """Decode; the lists must have as many numbers as there are marks."""
    n = twos = fours = 0
    for particle in range(len(offsets) - 1):
        first, stop = offsets[particle], offsets[particle + 1]
        for axis in range(3):
            last = before = np.int64(0)
            for row in range(first, stop):
                step = np.int64(one[n])
                n += 1
                if step == -(2**7):
                    step = np.int64(two[twos])
                    twos += 1
                    if step == -(2**15):
                        step = np.int64(four[fours])
                        fours += 1
                here = step + 2 * last - before
                before = here if row == first else last
                last = here
                positions[row, axis] = here * quantum
