"""The CPU rasterizer draws what the float64 reference draws, and its savings change nothing."""

from __future__ import annotations

import doctest
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.rendering import choose_rasterizer
from pgsd_nerfstudio.rendering.binning import Binned
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rendering
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

EXACT = 2e-5


def assert_same_picture(cameras: Cameras, found: Rendering, sets: list[Gaussians], background: torch.Tensor | None = None):
    expected = render_reference(cameras, sets, background)
    sure = certain_pixels(cameras, sets)
    assert sure.float().mean() > 0.99  # otherwise this compares nothing
    assert (found.rgb - expected.rgb)[sure].abs().max() < EXACT
    assert (found.accumulation - expected.accumulation)[sure].abs().max() < EXACT
    assert ((found.depth - expected.depth)[sure].abs() / expected.depth[sure].clamp_min(1.0)).max() < EXACT


@pytest.mark.parametrize(("width", "height"), [(48, 40), (33, 17), (16, 16), (7, 50), (1, 1)])
def test_picture_equals_the_reference_at_any_size(width, height):
    cameras, frozen, dynamic = random_cameras(2, width, height), random_gaussians(200, 1), random_gaussians(100, 2)
    background = torch.tensor([0.2, 0.5, 0.9])
    found = CpuRasterizer(frozen).render(cameras, dynamic, background)
    assert found.rgb.shape == (2, height, width, 3)
    assert found.depth.shape == found.accumulation.shape == (2, height, width)
    assert found.rgb.dtype == found.depth.dtype == torch.float32
    assert_same_picture(cameras, found, [frozen, dynamic], background)


@pytest.mark.parametrize("opacity", [0.05, 0.4, 1.0])
@pytest.mark.parametrize("size", [0.01, 0.6])
def test_picture_equals_the_reference_from_mist_to_walls(size, opacity):
    cameras = random_cameras(1, 48, 40)
    frozen, dynamic = (random_gaussians(150, seed, size=size, opacity=opacity) for seed in (3, 4))
    assert_same_picture(cameras, CpuRasterizer(frozen).render(cameras, dynamic), [frozen, dynamic])


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_frozen_harmonics_are_seen_from_the_camera(degree):
    cameras, frozen, dynamic = random_cameras(2, 40, 24), random_gaussians(150, 5, degree=degree), random_gaussians(30, 6)
    assert_same_picture(cameras, CpuRasterizer(frozen).render(cameras, dynamic), [frozen, dynamic])


def test_long_thin_splats_keep_their_edge():
    """A needle across the diagonal: the usual quadratic form in single precision is off by a percent here."""
    n = 20
    angle = torch.linspace(0.2, 1.4, n)
    quats = torch.stack([(angle / 2).cos(), torch.zeros(n), torch.zeros(n), (angle / 2).sin()], dim=-1)
    means = torch.stack([torch.linspace(-1, 1, n), torch.zeros(n), torch.full((n,), 3.0)], dim=-1)
    needles = Gaussians(means, quats, torch.tensor([3.0, 1e-4, 1e-4]).repeat(n, 1), torch.full((n,), 0.9), torch.rand(n, 3))
    cameras = random_cameras(1, 128, 96)
    found = CpuRasterizer(Gaussians.empty()).render(cameras, needles)
    assert_same_picture(cameras, found, [needles])


def test_frozen_and_dynamic_merge_to_the_last_bit():
    cameras, frozen, dynamic = random_cameras(3, 50, 34), random_gaussians(400, 7), random_gaussians(300, 8)
    merged = CpuRasterizer(frozen).render(cameras, dynamic)
    for one in (
        CpuRasterizer(concatenate([frozen, dynamic])).render(cameras),
        CpuRasterizer(Gaussians.empty()).render(cameras, concatenate([frozen, dynamic])),
    ):
        for name in Rendering._fields:
            assert torch.equal(getattr(merged, name), getattr(one, name)), name


