"""Figures of the room rendering: the CPU rasterizer beside its float64 judge, and what a frame costs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import fields, replace

import numba
import torch
from torch import Tensor

from pgsd_nerfstudio.cli.records import Record
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig, Rendering
from pgsd_nerfstudio.rendering.reference import certain_pixels, project_reference, render_reference
from pgsd_nerfstudio.rendering.spherical_harmonics import view_colors
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

_JUDGE = "float64 torch reference, pixels whose decisions do not hang on single precision"
_NAMES = [field.name for field in fields(Gaussians)]


def verify(quick: bool) -> list[Record]:
    """The CPU rasterizer against the reference, the reference against gsplat, and what must hold to the last bit."""
    seeds = range(2 if quick else 10)
    return [
        *_against_the_reference(seeds),
        _merged_exactly(seeds),
        *_against_gsplat_formulas(),
        _against_gsplat_on_cuda(),
        _names_what_is_not_finite(),
    ]


def bench(quick: bool) -> list[Record]:
    """CPU time of a frame of 80,000 frozen and 20,000 dynamic Gaussians."""
    frozen, dynamic = _yard_and_flakes()
    rows = []
    for width, height in ((96, 64), (512, 512)):
        rows += _frame_costs(frozen, dynamic, _into_the_yard(width, height), quick)
    return rows


def _against_the_reference(seeds: range) -> list[Record]:
    picture, gradient = 0.0, dict.fromkeys(_NAMES, 0.0)
    for seed in seeds:
        cameras = random_cameras(1, 48, 40, seed)
        frozen, dynamic = random_gaussians(200, seed, degree=3), random_gaussians(100, seed + 1000)
        certain = certain_pixels(cameras, [frozen, dynamic])
        (found, found_leaf), (expected, leaf) = (_frame_and_leaf(cameras, frozen, dynamic, judge) for judge in (False, True))
        for clip in (found, expected):
            _scalar(clip, certain, seed).backward()
        picture = max(picture, (found.rgb - expected.rgb)[certain].abs().max().item())
        for name in _NAMES:
            error = relative_error(getattr(found_leaf, name).grad, getattr(leaf, name).grad)
            gradient[name] = max(gradient[name], error)
    rows = [Record.judged("picture against reference, largest difference", picture, "", "<= 2e-5", source=_JUDGE)]
    for name, error in gradient.items():
        rows.append(Record.judged(f"gradient of {name}, relative L2", error, "", "<= 1e-4", source=_JUDGE))
    return rows


def _merged_exactly(seeds: range) -> Record:
    worst = 0.0
    for seed in seeds:
        cameras = random_cameras(1, 50, 34, seed)
        frozen, dynamic = random_gaussians(2000, seed), random_gaussians(500, seed + 1000)
        merged = CpuRasterizer(frozen).render(cameras, dynamic)
        together = CpuRasterizer(Gaussians.empty()).render(cameras, concatenate([frozen, dynamic]))
        worst = max(worst, *((a - b).abs().max().item() for a, b in zip(merged, together, strict=True)))
    return Record.judged(
        "frozen and dynamic merged against one set", worst, "", "<= 0", source="the prepared frozen scene saves time, not bits"
    )


def _against_gsplat_formulas() -> list[Record]:
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics

    cameras, gaussians = random_cameras(1, 64, 48), random_gaussians(2000, degree=4, size=0.3).to(torch.float64)
    viewmat, K = cameras.viewmats.double(), cameras.Ks.double()
    covariances, _ = _quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, True, False)
    assert covariances is not None
    radii, _, _, conics, _ = _fully_fused_projection(gaussians.means, covariances, viewmat, K, 64, 48)
    found = project_reference(gaussians, viewmat[0], K[0], 64, 48, RasterConfig())
    drawn = radii[0] > 0
    shape = relative_error(torch.linalg.inv(found.covariances)[drawn][:, [0, 0, 1], [0, 1, 1]], conics[0][drawn])
    directions = gaussians.means - cameras.centers.double()
    colors = (_spherical_harmonics(4, directions, gaussians.colors) + 0.5).clamp_min(0.0)
    light = relative_error(view_colors(gaussians.colors, gaussians.means, viewmat[0]), colors)
    source = "gsplat's own torch formulas, 2,000 Gaussians"
    return [
        Record.judged("radii that differ from gsplat's", (found.radii != radii[0]).sum().item(), "", "<= 0", source=source),
        Record.judged("footprints against gsplat, relative L2", shape, "", "<= 1e-6", source=source),
        Record.judged("harmonics against gsplat, relative L2", light, "", "<= 1e-6", source=source),
    ]


def _against_gsplat_on_cuda() -> Record:
    name, target = "CPU picture against gsplat on CUDA", ">= 60"
    if not torch.cuda.is_available():
        return Record(name, None, "dB", target=target, source="needs a CUDA device, this machine has none")
    from pgsd_nerfstudio.rendering.cuda import GsplatRasterizer

    cameras, frozen, dynamic = random_cameras(2, 200, 120), random_gaussians(3000, 1, degree=3), random_gaussians(1000, 2)
    peer = GsplatRasterizer(frozen.to("cuda")).render(cameras.to("cuda"), dynamic.to("cuda"))
    own = CpuRasterizer(frozen).render(cameras, dynamic)
    return Record.judged(name, _psnr(own.rgb, peer.rgb.cpu()), "dB", target, source="gsplat 1.4.0, 4,000 Gaussians")


def _names_what_is_not_finite() -> Record:
    named, cameras, rasterizer = 0, random_cameras(1, 16, 16), CpuRasterizer(Gaussians.empty())
    for name in _NAMES:
        gaussians = random_gaussians(4)
        broken = replace(gaussians, **{name: torch.full_like(getattr(gaussians, name), math.nan)})
        try:
            rasterizer.render(cameras, broken)
        except ValueError as error:
            named += name in str(error)
    return Record.judged("fields with NaN refused by name", named, "of 5", "== 5", source="bad input gets one clear sentence")


def _frame_costs(frozen: Gaussians, dynamic: Gaussians, cameras: Cameras, quick: bool) -> list[Record]:
    size, tries = f"{cameras.width}x{cameras.height}", 3 if quick else 15
    window = _middle(cameras, 32 if quick else 64)
    psnr, gradient = _errors(frozen, dynamic, window)
    source = (
        "80,000 frozen (SH degree 1), 20,000 dynamic; one thread, least of several; error against the float64 reference on the "
        f"middle {window.width}x{window.height} pixels, the gradients of all parameters as one vector"
    )
    rasterizer, (_, leaf) = CpuRasterizer(frozen), _frame_and_leaf(window, frozen, dynamic, False)
    first = _least(lambda: CpuRasterizer(frozen).render(cameras, dynamic), tries)
    forward = _least(lambda: rasterizer.render(cameras, dynamic), tries)
    both = _least(lambda: _scalar(rasterizer.render(cameras, leaf)).backward(), tries)
    return [
        Record(f"first picture from a camera, {size}", first, "ms CPU", psnr, "dB", source=source),
        Record(f"forward, {size}", forward, "ms CPU", psnr, "dB", source=source),
        Record(f"forward and backward, {size}", both, "ms CPU", gradient, "relative L2", source=source),
    ]


def _errors(frozen: Gaussians, dynamic: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """PSNR of the picture and relative error of the whole gradient against the reference."""
    (found, leaf), (expected, truth) = (_frame_and_leaf(cameras, frozen, dynamic, judge) for judge in (False, True))
    vectors = []
    for clip, gaussians in ((found, leaf), (expected, truth)):
        _scalar(clip).backward()
        vectors.append(torch.cat([getattr(gaussians, name).grad.flatten() for name in _NAMES]))
    return _psnr(found.rgb.detach(), expected.rgb.detach()), relative_error(*vectors)


def _frame_and_leaf(cameras: Cameras, frozen: Gaussians, dynamic: Gaussians, judge: bool) -> tuple[Rendering, Gaussians]:
    """A picture by the judge or by the CPU rasterizer, and the dynamic set that its gradients go to."""
    dtype = torch.float64 if judge else torch.float32
    leaf = Gaussians(*(getattr(dynamic, name).detach().clone().to(dtype).requires_grad_() for name in _NAMES))
    return render_reference(cameras, [frozen, leaf]) if judge else CpuRasterizer(frozen).render(cameras, leaf), leaf


def _scalar(clip: Rendering, where: Tensor | None = None, seed: int = 0) -> Tensor:
    """A random weighting of everything a rendering says, of some pixels or of all."""
    generator = torch.Generator().manual_seed(seed)
    total = clip.rgb.new_zeros(())
    for image in clip:
        weights = torch.randn(image.shape, generator=generator)
        if where is not None:
            weights[~where] = 0.0
        total = total + (image * weights.to(image)).sum()
    return total


def _psnr(found: Tensor, expected: Tensor) -> float:
    return -10.0 * math.log10(max((found.double() - expected.double()).square().mean().item(), 1e-20))


def _least(work: Callable[[], object], tries: int) -> float:
    """Milliseconds of CPU time on one thread, the least of several tries: what others do on the machine only adds."""
    usual = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)  # idle threads spin for a while, which would be counted
    try:
        times = []
        for _ in range(tries):
            began = time.process_time()
            work()
            times.append(time.process_time() - began)
    finally:
        torch.set_num_threads(usual[0])
        numba.set_num_threads(usual[1])
    return 1e3 * min(times)


def _yard_and_flakes() -> tuple[Gaussians, Gaussians]:
    """A floor and four walls of flat opaque Gaussians, and small round ones in the air between; metres, z up."""
    generator = torch.Generator().manual_seed(0)
    n, half, top = 80_000, 4.0, 3.0
    side = torch.arange(n) % 8  # four parts floor, one part each wall
    u, v = 2 * torch.rand(2, n, generator=generator) - 1
    along, up = half * u, top * (v + 1) / 2
    wall = torch.where((side % 2 == 0)[:, None], torch.stack([along, torch.full((n,), half), up], -1), 0.0)
    wall = torch.where((side % 2 == 1)[:, None], torch.stack([torch.full((n,), half), along, up], -1), wall)
    wall[:, :2] *= torch.where(side % 4 < 2, 1.0, -1.0)[:, None]
    floor = torch.stack([along, half * v, torch.zeros(n)], dim=-1)
    means = torch.where((side < 4)[:, None], floor, wall)
    normal = torch.where(side < 4, 2, torch.where(side % 2 == 0, 1, 0))
    scales = 0.03 * torch.exp(0.5 * torch.randn(n, 3, generator=generator))
    scales[torch.arange(n), normal] = 0.003
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    colors = 0.5 * torch.randn(n, 4, 3, generator=generator) * torch.tensor([1.0, 0.1, 0.1, 0.1])[:, None]
    frozen = Gaussians(means, upright.repeat(n, 1), scales, 0.3 + 0.7 * torch.rand(n, generator=generator), colors)
    m = 20_000
    air = (2 * torch.rand(m, 3, generator=generator) - 1) * torch.tensor([half, half, top / 2]) + torch.tensor([0, 0, top / 2])
    flakes = Gaussians(
        air,
        torch.randn(m, 4, generator=generator),
        0.008 * torch.exp(0.3 * torch.randn(m, 3, generator=generator)),
        0.2 + 0.7 * torch.rand(m, generator=generator),
        0.8 + 0.2 * torch.rand(m, 3, generator=generator),
    )
    return frozen, flakes


def _into_the_yard(width: int, height: int) -> Cameras:
    """From eye height at one wall to the other."""
    viewmat = torch.tensor([[[1.0, 0, 0, 0], [0, 0, -1, 1.5], [0, 1, 0, 3.8], [0, 0, 0, 1]]])
    K = torch.tensor([[[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]]])
    return Cameras(viewmat, K, width, height)


def _middle(cameras: Cameras, side: int) -> Cameras:
    """The middle of the image at the same scale."""
    Ks = cameras.Ks.clone()
    Ks[:, 0, 2] -= (cameras.width - side) / 2
    Ks[:, 1, 2] -= (cameras.height - side) / 2
    return Cameras(cameras.viewmats, Ks, side, side)
