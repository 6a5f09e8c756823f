"""gsplat draws what the reference draws; on a GPU all of it, elsewhere what is built around its kernels.

Without a GPU, four functions of gsplat are exchanged for its own torch formulas (projection, tiles) and for a blending that
goes through the sorted lists one by one. What then is not judged are the kernels themselves.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl

from pgsd_nerfstudio.rendering import RasterConfig, choose_rasterizer
from pgsd_nerfstudio.rendering.cuda import GsplatRasterizer
from pgsd_nerfstudio.rendering.isects import Isects, merge
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.gaussians import Gaussians

BACKGROUND = torch.tensor([0.1, 0.4, 0.7])


class OnAnyDevice(GsplatRasterizer):
    @staticmethod
    def _check_device(frozen: Gaussians) -> None:
        pass


@pytest.fixture
def torch_gsplat(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """gsplat without kernels; counts Gaussians projected, found visible and blended, and entries sorted."""
    counts: Counter[str] = Counter()

    def project(means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane, far_plane):
        counts["projected"] += len(means)
        if covars is None:
            full, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, True, False)
        else:
            full = covars[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(1, (3, 3))
        found = _torch_impl._fully_fused_projection(means, full, viewmats, Ks, width, height, eps2d, near_plane, far_plane)
        radii, *rest, _ = found
        # The kernels leave memory as they found it where nothing is drawn.
        hidden = radii == 0
        counts["visible"] += int((~hidden).sum())
        rest = [torch.where(hidden.view(hidden.shape + (1,) * (t.ndim - 2)), torch.nan, t) for t in rest]
        return radii, *rest, None

    def tiles(centers, radii, depths, size, across, down):
        number, ids, rows = _torch_impl._isect_tiles(centers, radii, depths, size, across, down, sort=False)
        ids, order = torch.sort(ids, stable=True)  # like the radix sort of the kernels
        counts["sorted"] += len(ids)
        return number, ids, rows[order]

    def blend(centers, *others):
        counts["blended"] += centers.shape[1]
        return blend_one_by_one(centers, *others)

    monkeypatch.setattr(gsplat, "fully_fused_projection", project)
    monkeypatch.setattr(gsplat, "isect_tiles", tiles)
    monkeypatch.setattr(gsplat, "isect_offset_encode", _torch_impl._isect_offset_encode)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", blend)
    return counts


def blend_one_by_one(centers, conics, features, opacities, width, height, size, offsets, rows):
    """rasterize_to_pixels_fwd.cu for one camera, a tile at a time."""
    bounds = [*offsets.flatten().tolist(), len(rows)]
    image, alphas = torch.zeros(1, height, width, features.shape[-1]), torch.zeros(1, height, width, 1)
    for tile in range(offsets.numel()):
        top, left = (size * n for n in divmod(tile, offsets.shape[2]))
        y, x = torch.meshgrid(
            torch.arange(top, min(top + size, height)), torch.arange(left, min(left + size, width)), indexing="ij"
        )
        light, done = torch.ones(y.shape), torch.zeros(y.shape, dtype=torch.bool)
        total = torch.zeros(*y.shape, features.shape[-1])
        for g in rows[bounds[tile] : bounds[tile + 1]].tolist():
            dx, dy = centers[0, g, 0] - (x + 0.5), centers[0, g, 1] - (y + 0.5)
            a, b, c = conics[0, g]
            sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
            alpha = (opacities[0, g] * torch.exp(-sigma)).clamp_max(0.999)
            taken = (sigma >= 0) & (alpha >= 1 / 255) & ~done
            done = done | (taken & (light * (1 - alpha) <= 1e-4))
            alpha = torch.where(taken & ~done, alpha, 0.0)
            total = total + (alpha * light)[..., None] * features[0, g]
            light = light * (1 - alpha)
        image[0, top : top + size, left : left + size] = total
        alphas[0, top : top + size, left : left + size, 0] = 1 - light
    return image, alphas


def moving_gaussians(n: int, *, degree: int | None, moves: bool) -> Gaussians:
    gaussians = random_gaussians(n, 2, degree=degree)
    if not moves:
        return gaussians
    return replace(gaussians, displacements=0.6 * torch.randn(n, 3, generator=torch.Generator().manual_seed(3)))


def leaf_of(gaussians: Gaussians, dtype: torch.dtype, device: str) -> Gaussians:
    return replace(gaussians, **{n: t.clone().to(device, dtype).requires_grad_() for n, t in gaussians.tensors.items()})


def assert_same_picture_and_gradients(rasterizer: GsplatRasterizer, frozen: Gaussians, dynamic: Gaussians, device: str):
    cameras = random_cameras(2, 40, 36)
    certain = certain_pixels(cameras, [frozen, dynamic], config=rasterizer.config)
    assert certain.float().mean() > 0.98
    clips, gradients = [], []
    for judged in (True, False):
        leaf = leaf_of(dynamic, torch.float32 if judged else torch.float64, device if judged else "cpu")
        background = BACKGROUND.clone().to(device if judged else "cpu").requires_grad_()
        if judged:
            clip = rasterizer.render(cameras.to(device), leaf, background)
        else:
            clip = render_reference(cameras, [frozen, leaf], background, rasterizer.config)
        mask = certain.to(clip.rgb.device)
        (clip.rgb[mask].square().sum() + clip.depth[mask].sum() + clip.accumulation[mask].sum()).backward()
        clips.append([image.detach().cpu() for image in clip])
        gradients.append({"background": background.grad.cpu(), **{n: t.grad.cpu() for n, t in leaf.tensors.items()}})
    for name, tolerance, found, expected in zip(("rgb", "depth", "accumulation"), (1e-4, 1e-3, 1e-4), *clips, strict=True):
        assert (found - expected)[certain].abs().max() < tolerance, name
    for name, expected in gradients[1].items():
        assert relative_error(gradients[0][name], expected) < 1e-3, name


@pytest.mark.parametrize("degree", [None, 2])
@pytest.mark.parametrize("moves", [False, True])
def test_around_the_kernels_picture_and_gradients_are_those_of_the_reference(torch_gsplat, degree, moves):
    frozen, dynamic = random_gaussians(60, 1, degree=1), moving_gaussians(40, degree=degree, moves=moves)
    assert_same_picture_and_gradients(OnAnyDevice(frozen), frozen, dynamic, "cpu")


def test_what_never_moves_is_projected_and_sorted_once_for_each_camera(torch_gsplat):
    cameras, frozen, dynamic = random_cameras(2, 32, 24), random_gaussians(50, 1), random_gaussians(7, 2)
    rasterizer = OnAnyDevice(frozen)
    first = rasterizer.render(cameras, dynamic)
    assert torch_gsplat["projected"] == 2 * (50 + 7)
    prepared = torch_gsplat.copy()
    again = rasterizer.render(cameras, dynamic)
    assert torch_gsplat["projected"] == prepared["projected"] + 2 * 7
    assert torch_gsplat["sorted"] < 1.5 * prepared["sorted"]
    assert torch.equal(first.rgb, again.rgb)


def test_only_what_touches_the_image_is_blended(torch_gsplat):
    OnAnyDevice(random_gaussians(50, 1)).render(random_cameras(1, 32, 24), random_gaussians(40, 2))
    assert torch_gsplat["blended"] == torch_gsplat["visible"]
    assert 10 < torch_gsplat["visible"] < 80


def test_prepared_views_stay_within_their_memory_and_change_nothing(torch_gsplat):
    cameras, frozen = random_cameras(3, 32, 24), random_gaussians(50, 1)
    roomy = OnAnyDevice(frozen)
    expected = roomy.render(cameras)
    assert roomy.memory.startswith("3 prepared views")
    tight = OnAnyDevice(frozen, cache_bytes=roomy.nbytes * 7 // 10)
    found = tight.render(cameras)
    assert 0 < tight.nbytes <= tight.views.cache_bytes
    assert len(tight.views) == 2
    assert torch.equal(found.rgb, expected.rgb)
    torch_gsplat.clear()
    tight.render(cameras[1])  # held, and from now on the last one used
    assert torch_gsplat["projected"] == 0
    tight.render(cameras[0])  # in the place of the one longest unused, the last camera
    tight.render(cameras[1])
    assert torch_gsplat["projected"] == 50
    tight.render(cameras[2])
    assert torch_gsplat["projected"] == 100


def test_no_frozen_no_dynamic_or_none_in_sight_is_still_a_picture(torch_gsplat):
    cameras, some = random_cameras(1, 32, 24), random_gaussians(30, 1)
    behind = leaf_of(replace(some, means=some.means - torch.tensor([0.0, 0.0, 50.0])), torch.float32, "cpu")
    expected = render_reference(cameras, some, BACKGROUND).rgb
    for frozen, dynamic in ((some, None), (Gaussians.empty(), some), (some, Gaussians.empty()), (some, behind)):
        found = OnAnyDevice(frozen).render(cameras, dynamic, BACKGROUND).rgb
        assert (found - expected)[certain_pixels(cameras, some)].abs().max() < 1e-4
    found.sum().backward()
    assert behind.means.grad.abs().sum() == 0
    assert torch.equal(OnAnyDevice(Gaussians.empty()).render(cameras, None, BACKGROUND).rgb[0, 0, 0], BACKGROUND)


def test_a_view_prepared_for_the_viewer_serves_training(torch_gsplat):
    cameras, frozen = random_cameras(1, 32, 24), random_gaussians(30, 1)
    rasterizer = OnAnyDevice(frozen)
    with torch.inference_mode():
        rasterizer.render(cameras)
    leaf = leaf_of(random_gaussians(20, 2), torch.float32, "cpu")
    rasterizer.render(cameras, leaf).rgb.sum().backward()
    assert leaf.means.grad.norm() > 0


def isects(n: int, seed: int, *, levels: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centres, radii and depths of n Gaussians, the depths from a few levels only."""
    generator = torch.Generator().manual_seed(seed)
    centers = 64 * torch.rand(1, n, 2, generator=generator)
    radii = torch.randint(0, 20, (1, n), generator=generator)
    return centers, radii, 1.0 + torch.randint(0, levels, (1, n), generator=generator).float()