def test_dropping_what_opaque_walls_hide_changes_no_bit():
    wall = random_gaussians(60, 9, size=1.0)
    wall = replace(wall, opacities=torch.full((60,), 0.99), means=wall.means + torch.tensor([0.0, 0.0, 1.0]))
    frozen, dynamic = concatenate([wall, random_gaussians(400, 10)]), random_gaussians(100, 11, opacity=0.5)
    cameras = random_cameras(1, 64, 48)
    rasterizer = CpuRasterizer(frozen)
    found = rasterizer.render(cameras, dynamic)
    everything = CpuRasterizer(Gaussians.empty()).render(cameras, concatenate([frozen, dynamic]))
    _, view = rasterizer.views.get(cameras.viewmats[0], cameras.Ks[0], 64, 48)
    assert isinstance(view.part, Binned) and len(view.part.splats) < 0.7 * len(frozen)  # otherwise nothing was dropped
    assert torch.equal(found.rgb, everything.rgb)


@pytest.mark.parametrize("moving", [0, 3, 200])
def test_what_is_shown_once_is_blended_at_once_and_has_the_bits_of_what_is_shown_again(moving):
    """The frozen scene is blended alone for the second picture; a picture with gradient, or of layers, wants that at once."""
    wall = random_gaussians(60, 9, size=1.0)
    frozen = concatenate([replace(wall, means=wall.means + torch.tensor([0.0, 0.0, 1.0])), random_gaussians(400, 10)])
    cameras, dynamic = random_cameras(1, 70, 50), random_gaussians(moving, 11)
    rasterizer = CpuRasterizer(frozen)
    clips, sizes = [], []
    for _ in range(3):
        clips.append(rasterizer.render(cameras, dynamic))
        sizes.append(rasterizer.views.nbytes)
    for again in clips[1:]:
        for name in Rendering._fields:
            assert torch.equal(getattr(clips[0], name), getattr(again, name)), name
    assert sizes[0] != sizes[1] or not moving
    assert sizes[1] == sizes[2]
    leaf = replace(dynamic, opacities=dynamic.opacities.clone().requires_grad_())
    for other in (CpuRasterizer(frozen), CpuRasterizer(frozen, layers=4)):
        other.render(cameras, leaf)
        kept = other.views.nbytes
        other.render(cameras, leaf)
        assert kept == other.views.nbytes


def test_each_camera_has_its_own_dynamic_set():
    cameras, frozen = random_cameras(2, 32, 32), random_gaussians(50, 12)
    first, second = random_gaussians(30, 13), random_gaussians(45, 14)
    rasterizer = CpuRasterizer(frozen)
    clip = rasterizer.render(cameras, [first, second])
    assert torch.equal(clip.rgb[0], rasterizer.render(cameras[0], first).rgb[0])
    assert torch.equal(clip.rgb[1], rasterizer.render(cameras[1], second).rgb[0])


def test_no_dynamic_gaussians_is_the_frozen_scene():
    cameras, frozen = random_cameras(2, 32, 24), random_gaussians(80, 15)
    rasterizer = CpuRasterizer(frozen)
    alone = rasterizer.render(cameras)
    assert_same_picture(cameras, alone, [frozen])
    assert torch.equal(alone.rgb, rasterizer.render(cameras, Gaussians.empty()).rgb)
    assert torch.equal(alone.rgb, rasterizer.render(cameras, [Gaussians.empty()] * 2).rgb)
    behind = replace(random_gaussians(10, 16), means=torch.tensor([0.0, 0.0, -50.0]).repeat(10, 1))
    assert torch.equal(alone.rgb, rasterizer.render(cameras, behind).rgb)


def test_nothing_at_all_is_background():
    background = torch.tensor([0.1, 0.2, 0.3])
    clip = CpuRasterizer(Gaussians.empty()).render(random_cameras(1, 20, 10), None, background)
    assert torch.equal(clip.rgb, background.expand(1, 10, 20, 3))
    assert clip.depth.abs().max() == 0 and clip.accumulation.abs().max() == 0


def test_a_picture_may_be_altered_without_altering_the_next():
    cameras, rasterizer = random_cameras(1, 32, 24), CpuRasterizer(random_gaussians(80, 15))
    first = rasterizer.render(cameras)
    kept = first.rgb.clone()
    first.rgb.zero_()
    assert torch.equal(rasterizer.render(cameras).rgb, kept)


