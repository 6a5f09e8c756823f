"""Stored trajectories: how exact, how small, and what is refused. The judge is second differences by numpy in whole numbers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pgsd_nerfstudio.physics.record.codec import Steps, decode, encode, quantised

QUANTUM = 2.0**-14


def wandering(scale: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories of 0, 1, 2 and more rows that jump about within +-scale metres, and their offsets."""
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(np.concatenate([[0, 1, 2, 0], rng.integers(0, 40, 60)]))])
    return rng.uniform(-scale, scale, (offsets[-1], 3)).astype(np.float32), offsets


def falling(count: int = 200, frames: int = 125, fps: float = 25.0) -> tuple[np.ndarray, np.ndarray]:
    """Flakes that fall with 1 m/s and sway 0.2 m/s at 1 Hz, within gusts of 1 m/s^2."""
    rng = np.random.default_rng(1)
    t = np.arange(frames)[:, None] / fps
    start, phase = rng.uniform(-5, 5, (count, 1, 3)), rng.uniform(0, 2 * np.pi, (count, 1, 1))
    sway = 0.2 / (2 * np.pi) * np.cos(2 * np.pi * t + phase) * [1, 1, 0]
    gust = 1.0 / 0.8**2 * np.sin(0.8 * t + 3 * phase) * [1, 0, 0]
    rows = (start + sway + gust - t * [0, 0, 1.0]).reshape(-1, 3)
    return rows.astype(np.float32), np.arange(count + 1) * frames