def sort_jointly(centers: torch.Tensor, radii: torch.Tensor, depths: torch.Tensor) -> Isects:
    _, ids, rows = _torch_impl._isect_tiles(centers, radii, depths, 16, 4, 3, sort=False)
    ids, order = torch.sort(ids, stable=True)
    return Isects(ids, rows[order], _torch_impl._isect_offset_encode(ids, 1, 4, 3))


@pytest.mark.parametrize("levels", [1, 4, 1000])
@pytest.mark.parametrize(("first", "second"), [(40, 30), (0, 30), (40, 0), (0, 0)])
def test_merging_two_sorted_lists_is_sorting_them_together(first, second, levels):
    parts = isects(first, 1, levels=levels), isects(second, 2, levels=levels)
    merged = merge(sort_jointly(*parts[0]), sort_jointly(*parts[1]), first)
    together = sort_jointly(*(torch.cat(pair, dim=1) for pair in zip(*parts, strict=True)))
    for found, expected in zip(merged, together, strict=True):
        assert torch.equal(found, expected)
        assert found.dtype == expected.dtype


def test_gaussians_on_the_cpu_are_refused():
    with pytest.raises(ValueError, match=r"found them on cpu; call \.to\('cuda'\)"):
        GsplatRasterizer(random_gaussians(3))


