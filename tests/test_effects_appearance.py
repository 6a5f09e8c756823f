"""The initial look: sizes from physics, volume from water, variation, growth."""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import RAINFALL, SNOWFALL, InitialLook, StateLook, initial_look
from pgsd_nerfstudio.effects.appearance import REACH
from pgsd_nerfstudio.effects.snowfall import mass


@dataclass
class Landed:
    """2000 flakes of 2-11 mm, all landed in frame 9, a third of them near an edge."""

    ends = torch.full((2000,), 10, dtype=torch.int32)
    diameters = torch.linspace(0.002, 0.011, 2000)
    represents = torch.linspace(40.0, 5.0, 2000)
    rest_extents = torch.where(torch.arange(2000) % 3 == 0, 0.02, 1.0)
    fps = 25.0

    def __len__(self) -> int:
        return 2000


@pytest.fixture(scope="module")
def look() -> InitialLook:
    return initial_look(SNOWFALL, Landed())


def test_the_same_seed_gives_the_same_look(look):
    again, other = initial_look(SNOWFALL, Landed()), initial_look(SNOWFALL, Landed(), seed=1)
    assert torch.equal(look.active.scales, again.active.scales)
    assert torch.equal(look.collided.rgb, again.collided.rgb)
    assert not torch.equal(look.active.opacity, other.active.opacity)


def test_a_flake_is_about_as_large_as_its_diameter(look):
    ratio = look.active.scales[:, 0] / Landed.diameters
    assert ratio.median() == pytest.approx(0.34, rel=0.05)


@pytest.mark.parametrize(
    ("effect", "area"),
    [(SNOWFALL, lambda d: 1e-4 * 0.2285 * (100 * d) ** 1.88), (RAINFALL, lambda d: math.pi / 4 * d**2)],
    ids=["snow: Mitchell 1996, table 1", "rain: discs"],
)
@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_what_flies_covers_its_own_area_times_the_legibility(effect, area, factor):
    """The sum of alpha of a Gaussian, 2 pi opacity sqrt(det S), over all directions from which it may be seen."""

    class Many(Landed):
        diameters = torch.full((400,), 0.003)
        ends, represents, rest_extents = torch.full((400,), 5), torch.ones(400), torch.full((400,), 0.1)

        def __len__(self) -> int:
            return 400

    effect = replace(effect, appearance=replace(effect.appearance, legibility=factor))
    look = initial_look(effect, Many()).active
    rng = np.random.default_rng(0)
    towards = torch.from_numpy(rng.normal(size=(2000, 3)))
    towards = towards / towards.norm(dim=1, keepdim=True)
    a, b, c = (look.scales.double() ** 2).mean(0)
    # det of the projected covariance along n is n^T adj(Sigma) n.
    seen = (towards**2 * torch.stack([b * c, a * c, a * b])).sum(1).sqrt().mean()
    covered = 2 * math.pi * float(look.opacity.double().mean() * seen)
    assert covered == pytest.approx(factor * area(0.003), rel=0.1)


def test_looks_vary_within_what_snow_can_be(look):
    for state in (look.active, look.collided):
        assert state.opacity.std() > 0.05
        assert 0.05 <= state.opacity.min() <= state.opacity.max() <= 0.98
        assert state.rgb.std(0).min() > 0.01
        assert 0.7 < state.rgb.min() <= state.rgb.max() <= 1.0
        assert (state.scales > 0).all()


def test_patches_have_the_volume_of_the_snow_they_stand_for():
    plain = replace(SNOWFALL.appearance, collided=replace(SNOWFALL.appearance.collided, scale_spread=0.0))
    free = Landed()
    free.rest_extents, free.represents = torch.full((2000,), 10.0), Landed.represents / 15
    scales = initial_look(replace(SNOWFALL, appearance=plain), free).collided.scales
    volume = (2 * np.pi) ** 1.5 * scales.prod(1)
    water = torch.from_numpy(mass(free.diameters.double().numpy())) * free.represents
    torch.testing.assert_close(
        volume.double(), water * SNOWFALL.surface.accumulation_speedup / SNOWFALL.surface.layer_density, rtol=1e-3, atol=0
    )


def test_a_time_lapse_makes_patches_wider_not_thicker():
    thin = replace(SNOWFALL.surface, layer_thickness=0.002)
    faster = replace(thin, accumulation_speedup=4 * thin.accumulation_speedup)
    free = Landed()
    free.rest_extents, free.represents = torch.full((2000,), 10.0), Landed.represents / 200
    plain = replace(SNOWFALL.appearance, collided=replace(SNOWFALL.appearance.collided, scale_spread=0.0))
    flakes = replace(SNOWFALL, appearance=plain)
    slow, fast = (initial_look(replace(flakes, surface=layer), free).collided.scales for layer in (thin, faster))
    torch.testing.assert_close(fast / slow, torch.tensor([2.0, 2.0, 1.0]).expand(2000, 3), rtol=1e-4, atol=0)


def test_no_patch_is_wider_than_two_centimetres(look):
    assert look.collided.scales.max() == pytest.approx(0.02)


def test_no_patch_hangs_over_an_edge(look):
    assert (look.collided.scales[:, :2].amax(1) * REACH <= Landed.rest_extents + 1e-6).all()
    assert (look.collided.scales[:, 2] <= 0.5 * look.collided.scales[:, :2].amin(1) + 1e-6).all()


def test_a_collided_flake_spreads_from_its_flake_to_its_patch(look):
    ids = torch.arange(2000)
    seconds = SNOWFALL.appearance.collided.settle_seconds
    first, middle, last = (look.collided_at(Landed(), f, ids) for f in (10, 10 + int(12.5 * seconds), 10 + int(25 * seconds)))
    assert torch.equal(last.scales, look.collided.scales)
    assert torch.equal(last.opacity, look.collided.opacity)
    assert (first.scales <= middle.scales + 1e-7).all()
    assert (middle.scales <= last.scales + 1e-7).all()
    assert (first.scales[:, 0] < 0.2 * last.scales[:, 0]).float().mean() > 0.5  # no patch pops up


def test_a_look_without_settling_is_there_at_once(look):
    ids = torch.arange(5)
    at_once = replace(look, settle_seconds=0.0)
    assert torch.equal(at_once.collided_at(Landed(), 10, ids).scales, look.collided.scales[:5])


def test_a_given_size_is_used_as_given():
    state = StateLook(scale_m=(0.03, 0.02, 0.004), scale_spread=0.0)
    effect = replace(SNOWFALL, appearance=replace(SNOWFALL.appearance, active=state))
    torch.testing.assert_close(initial_look(effect, Landed()).active.scales[0], torch.tensor([0.03, 0.02, 0.004]))


def test_colourful_particles_have_all_hues_alike_and_the_others_keep_their_bits(look):
    active, collided = (replace(state, colourful=True) for state in (SNOWFALL.appearance.active, SNOWFALL.appearance.collided))
    motley = initial_look(
        replace(SNOWFALL, appearance=replace(SNOWFALL.appearance, active=active, collided=collided)), Landed()
    )
    for found, plain in ((motley.active, look.active), (motley.collided, look.collided)):
        assert torch.equal(found.opacity, plain.opacity) and torch.equal(found.scales, plain.scales)
        hues = [colorsys.rgb_to_hsv(*rgb)[0] for rgb in (found.rgb / plain.rgb).tolist()]
        counts, _ = np.histogram(hues, bins=12, range=(0, 1))
        assert abs(counts - 2000 / 12).max() < 4
