"""gsplat on a GPU draws what the reference draws; without one it is refused in one sentence."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from pgsd_nerfstudio.rendering import RasterConfig, choose_rasterizer
from pgsd_nerfstudio.rendering.cuda import GsplatRasterizer
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians, relative_error
from pgsd_nerfstudio.scene.gaussians import Gaussians


def test_gaussians_on_the_cpu_are_refused():
    with pytest.raises(ValueError, match=r"found them on cpu; call \.to\('cuda'\)"):
        GsplatRasterizer(random_gaussians(3))


@pytest.mark.gpu
def test_numbers_compiled_into_gsplat_cannot_be_changed():
    with pytest.raises(ValueError, match="min_alpha"):
        GsplatRasterizer(random_gaussians(3).to("cuda"), config=RasterConfig(min_alpha=0.1))


@pytest.mark.gpu
@pytest.mark.parametrize("degree", [None, 0, 3])
def test_picture_and_gradients_are_those_of_the_reference(degree):
    cameras, frozen, dynamic = random_cameras(2, 48, 40), random_gaussians(200, 1, degree=degree), random_gaussians(100, 2)
    background = torch.tensor([0.1, 0.4, 0.7])
    certain = certain_pixels(cameras, [frozen, dynamic])
    names = [field.name for field in fields(Gaussians)]
    gradients = []
    clips = []
    for dtype, device in ((torch.float32, "cuda"), (torch.float64, "cpu")):
        leaf = Gaussians(*(getattr(dynamic, name).clone().to(device, dtype).requires_grad_() for name in names))
        if device == "cuda":
            clip = choose_rasterizer(frozen, "cuda").render(cameras.to("cuda"), leaf, background.to("cuda"))
        else:
            clip = render_reference(cameras, [frozen, leaf], background)
        mask = certain.to(device)
        (clip.rgb[mask].sum() + clip.depth[mask].sum() + clip.accumulation[mask].sum()).backward()
        clips.append(clip)
        gradients.append({name: getattr(leaf, name).grad.cpu() for name in names})
    assert (clips[0].rgb.cpu() - clips[1].rgb)[certain].abs().max() < 1e-4
    assert (clips[0].depth.cpu() - clips[1].depth)[certain].abs().max() < 1e-3
    for name in names:
        assert relative_error(gradients[0][name], gradients[1][name]) < 1e-3, name
