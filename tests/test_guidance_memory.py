"""The count of bytes against sums done by hand, and against what PyTorch's profiler saw the CPU's allocator do."""

import gc
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.checkpoint import checkpoint

from pgsd_nerfstudio.guidance.memory import MemoryMeter, weights
from pgsd_nerfstudio.laboratory.rows.prior_costs import rows
from pgsd_nerfstudio.laboratory.tiny_cogvideox import tiny_models

N = 1000
BYTES = 4 * N


def test_without_a_graph_two_neighbours_of_a_chain_live_at_once():
    x = torch.rand(N)
    with MemoryMeter() as meter, torch.no_grad():
        for _ in range(5):
            x = x.exp()
    assert (meter.peak, meter.live) == (2 * BYTES, BYTES)


def test_with_a_graph_every_saved_tensor_of_a_chain_lives_until_the_graph_is_gone():
    x = torch.rand(N, requires_grad=True)
    with MemoryMeter() as meter:
        y = x
        for _ in range(5):
            y = y.exp()  # exp saves its result
        assert (meter.peak, meter.live) == (5 * BYTES, 5 * BYTES)
        del y
        assert meter.live == 0


def test_views_and_writing_in_place_cost_nothing():
    with MemoryMeter() as meter:
        x = torch.ones(N)
        y = x.view(10, -1).transpose(0, 1)[3:]
        x.mul_(2).add_(1)
        assert (meter.peak, meter.live) == (BYTES, BYTES)
        del x
        assert meter.live == BYTES  # the view keeps the storage
        del y
        assert meter.live == 0


def test_a_tensor_made_before_counts_only_when_it_is_held_and_then_once():
    linear = torch.nn.Linear(100, 50).half()
    with MemoryMeter() as meter:
        assert meter.hold(weights(linear)) == 2 * (100 * 50 + 50)
        assert meter.hold(weights(linear)) == 0
        assert meter.live == meter.peak == 2 * (100 * 50 + 50)


def test_checkpointing_keeps_the_input_and_recomputes_one_segment_at_a_time():
    def segment(x):
        return x.exp().exp().exp()

    def peaks(run):
        x = torch.rand(N, requires_grad=True)
        with MemoryMeter() as meter:
            y = x
            for _ in range(4):
                y = run(y)
            after = meter.live
            torch.autograd.grad(y.sum(), x)
        return after // BYTES, meter.peak // BYTES

    # 12 results are saved, the last of them also has a name here and outlives its node: at the second node two gradients
    # stand beside all 12.
    assert peaks(segment) == (12, 14)
    # The ends of 4 segments. The last segment's 3 results are made again; its first node adds a gradient, its second another
    # where the first result is gone.
    assert peaks(lambda x: checkpoint(segment, x, use_reentrant=False)) == (4, 4 + 3 + 1)


def test_phases_keep_their_own_peaks():
    with MemoryMeter() as meter:
        with meter.phase("two"):
            kept = torch.ones(N) + 1
        with meter.phase("four"):
            _ = [kept + 1 for _ in range(3)]
        del _
        with meter.phase("again two"):
            kept = kept + 1
    assert {name: size // BYTES for name, size in meter.phases.items()} == {"two": 2, "four": 4, "again two": 2}


def allocator_peak(step):
    """Most bytes the CPU's allocator had given out during a step beyond what it had before."""
    gc.collect()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        step()
    assert profile.profiler is not None and profile.profiler.kineto_results is not None
    events: list[Any] = [e for e in profile.profiler.kineto_results.events() if e.name() == "[memory]"]
    sizes = [e.nbytes() for e in sorted(events, key=lambda e: e.start_ns())]
    assert sizes
    return max(torch.tensor(sizes).cumsum(0).tolist())


@pytest.mark.parametrize("checkpointed", [False, True])
def test_count_is_what_the_allocator_gave_out(checkpointed):
    layers = [torch.nn.Sequential(torch.nn.Linear(64, 256), torch.nn.GELU(), torch.nn.Linear(256, 64)) for _ in range(6)]
    for layer in layers:
        layer.requires_grad_(False)
    x = torch.rand(512, 64, requires_grad=True)

    def step():
        y = x
        for layer in layers:
            # Without keeping the state of the random generator, whose 5 kB a segment are made outside of any operator.
            y = checkpoint(layer, y, use_reentrant=False, preserve_rng_state=False) if checkpointed else layer(y)
        torch.autograd.grad(y.square().sum(), x)

    step()
    truth = allocator_peak(step)
    with MemoryMeter() as meter:
        step()
    assert meter.peak == pytest.approx(truth, rel=1e-4)


@pytest.mark.parametrize("checkpointed", [False, True])
def test_fake_tensors_count_as_real_ones_do(checkpointed):
    def count():
        _, vae = tiny_models()
        if checkpointed:
            vae.enable_gradient_checkpointing()
        clip = torch.zeros(1, 3, 9, 32, 48, requires_grad=True)
        with MemoryMeter() as meter:
            meter.hold(weights(vae))
            latents = vae.encode(clip).latent_dist.mode()
            torch.autograd.grad(latents, clip, torch.ones_like(latents))
        return meter.peak

    real = count()
    with FakeTensorMode():
        assert count() == real


def test_a_guidance_step_of_cogvideox_2b_fits_a_card_of_24_gb_with_room_to_spare():
    """Weights by hand: two bytes for each of the published 1.694 + 0.216 billion parameters, and positions in float64."""
    found = {row.name: row for row in rows(quick=True)}
    figures = {name: row.value for name, row in found.items() if row.value is not None}
    transformer, vae, positions = 1_693_783_872, 215_583_907, (226 + 3 * 30 * 45) * 1920
    held = figures["of that, weights of transformer and VAE"]
    assert held == pytest.approx((2 * (transformer + vae) + 8 * positions) / 1e9, rel=1e-9)
    (peak,) = (value for name, value in figures.items() if name.startswith("peak of a guidance step"))
    assert held < figures["held while the guidance pair is evaluated"] < peak <= 20
    # One resnet of the first stage, recomputed: two norms, two activations, two convolutions of 128 channels for every pixel.
    assert peak - held > 6 * 2 * 128 * 9 * 480 * 720 / 1e9
    assert all(row.holds is not False for row in found.values())
