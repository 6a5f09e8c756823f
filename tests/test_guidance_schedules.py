"""Timesteps and weights over the course of training, as the paper's supplement has them."""

import math

import pytest
import torch

from pgsd_nerfstudio.guidance import TimestepSchedule, regularization_scale


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


def test_unknown_weighting_is_refused():
    with pytest.raises(ValueError, match="adaptive or constant, got 'cosine'"):
        regularization_scale("cosine", 1.0)  # type: ignore[arg-type]