def in_quanta(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One trajectory along x at those whole numbers of quanta."""
    positions = np.zeros((len(rows), 3), np.float32)
    positions[:, 0] = np.asarray(rows) * QUANTUM
    return positions, np.array([0, len(rows)])


def differences(positions: np.ndarray, offsets: np.ndarray, quantum: float) -> np.ndarray:
    """Steps by the definition: second differences of trajectories that stood still before, at zero and then at their start."""
    parts = []
    for first, stop in pairwise(offsets):
        for x in positions[first:stop].astype(np.float64).T:
            whole = np.rint(x / quantum).astype(np.int64)
            parts.append(np.concatenate([whole[:1], np.diff(whole, n=2, prepend=whole[:1])]) if len(x) > 1 else whole)
    return np.concatenate(parts)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1000.0])
def test_a_position_is_off_by_half_a_quantum_at_most(scale):
    positions, offsets = wandering(scale)
    error = np.abs(decode(encode(positions, offsets), offsets).astype(np.float64) - positions)
    assert 0 < error.max() <= QUANTUM / 2


def test_errors_do_not_accumulate_over_ten_thousand_frames():
    # Steps of 25.075 quanta: were each rounded by itself, 750 quanta would be missing at the end.
    x = np.arange(10_000) * 25.075 * QUANTUM
    positions = np.stack([x, -x, 0 * x], axis=1).astype(np.float32)
    offsets = np.array([0, len(x)])
    assert np.abs(decode(encode(positions, offsets), offsets).astype(np.float64) - positions).max() <= QUANTUM / 2


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1023.9999, 1024.0, 1025.0, 1e4, 3e38])
def test_quantised_is_what_decoding_gives_and_stays_bit_for_bit(scale):
    positions, offsets = wandering(scale)
    positions[:3] = [[scale, -scale, -0.0], [-1e-9, 1e-9, 0], [scale / 3, 0, 0]]
    once, steps = quantised(positions, offsets), encode(positions, offsets)
    assert once.tobytes() == decode(steps, offsets).tobytes()
    assert quantised(once, offsets).tobytes() == once.tobytes()
    again = encode(once, offsets)
    assert again.exponent == steps.exponent
    assert [part.tobytes() for part in again[:3]] == [part.tobytes() for part in steps[:3]]


@pytest.mark.parametrize(
    ("largest", "exponent"),
    [(0.0, -14), (5.0, -14), (1024.0, -14), (1024.0002, -13), (1e4, -10), (16384.0, -10), (16385.0, -9)],
)
def test_the_quantum_grows_only_beyond_two_to_the_24_quanta(largest, exponent):
    positions = np.array([[0, -largest, 1]], np.float32) * (largest > 0)
    assert encode(positions.astype(np.float32), np.array([0, 1])).exponent == exponent


def test_coordinates_far_out_lose_nothing_that_float32_had():
    positions, offsets = wandering(1e4)
    # Ten kilometres: the quantum is the spacing of float32 from 8192 m on.
    far = np.abs(positions) >= 8192
    assert far.any() and (quantised(positions, offsets)[far] == positions[far]).all()


@pytest.mark.parametrize("scale", [0.01, 0.5, 50.0, 1e4])
def test_steps_are_second_differences(scale):
    positions, offsets = wandering(scale)
    steps = encode(positions, offsets)
    truth = differences(positions, offsets, 2.0**steps.exponent)
    small, middle = np.abs(truth) < 128, np.abs(truth) < 32768
    assert (steps.one == np.where(small, truth, -128)).all()
    assert (steps.two == np.where(middle, truth, -32768)[~small]).all()
    assert (steps.four == truth[~middle]).all()


def test_steps_of_a_trajectory_worked_by_hand():
    # 5, 8, 11: at 5, then +3, then no change of velocity; then 211 (+197), then back to 0 (-411), then 100000 (+100211).
    steps = encode(*in_quanta(np.array([5, 8, 11, 211, 0, 100_000])))
    assert steps.one[:6].tolist() == [5, 3, 0, -128, -128, -128] and not steps.one[6:].any()
    assert steps.two.tolist() == [197, -411, -32768]
    assert steps.four.tolist() == [100_211]


@pytest.mark.parametrize("step", [127, 128, 129, 255, 256, 32767, 32768, 32769, 65536, 2**24])
def test_no_step_wraps_around(step):
    for sign in (1, -1):
        for rows in ([sign * step], [0, sign * step], [0, 0, sign * step], [7, 7, 7 - sign * min(step, 2**23)]):
            positions, offsets = in_quanta(np.array(rows))
            assert (decode(encode(positions, offsets), offsets) == positions).all()


def test_the_largest_second_difference_there_is_survives():
    positions, offsets = in_quanta(np.array([2**24, -(2**24), 2**24, -(2**24)]))
    steps = encode(positions, offsets)
    assert steps.four.tolist() == [2**24, -(2**25), 2**26, -(2**26)]
    assert (decode(steps, offsets) == positions).all()


def test_falling_snow_takes_one_byte_a_coordinate_and_its_first_two_rows_more():
    positions, offsets = falling()
    steps = encode(positions, offsets)
    assert steps.one.nbytes == positions.size
    assert len(steps.two) <= 2 * 3 * (len(offsets) - 1)
    assert len(steps.four) <= 3 * (len(offsets) - 1)


def test_a_ballistic_droplet_takes_three_bytes_where_it_accelerates():
    t = np.arange(25)[:, None] / 25.0
    positions = (t * [0.5, 0, 3.0] - 0.5 * 9.81 * t**2 * [0, 0, 1]).astype(np.float32)
    steps = encode(positions, np.array([0, 25]))
    # 9.81 m/s^2 in a frame of 0.04 s is 257 quanta: each row along z but the first, and the second along x.
    assert len(steps.two) == 24 + 1 and len(steps.four) == 0


def test_nothing_is_a_history_too():
    for offsets in (np.array([0]), np.array([0, 0, 0])):
        assert decode(encode(np.zeros((0, 3), np.float32), offsets), offsets).shape == (0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("work", [encode, quantised])
def test_what_is_not_finite_is_refused_by_name(bad, work):
    positions, offsets = np.ones((5, 3), np.float32), np.array([0, 2, 2, 5])
    positions[2, 2] = bad
    with pytest.raises(ValueError, match=r"of particle 2 are not finite 0 frames after its birth: \[1.0, 1.0, -?(nan|inf)"):
        work(positions, offsets)


def test_other_types_and_offsets_are_refused():
    positions = np.ones((5, 3), np.float32)
    with pytest.raises(ValueError, match="must be float32, found float64"):
        encode(positions.astype(np.float64), np.array([0, 5]))
    for offsets in ([0, 4], [1, 5], [0, 6], [0, 7, 5]):
        with pytest.raises(ValueError, match="offsets must ascend from 0 to 5"):
            encode(positions, np.array(offsets))
        with pytest.raises(ValueError, match="offsets must ascend from 0 to 5"):
            decode(Steps(np.zeros(15, np.int8), np.zeros(0, np.int16), np.zeros(0, np.int32), -14), np.array(offsets))
    with pytest.raises(ValueError, match="offsets must ascend from 0 to 5, found none"):
        encode(positions, np.zeros(0, np.int64))


def test_steps_that_lack_a_number_are_refused():
    positions, offsets = wandering(50.0)
    steps = encode(positions, offsets)
    for name in ("two", "four"):
        with pytest.raises(ValueError, match=rf"must come with {len(steps.two)} of two and \d+ of four bytes"):
            decode(steps._replace(**{name: np.append(getattr(steps, name), getattr(steps, name).dtype.type(1))}), offsets)
    with pytest.raises(ValueError, match="1 steps, a multiple of 3"):
        decode(Steps(np.zeros(1, np.int8), np.zeros(0, np.int16), np.zeros(0, np.int32), -14), np.array([0]))