def test_numbers_compiled_into_gsplat_cannot_be_changed():
    OnAnyDevice(random_gaussians(3), config=RasterConfig(blur=0.1, near=0.2, far=50.0))
    for other in (RasterConfig(min_alpha=0.1), RasterConfig.of_gsplat("1.5.3")):
        with pytest.raises(ValueError, match="lets only blur, near and far be chosen"):
            OnAnyDevice(random_gaussians(3), config=other)


@pytest.mark.gpu
@pytest.mark.parametrize("frozen_degree", [None, 0, 3])
@pytest.mark.parametrize("degree", [None, 2])
@pytest.mark.parametrize("moves", [False, True])
def test_picture_and_gradients_are_those_of_the_reference(frozen_degree, degree, moves):
    frozen, dynamic = random_gaussians(200, 1, degree=frozen_degree), moving_gaussians(100, degree=degree, moves=moves)
    assert_same_picture_and_gradients(choose_rasterizer(frozen, "cuda"), frozen, dynamic, "cuda")


@pytest.mark.gpu
def test_the_picture_is_that_of_the_whole_of_gsplat():
    """All at once through gsplat's own front door."""
    cameras, frozen, dynamic = random_cameras(1, 100, 70).to("cuda"), random_gaussians(2000, 1), random_gaussians(500, 2)
    found = choose_rasterizer(frozen, "cuda").render(cameras, dynamic.to("cuda"))
    names = ("means", "quats", "scales", "opacities", "colors")
    tensors = (torch.cat([getattr(frozen, name), getattr(dynamic, name)]).cuda() for name in names)
    expected, alphas, _ = gsplat.rasterization(*tensors, cameras.viewmats, cameras.Ks, 100, 70, render_mode="RGB+ED")
    assert (found.rgb - expected[..., :3]).abs().max() < 1e-5
    assert (found.depth - expected[..., 3]).abs().max() < 1e-4
    assert (found.accumulation - alphas[..., 0]).abs().max() < 1e-5
