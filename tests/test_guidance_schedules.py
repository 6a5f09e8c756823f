"""Timesteps and weights over the course of training, as the paper's supplement has them."""

import itertools
import math

import pytest
import torch

from pgsd_nerfstudio.guidance import TimestepSchedule, WeightDecay, regularization_scale


def test_largest_timestep_falls_linearly_from_980_to_740():
    schedule = TimestepSchedule()
    assert [schedule.t_max(step, 1001) for step in (0, 250, 500, 750, 1000)] == [980, 920, 860, 800, 740]


def test_timesteps_are_uniform_within_the_range():
    schedule, rng = TimestepSchedule(), torch.Generator().manual_seed(0)
    drawn = torch.tensor([schedule.sample(500, 1001, rng) for _ in range(8000)])
    assert drawn.min() >= 20 and drawn.max() <= 860
    assert drawn.min() <= 22 and drawn.max() >= 858
    counts = torch.histc(drawn.float(), bins=8, min=20, max=861)
    assert (counts - 1000).abs().max() < 6 * math.sqrt(1000)


def test_training_of_one_step_and_a_step_past_the_end_are_fine():
    schedule = TimestepSchedule()
    assert schedule.t_max(0, 1) == 980 and schedule.t_max(5000, 1000) == 740


def test_both_ends_of_the_range_are_drawn():
    schedule, rng = TimestepSchedule(t_min=3, t_max_first=5, t_max_last=5), torch.Generator().manual_seed(0)
    assert {schedule.sample(0, 10, rng) for _ in range(100)} == {3, 4, 5}


def test_an_empty_range_is_refused():
    with pytest.raises(ValueError, match="got t_min 800, t_max 980 to 740"):
        TimestepSchedule(t_min=800)


def test_adaptive_weights_follow_the_distillation_loss():
    assert regularization_scale("adaptive", 12.5) == 12.5
    assert regularization_scale("constant", 12.5) == 1.0


@pytest.mark.parametrize("loss", [math.nan, math.inf, -1.0])
def test_a_loss_that_is_no_magnitude_is_refused(loss):
    with pytest.raises(ValueError, match="finite and not negative"):
        regularization_scale("adaptive", loss)


@pytest.mark.parametrize(
    ("weighting", "step", "factor"),
    [
        ("linear", 0, 1e6),
        ("linear", 250, 0.75 * 1e6 + 0.25 * 1e2),
        ("linear", 500, 0.5 * (1e6 + 1e2)),
        ("linear", 1000, 1e2),
        ("cosine", 0, 1e6),
        ("cosine", 250, 1e2 + (1e6 - 1e2) * 0.8535533905932737),  # cos(pi/8)^2
        ("cosine", 500, 0.5 * (1e6 + 1e2)),
        ("cosine", 1000, 1e2),
    ],
)
def test_linear_and_cosine_fall_from_1e6_to_1e2(weighting, step, factor):
    assert regularization_scale(weighting, 7.0, step, 1001) == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize("step", [0, 1, 137, 999])
def test_exponential_is_the_papers_power_of_the_iteration(step):
    assert regularization_scale("exponential", 7.0, step, 1000) == pytest.approx(1e6 * 0.995**step, rel=1e-12)


def test_a_short_training_takes_the_same_course():
    for weighting in ("linear", "exponential", "cosine"):
        long, short = (regularization_scale(weighting, 0.0, half, steps) for half, steps in ((1000, 2001), (50, 101)))
        assert short == pytest.approx(long, rel=0.03)


@pytest.mark.parametrize("weighting", ["linear", "exponential", "cosine"])
def test_fixed_schedules_fall_steadily_whatever_the_prior_says(weighting):
    factors = [regularization_scale(weighting, loss, step, 100) for step, loss in zip(range(100), [0.0, 1e3] * 50, strict=True)]
    assert all(a > b > 0 for a, b in itertools.pairwise(factors))
    assert regularization_scale(weighting, 0.0, 0, 1) > 1e3 and regularization_scale(weighting, 0.0, 5000, 100) <= factors[-1]


def test_a_decay_of_ones_own():
    decay = WeightDecay(first=8.0, last=2.0, rate=0.99)
    assert regularization_scale("linear", 1.0, 10, 11, decay=decay) == 2.0
    assert regularization_scale("cosine", 1.0, 5, 11, decay=decay) == pytest.approx(5.0)
    assert regularization_scale("exponential", 1.0, 1, 10, decay=decay) == pytest.approx(8.0 * 0.99**100)


def test_a_decay_that_rises_or_has_no_rate_is_refused():
    with pytest.raises(ValueError, match="0 <= last <= first, got first 1, last 2"):
        WeightDecay(first=1.0, last=2.0)
    with pytest.raises(ValueError, match=r"must lie in 0-1, got 1\.1"):
        WeightDecay(rate=1.1)


@pytest.mark.parametrize("where", [(None, None), (3, None), (-1, 10), (0, 0)])
def test_fixed_schedules_need_to_know_the_step(where):
    with pytest.raises(ValueError, match="cosine weights need the training step"):
        regularization_scale("cosine", 1.0, *where)


@pytest.mark.mistyped
def test_unknown_weighting_is_refused():
    with pytest.raises(ValueError, match="adaptive, constant, linear, exponential or cosine, got 'cubic'"):
        regularization_scale("cubic", 1.0)  # type: ignore[arg-type]
