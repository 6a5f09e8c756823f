"""Figures of the room rendering: the CPU rasterizer beside its float64 judge; rasterizer.py measures what a frame costs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows.coverage import by_distance
from pgsd_nerfstudio.laboratory.rows.rasterizer import bench, leaves, psnr
from pgsd_nerfstudio.laboratory.yard import view_into_yard, yard_flakes
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.motion_blur import determinants
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig, Rendering
from pgsd_nerfstudio.rendering.reference import certain_pixels, project_reference, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors

_JUDGE = "float64 torch reference, pixels whose decisions do not hang on single precision"
_SIZES = ((96, 64), (192, 128), (384, 256), (960, 640))
_NAMES = ["means", "quats", "scales", "opacities", "colors"]

__all__ = ["bench", "verify"]


def verify(quick: bool) -> list[Record]:
    """The CPU rasterizer against the reference, the reference against gsplat, and what must hold to the last bit."""
    seeds = range(2 if quick else 10)
    return [
        *_against_the_reference(seeds),
        _merged_exactly(seeds),
        *_coverage(quick),
        *by_distance(quick),
        *_against_gsplat_formulas(),
        _against_gsplat_on_cuda(),
        _names_what_is_not_finite(),
    ]


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


def _coverage(quick: bool) -> Iterator[Record]:
    """Share of a picture that flying particles cover, at four sizes of the same picture, against the sum of their areas.

    The optical depth of a pixel is on average the sum of all areas 2 pi opacity sqrt(det S) over that of the picture, S the
    covariance on the image plane without the blur of a pixel.
    """
    flakes = yard_flakes(100_000 if quick else 400_000)
    sharp, moves = 0.3 * flakes.scales, torch.tensor([0.02, 0.0, -0.03]).expand(len(flakes), 3)
    still = replace(flakes, scales=sharp, antialiased=True, whole=True)
    gsplat = RasterConfig(faint_alpha=RasterConfig().min_alpha)
    cases = {
        "flakes": (still, RasterConfig()),
        "streaks": (replace(still, displacements=moves), RasterConfig()),
        "flakes, the threshold of gsplat": (still, gsplat),
        "flakes, classic": (replace(still, antialiased=False, whole=False), RasterConfig()),
    }
    for name, (one, config) in cases.items():
        found, expected = zip(*(_covered(one, size, config) for size in _SIZES), strict=True)
        worst = 100 * max(abs(a / b - 1) for a, b in zip(found, expected, strict=True))
        shares = ", ".join(f"{100 * share:.2f} % at {w}x{h}" for share, (w, h) in zip(found, _SIZES, strict=True))
        source = f"{shares}; the sum of the areas is {100 * expected[-1]:.2f} %"
        if one.whole:
            yield Record.judged(f"coverage at 96x64 to 960x640, {name}", worst, "% off, worst", "<= 15", source=source)
        else:
            yield Record(f"coverage at 96x64 to 960x640, {name}", worst, "% off, worst", source=source)


def _covered(flakes: Gaussians, size: tuple[int, int], config: RasterConfig) -> tuple[float, float]:
    """Mean alpha of a picture without its outer tenth, and what Beer-Lambert says of the areas there."""
    cameras = view_into_yard(*size)
    width, height = size
    alpha = CpuRasterizer(Gaussians.empty(), config=config).render(cameras, flakes).accumulation[0]
    exact, view = flakes.to(torch.float64), cameras.viewmats[0].double()
    fine = replace(config, blur=1e-12)
    areas = project_reference(replace(exact, displacements=None, whole=False), view, cameras.Ks[0].double(), *size, fine)
    x, y = areas.centers.unbind(1)
    low = torch.tensor([0.1 * width, 0.1 * height])
    inside = (x > low[0]) & (x < width - low[0]) & (y > low[1]) & (y < height - low[1])
    inside &= (exact.means @ view[:3, :3].T + view[:3, 3])[:, 2] >= config.near
    shadows = 2 * math.pi * exact.opacities * determinants(areas.covariances).clamp_min(0).sqrt()
    depth = shadows[inside].sum() / (0.64 * width * height)
    rows, columns = round(0.1 * height), round(0.1 * width)
    return float(alpha[rows : height - rows, columns : width - columns].mean()), float(1 - torch.exp(-depth))


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
        Record.judged(
            "radii that differ from gsplat's",
            (found.radii != radii[0, :, None]).any(dim=1).sum().item(),
            "",
            "<= 0",
            source=source,
        ),
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
    return Record.judged(name, psnr(own.rgb, peer.rgb.cpu()), "dB", target, source="gsplat 1.4.0, 4,000 Gaussians")


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


def _frame_and_leaf(cameras: Cameras, frozen: Gaussians, dynamic: Gaussians, judge: bool) -> tuple[Rendering, Gaussians]:
    """A picture by the judge or by the CPU rasterizer, and the dynamic set that its gradients go to."""
    dtype = torch.float64 if judge else torch.float32
    leaf = leaves(dynamic, dtype)
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