def test_views_are_forgotten_beyond_the_allowed_memory():
    cameras, frozen, dynamic = random_cameras(6, 32, 32), random_gaussians(200, 17), random_gaussians(50, 18)
    generous = CpuRasterizer(frozen)
    expected = generous.render(cameras, dynamic).rgb
    assert len(generous.views) == 6
    allowed = generous.views.nbytes // 3
    frugal = CpuRasterizer(frozen, cache_bytes=allowed)
    assert torch.equal(frugal.render(cameras, dynamic).rgb, expected)
    assert 0 < frugal.views.nbytes <= allowed
    assert 1 <= len(frugal.views) < 6
    none = CpuRasterizer(frozen, cache_bytes=0)
    assert torch.equal(none.render(cameras, dynamic).rgb, expected)
    assert none.views.nbytes == len(none.views) == 0


def test_several_python_threads_may_render():
    cameras, frozen = random_cameras(8, 40, 40), random_gaussians(150, 19)
    dynamic = [random_gaussians(60, seed) for seed in range(8)]
    expected = CpuRasterizer(frozen).render(cameras, dynamic).rgb
    rasterizer = CpuRasterizer(frozen)
    with ThreadPoolExecutor(4) as threads:
        clips = list(threads.map(lambda k: rasterizer.render(cameras[k], dynamic[k]).rgb[0], range(8)))
    assert torch.equal(torch.stack(clips), expected)


def test_threads_prepare_views_one_after_the_other(monkeypatch):
    rasterizer, inside, most = CpuRasterizer(random_gaussians(20)), [], []
    make = rasterizer.views._blended

    def slow(binned, view):
        inside.append(view)
        most.append(len(inside))
        time.sleep(0.05)
        inside.pop()
        return make(binned, view)

    monkeypatch.setattr(rasterizer.views, "_blended", slow)
    cameras = random_cameras(1, 16, 16)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda _: rasterizer.render(cameras), range(4)))
    assert most == [1]  # and the later three found the first one's view


def test_the_same_camera_in_another_size_is_another_view():
    cameras, rasterizer = random_cameras(1, 32, 24), CpuRasterizer(random_gaussians(80, 15))
    assert rasterizer.render(cameras).rgb.shape == (1, 24, 32, 3)
    wider = Cameras(cameras.viewmats, cameras.Ks, 48, 24)
    assert torch.equal(rasterizer.render(wider).rgb, CpuRasterizer(rasterizer.frozen).render(wider).rgb)


def test_a_quaternion_of_zero_is_no_rotation():
    gaussians = replace(random_gaussians(20, 21), quats=torch.zeros(20, 4))
    upright = replace(gaussians, quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(20, 1))
    cameras = random_cameras(1, 32, 32)
    assert torch.equal(CpuRasterizer(gaussians).render(cameras).rgb, CpuRasterizer(upright).render(cameras).rgb)


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "colors"])
def test_a_nan_is_refused_by_name(field):
    broken = random_gaussians(5, 20)
    getattr(broken, field).view(-1)[1] = float("nan")
    with pytest.raises(ValueError, match=field):
        CpuRasterizer(broken)
    with pytest.raises(ValueError, match=field):
        CpuRasterizer(random_gaussians(5)).render(random_cameras(1, 16, 16), broken)


def test_the_example_of_the_room_runs():
    import pgsd_nerfstudio.rendering as room

    found = doctest.testmod(room)
    assert found.attempted >= 5 and found.failed == 0


def test_wrong_input_is_refused():
    rasterizer, cameras = choose_rasterizer(random_gaussians(5), "cpu"), random_cameras(2, 16, 16)
    with pytest.raises(ValueError, match="2 cameras, found 3"):
        rasterizer.render(cameras, [random_gaussians(5)] * 3)
    with pytest.raises(ValueError, match="at least one layer"):
        CpuRasterizer(random_gaussians(5), layers=0)
    cameras.viewmats[1, 0, 0] = float("inf")
    with pytest.raises(ValueError, match="viewmats"):
        rasterizer.render(cameras)
    with pytest.raises(ValueError, match="meta"):
        choose_rasterizer(Gaussians.empty(), "meta")
