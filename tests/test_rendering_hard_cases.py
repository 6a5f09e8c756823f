"""Input that breaks rasterizers: the CPU rasterizer draws what the float64 reference draws, with its gradients, all finite."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

NEAR = RasterConfig().near


def gaussians(**changes: object) -> Gaussians:
    """Sixty ordinary Gaussians before the camera, some tensors of which are changed: a number fills, a function is applied."""
    tensors = random_gaussians(60, 7, size=0.2).tensors
    tensors["means"] = tensors["means"].abs() * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([-0.8, -0.8, 1.5])
    for name, change in changes.items():
        old = tensors[name]
        tensors[name] = change(old.clone()) if callable(change) else torch.full_like(old, float(change))  # type: ignore[arg-type]
    return Gaussians(**tensors)


def column(values: list[float], axis: int) -> Callable[[torch.Tensor], torch.Tensor]:
    """Sets one coordinate, cycling through the values."""

    def change(old: torch.Tensor) -> torch.Tensor:
        old[:, axis] = torch.tensor(values).repeat(len(old) // len(values) + 1)[: len(old)]
        return old

    return change


def shapes(*axes: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda old: torch.tensor(axes).repeat(len(old), 1)


def moved(length: float) -> Gaussians:
    own = gaussians(scales=0.03)
    way = torch.nn.functional.normalize(torch.randn(len(own), 3, generator=torch.Generator().manual_seed(3)), dim=1)
    return Gaussians(**own.tensors, displacements=length * way)


def stacked() -> Gaussians:
    """Ten thousand faint Gaussians in one pixel."""
    own = random_gaussians(10_000, 8, size=1e-4, opacity=0.02)
    means = torch.tensor([0.013, 0.011, 0.0]).repeat(10_000, 1)
    means[:, 2] = torch.linspace(1.0, 3.0, 10_000)
    return Gaussians(means, own.quats, own.scales, own.opacities, own.colors)


CASES = {
    "around the camera": gaussians(means=lambda m: 0.05 * m, scales=3.0),
    "behind the camera": gaussians(means=column([-0.5, -3.0], 2)),
    "at the near plane": gaussians(means=column([NEAR * 0.999, NEAR * 1.001, NEAR * 3.0], 2), scales=1e-3),
    "needle": gaussians(scales=shapes(1.0, 1e-5, 1e-5)),
    "disc": gaussians(scales=shapes(0.3, 0.3, 1e-6)),
    "no size": gaussians(scales=0.0),
    "opacity 0": gaussians(opacities=0.0),
    "opacity 1": gaussians(opacities=1.0),
    "ten thousand in one pixel": stacked(),
    "equal depths": gaussians(means=column([2.0], 2)),
    "nothing": Gaussians.empty(),
    "quaternions of any length": gaussians(quats=lambda q: q * torch.logspace(-6, 6, len(q))[:, None]),
    "quaternion zero": gaussians(quats=0.0),
    "harmonics": random_gaussians(60, 9, degree=3),
    "fast": moved(1.5),
    "faster than the picture is wide": moved(300.0),
    "does not move": moved(0.0),
    "far": gaussians(means=lambda m: m * 1e5, scales=3e3),
}


def straight(width: int = 40, height: int = 36) -> Cameras:
    K = torch.tensor([[[30.0, 0, 19.0], [0, 32.0, 17.5], [0, 0, 1]]])
    return Cameras(torch.eye(4)[None], K, width, height)


def assert_right(cameras: Cameras, frozen: Gaussians, dynamic: Gaussians, config: RasterConfig, share: float) -> None:
    sets = [one for one in (frozen, dynamic) if len(one)] or [Gaussians.empty()]
    sure = certain_pixels(cameras, sets, config=config)
    assert sure.float().mean() >= share
    found, truth = (
        Gaussians(**{name: tensor.clone().to(dtype).requires_grad_() for name, tensor in dynamic.tensors.items()})
        for dtype in (torch.float32, torch.float64)
    )
    clip = CpuRasterizer(frozen, config=config).render(cameras, found)
    expected = render_reference(cameras, [frozen, truth] if len(frozen) else truth, config=config)
    assert all(torch.isfinite(image).all() for image in clip)
    assert (clip.rgb - expected.rgb)[sure].abs().max() < 5e-5
    assert (clip.accumulation - expected.accumulation)[sure].abs().max() < 5e-5
    assert ((clip.depth - expected.depth).abs() / expected.depth.clamp_min(1.0))[sure].max() < 5e-5
    if not (len(dynamic) and expected.rgb.requires_grad):  # nothing of it is drawn
        assert torch.equal(clip.rgb, CpuRasterizer(frozen, config=config).render(cameras).rgb)
        return
    weights = torch.randn(clip.rgb.shape, generator=torch.Generator().manual_seed(0)) * sure[..., None]
    (clip.rgb * weights).sum().backward()
    (expected.rgb * weights.double()).sum().backward()
    for name, tensor in found.tensors.items():
        own, judged = tensor.grad, getattr(truth, name).grad
        assert torch.isfinite(own).all(), name
        if judged.norm() > 1e-9 * max(1.0, weights.norm().item()):
            assert relative_error(own, judged) < 1e-3, name
        else:
            assert own.norm() < 1e-3, name


@pytest.mark.parametrize("footprint", ["square", "rectangle"])
@pytest.mark.parametrize("case", CASES)
def test_drawn_alone(case: str, footprint: str):
    config = RasterConfig() if footprint == "square" else RasterConfig.of_gsplat("1.5.3")
    # Needles cross a threshold in almost every pixel that they touch.
    assert_right(straight(), Gaussians.empty(), CASES[case], config, 0.9)


@pytest.mark.parametrize("case", CASES)
def test_drawn_within_a_frozen_scene(case: str):
    frozen = random_gaussians(150, 11, size=0.2, degree=None)
    assert_right(straight(), frozen, CASES[case], RasterConfig(), 0.9)


@pytest.mark.parametrize("case", CASES)
def test_finite_within_layers(case: str):
    """The exact picture, since nothing flies inside a layer of a scene that lies far behind."""
    frozen = random_gaussians(150, 11, size=2.0)
    frozen = Gaussians(**{**frozen.tensors, "means": frozen.means + torch.tensor([0.0, 0.0, 1e7])})
    leaf = Gaussians(**{name: tensor.clone().requires_grad_() for name, tensor in CASES[case].tensors.items()})
    clip = CpuRasterizer(frozen, layers=3).render(straight(), leaf)
    assert torch.allclose(clip.rgb, CpuRasterizer(frozen).render(straight(), leaf).rgb, atol=2e-4)
    if len(leaf):
        clip.rgb.sum().backward()
        assert all(torch.isfinite(tensor.grad).all() for tensor in leaf.tensors.values())


def test_one_pixel():
    assert_right(random_cameras(1, 1, 1), random_gaussians(40, 1), random_gaussians(40, 2), RasterConfig(), 1.0)


def test_a_frozen_scene_of_hard_cases():
    every = [case for case in CASES.values() if len(case) and case.colors.ndim == 2 and case.displacements is None]
    frozen = concatenate([one for one in every if len(one) < 1000])
    assert_right(straight(), frozen, random_gaussians(50, 12), RasterConfig(), 0.9)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "displacements"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_a_number_is_named(name: str, value: float):
    tensors = moved(1.0).tensors
    tensors[name].view(-1)[5] = value
    with pytest.raises(ValueError, match=rf"1 values of the Gaussians' {name} are NaN or infinite"):
        CpuRasterizer(Gaussians.empty()).render(straight(), Gaussians(**tensors))
    with pytest.raises(ValueError, match=name):
        CpuRasterizer(Gaussians(**tensors))
