"""Glitter, twinkle and glow: where light goes over time and by view, and that none of it is made up.

References: the mean of the lobe |n.h|^e over the sphere, 1 / (e + 1); the mean of exp(k cos) over a turn, I0(k);
scipy's rotations for where a facet points; the statistics of independent draws for the evenness of the numbers by id.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from dynamics_particles import falling, looks
from scipy.special import i0

from pgsd_nerfstudio.dynamics import DynamicsField, Rollout
from pgsd_nerfstudio.dynamics.in_sight import Eye
from pgsd_nerfstudio.dynamics.sparkle import (
    FAINTER,
    GAIN,
    GATHERED,
    HOT,
    LOBE,
    PULSE,
    SUN,
    TURNS,
    WIDER,
    Sparkle,
    _even,
    _mirrored,
)
from pgsd_nerfstudio.effects.effect import StateLook
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.trial import random_cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians

MANY = torch.arange(40_000)
PLACE = Frame(1.0, torch.eye(3), torch.zeros(3))
UP = (0.0, 0.0, 1.0)


def towards(direction: tuple[float, float, float], count: int = len(MANY)) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(direction), dim=0).expand(count, 3)


def sparkling_roll(sparkle: Sparkle | None, count: int = 3000, size: float = 1.0) -> Rollout:
    history, look = falling(count), looks(count)
    look = replace(look, active=replace(look.active, scales=size * look.active.scales))
    return Rollout(history, look, DynamicsField.for_history(history), sparkle=sparkle)


def camera_in_the_air(seed: int):
    camera = random_cameras(1, 60, 44, seed)
    camera.viewmats[:, :3, 3] = -(camera.viewmats[:, :3, :3] @ torch.tensor([2.0, 2.0, 1.0]))
    return camera, Eye.of(camera, RasterConfig(), PLACE)


def test_what_shines_evenly_has_no_sparkle():
    assert Sparkle.of(StateLook()) is None
    assert Sparkle.of(StateLook(glow=0.5)) == Sparkle(glow=0.5)
    assert Sparkle.of(StateLook(glow=0.5, opacity=None)) == Sparkle(glow=0.5, halo=False)


@pytest.mark.parametrize("direction", [UP, (1.0, 0.0, 0.0), (-0.5, 0.3, -0.8)])
@pytest.mark.parametrize("second", [0.0, 0.37, 12.0])
def test_glitter_keeps_the_mean_light_of_many_particles(direction, second):
    factor = Sparkle(glitter=1.0).brightness(MANY, second, towards(direction))
    # The lobe's variance over the sphere is 1/(2e+1) - 1/(e+1)^2: five standard errors of the mean of so many.
    error = GATHERED * (LOBE + 1) * math.sqrt((1 / (2 * LOBE + 1) - (LOBE + 1) ** -2) / len(MANY))
    assert float(factor.mean()) == pytest.approx(1.0, abs=5 * error)
    assert float(factor.min()) == pytest.approx(1 - GATHERED, abs=1e-3)
    assert float(factor.max()) > 0.9 * (1 + GATHERED * LOBE)
    assert 0.005 < float((factor > 3).float().mean()) < 0.1  # few flash at a time


def test_a_facet_flashes_where_it_mirrors_the_light_to_the_camera():
    """Found by turning a normal about an axis with scipy's rotations, and the mirror's law."""
    from scipy.spatial.transform import Rotation

    which = torch.arange(500)
    heights, around, begins, rates = (_even(which, k).numpy() for k in range(4))
    second, direction = 0.9, np.array([0.6, -0.64, 0.48])
    for k in range(0, 500, 7):
        height, azimuth = 2 * heights[k] - 1, math.tau * around[k]
        axis = np.array([math.sqrt(1 - height**2) * math.cos(azimuth), math.sqrt(1 - height**2) * math.sin(azimuth), height])
        level = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        normal = Rotation.from_rotvec(axis * math.tau * (begins[k] + TURNS * (0.5 + rates[k]) * second)).apply(level)
        mirrored = 2 * (normal @ SUN) * normal - SUN  # the way of light from the sun after the mirror
        # The half vector lies as far from the normal as half of what the mirrored ray misses the camera by, in their plane.
        half = (direction + SUN) / np.linalg.norm(direction + SUN)
        found = float(_mirrored(which[k : k + 1], second, torch.from_numpy(direction).float()[None]))
        assert found == pytest.approx(abs(normal @ half) ** LOBE, rel=1e-3, abs=1e-6)
        if found > 0.5:
            assert mirrored @ direction > math.cos(math.radians(24))


def test_other_views_and_other_seconds_see_other_flashes():
    sparkle = Sparkle(glitter=0.7)
    first, again, later, beside = (
        sparkle.brightness(MANY, second, towards(direction)) > 3
        for second, direction in ((1.0, UP), (1.0, UP), (1.3, UP), (1.0, (1.0, 0.0, 0.3)))
    )
    assert torch.equal(first, again)
    for other in (later, beside):
        assert int((first & other).sum()) < 0.3 * int(first.sum())


def test_a_pulse_has_the_mean_of_a_steady_light():
    ids = torch.arange(50)
    rate = 1.5 * (0.7 + 0.6 * _even(ids, 4))
    steps = 64
    for k in range(0, 50, 9):  # over one whole period of each
        seconds = [j / steps / float(rate[k]) for j in range(steps)]
        light = [float(Sparkle(twinkle_hertz=1.5).brightness(ids[k : k + 1], s, towards(UP, 1))) for s in seconds]
        assert np.mean(light) == pytest.approx(1.0, abs=1e-4)
        assert max(light) == pytest.approx(math.exp(PULSE) / i0(PULSE), rel=0.01)
        assert min(light) == pytest.approx(math.exp(-PULSE) / i0(PULSE), rel=0.01)
    assert float(rate.min()) > 1.0 and float(rate.max()) < 2.0 and float(rate.std()) > 0.2


def test_pulses_are_each_their_own():
    light = torch.stack([Sparkle(twinkle_hertz=1.0).brightness(MANY[:2000], s, towards(UP, 2000)) for s in (0.0, 0.5, 5.0)])
    assert light.mean(1).tolist() == pytest.approx([1.0] * 3, abs=0.05)
    assert float(light.std(1).min()) > 0.8


@pytest.mark.parametrize(("one", "other"), [*combinations(range(6), 2)])
def test_numbers_by_id_are_even_and_independent(one, other):
    a, b = (_even(MANY, which).numpy() for which in (one, other))
    counts, _, _ = np.histogram2d(a, b, bins=10, range=[[0, 1], [0, 1]])
    assert abs(counts / (len(MANY) / 100) - 1).max() < 0.1  # independent draws would give 0.05 as a standard deviation


@pytest.fixture(scope="module")
def eye() -> Eye:
    return camera_in_the_air(1)[1]


@pytest.fixture(scope="module")
def plain() -> Rollout:
    return sparkling_roll(None)


def test_without_sparkle_no_bit_changes(plain, eye):
    even = sparkling_roll(Sparkle())  # nothing asked of it
    assert torch.equal(plain.gaussians(7, eye=eye).colors, even.gaussians(7, eye=eye).colors)
    # Without a camera there is nobody for whom to sparkle.
    assert torch.equal(sparkling_roll(Sparkle(glitter=1.0)).gaussians(7).colors, plain.gaussians(7).colors)


def test_active_particles_glow_and_have_a_halo_and_landed_ones_do_not(plain, eye):
    everyone = torch.ones(3000, dtype=torch.bool)
    before, lit = plain.gaussians(20, everyone, eye), sparkling_roll(Sparkle(glow=0.5)).gaussians(20, everyone, eye)
    flying, resting = len(plain.history.active(20)), len(plain.history.resting(20))
    assert len(lit) == 2 * flying + resting == len(before) + flying and flying > 100 < resting
    body, halo = (lit.select(torch.arange(start, start + flying)) for start in (0, flying + resting))
    own = linear(before.colors[:flying])
    torch.testing.assert_close(body.colors, encoded((own + 0.5 * HOT * (1 - own)) * (1 + 0.5 * GAIN)))
    torch.testing.assert_close(halo.colors, encoded(own * (1 + 0.5 * GAIN)))
    assert torch.equal(lit.colors[flying : flying + resting], before.colors[flying:])
    assert torch.equal(halo.scales, WIDER * body.scales) and torch.equal(halo.opacities, 0.5 * FAINTER * body.opacities)
    assert torch.equal(halo.means, body.means) and torch.equal(body.opacities, before.opacities[:flying])


@pytest.mark.parametrize("sparkle", [Sparkle(glow=1.0, twinkle_hertz=1.0), Sparkle(glitter=1.0)])
def test_pictures_of_what_is_in_sight_are_those_of_all(sparkle):
    """Halos reach into the picture from particles that do not."""
    roll, scene = sparkling_roll(sparkle, size=10.0), CpuRasterizer(Gaussians.empty())
    for seed in range(4):
        camera, eye = camera_in_the_air(seed)
        seen = roll.gaussians(4 * seed + 3, eye=eye)
        everything = roll.gaussians(4 * seed + 3, torch.ones(3000, dtype=torch.bool), eye)
        assert len(seen) < len(everything)
        for found, expected in zip(scene.render(camera, seen), scene.render(camera, everything), strict=True):
            # Vectors of other lengths are rounded otherwise.
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
