"""A moment changes the picture as if the Gaussians had been made so, in every rasterizer."""

from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.moment import Viewpoint
from pgsd_nerfstudio.rendering.reference import certain_pixels, render_reference
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors

SKY = torch.tensor([0.1, 0.5, 0.9])


class Dusk:
    """Turns every other Gaussian red, all fainter, what moves darker by its distance, and the background blue."""

    def __init__(self, strength: float) -> None:
        self.strength = strength
        self.key = f"dusk {strength}".encode()

    def altered(self, frozen: Gaussians) -> Gaussians:
        return replace(frozen, opacities=frozen.opacities * (1 - 0.5 * self.strength), scales=frozen.scales * 1.2)

    def frozen_colors(self, rgb, means, ids, view: Viewpoint):
        red = torch.tensor([1.0, 0.0, 0.0]).to(rgb)
        return torch.where((ids % 2 == 0)[:, None], torch.lerp(rgb, red, self.strength), rgb)

    def adds(self, view: Viewpoint) -> None:
        return None

    def moving_colors(self, rgb, means, view: Viewpoint):
        return rgb * torch.exp(-0.2 * self.strength * (means - view.center.to(means)).norm(dim=1, keepdim=True))

    def background(self, own, view: Viewpoint, gaps):
        return torch.lerp(own, SKY.to(own), self.strength)


def by_hand(dusk: Dusk, cameras, k: int, frozen: Gaussians, moving: Gaussians) -> list[Gaussians]:
    """The same made of plain Gaussians for one camera."""
    viewmat = cameras.viewmats[k]
    view = Viewpoint.of(cameras, k, frozen.means)
    seen = view_colors(frozen.colors, frozen.means, viewmat)
    still = replace(dusk.altered(frozen), colors=dusk.frozen_colors(seen, frozen.means, torch.arange(len(frozen)), view))
    return [still, replace(moving, colors=dusk.moving_colors(moving.colors, moving.means, view))]


@pytest.mark.parametrize("degree", [None, 2])
def test_both_rasterizers_show_a_moment_as_if_it_were_made_of_gaussians(degree):
    frozen, moving, cameras = random_gaussians(150, 1, degree=degree), random_gaussians(60, 2), random_cameras(2, 48, 32)
    moments = [Dusk(0.3), Dusk(1.0)]
    found = CpuRasterizer(frozen).render(cameras, moving, torch.zeros(3), moments)
    judge = render_reference(cameras, [frozen, moving], torch.zeros(3), moments=moments)
    certain = certain_pixels(cameras, [frozen, moving])
    for k, dusk in enumerate(moments):
        sets = by_hand(dusk, cameras, k, frozen, moving)
        expected = render_reference(cameras[k], sets, dusk.background(torch.zeros(3), None, None))
        assert (judge.rgb[k] - expected.rgb[0]).abs().max() < 1e-5
        sure = certain[k] & certain_pixels(cameras[k], sets)[0]
        assert sure.float().mean() > 0.9
        assert (found.rgb[k] - expected.rgb[0])[sure].abs().max() < 2e-4


def test_without_a_moment_no_bit_changes_and_a_view_of_another_moment_is_not_used_again():
    frozen, moving, cameras = random_gaussians(100, 3), random_gaussians(40, 4), random_cameras(1, 40, 40)
    rasterizer = CpuRasterizer(frozen)
    plain = rasterizer.render(cameras, moving)
    dusk = rasterizer.render(cameras, moving, None, Dusk(0.5))
    assert not torch.equal(plain.rgb, dusk.rgb)
    assert torch.equal(rasterizer.render(cameras, moving, None, [None]).rgb, plain.rgb)
    assert torch.equal(rasterizer.render(cameras, moving, None, Dusk(0.5)).rgb, dusk.rgb)
    # Coverage is that of the frozen scene alone, which is what is kept.
    faint, fainter, clear = (
        rasterizer.render(cameras, None, None, moment).accumulation for moment in (Dusk(0.5), Dusk(0.6), None)
    )
    assert not torch.equal(faint, fainter) and not torch.equal(faint, clear)


def test_the_frozen_scene_is_not_touched():
    frozen = random_gaussians(100, 5, degree=1)
    rasterizer = CpuRasterizer(frozen)
    before = {name: tensor.clone() for name, tensor in rasterizer.frozen.tensors.items()}
    rasterizer.render(random_cameras(1, 40, 40), None, None, Dusk(1.0))
    assert all(torch.equal(tensor, before[name]) for name, tensor in rasterizer.frozen.tensors.items())


def test_gradients_of_what_moves_pass_through_the_air():
    frozen, moving, cameras = random_gaussians(60, 6), random_gaussians(40, 7), random_cameras(1, 32, 32)
    leaf = moving.colors.clone().requires_grad_()
    CpuRasterizer(frozen).render(cameras, replace(moving, colors=leaf), None, Dusk(1.0)).rgb.sum().backward()
    wide = moving.colors.double().requires_grad_()
    sets = [frozen.to(torch.float64), replace(moving.to(torch.float64), colors=wide)]
    render_reference(cameras, sets, moments=Dusk(1.0)).rgb.sum().backward()
    assert leaf.grad is not None and wide.grad is not None and float(wide.grad.norm()) > 1
    assert (leaf.grad - wide.grad).norm() < 1e-3 * wide.grad.norm()


def test_a_wrong_number_of_moments_is_refused():
    with pytest.raises(ValueError, match="one moment for each of the 2 cameras, found 3"):
        CpuRasterizer(random_gaussians(5, 8)).render(random_cameras(2, 16, 16), None, None, [None] * 3)


class Watching(Dusk):
    """A moment that remembers the gaps it was shown."""

    def background(self, own, view: Viewpoint, gaps):
        self.light = gaps.light.clone()
        return super().background(own, view, gaps)


@pytest.mark.parametrize("moving_opacity", [0.3, 1.0])
def test_the_gaps_of_a_picture_made_in_one_walk_are_those_of_the_frozen_scene(moving_opacity: float):
    frozen, moving, cameras = random_gaussians(80, 9), random_gaussians(60, 10), random_cameras(1, 53, 37)
    moving = replace(moving, opacities=torch.full_like(moving.opacities, moving_opacity))
    once, alone = Watching(0.0), Watching(0.0)
    picture = CpuRasterizer(frozen).render(cameras, moving, None, once)
    CpuRasterizer(frozen).render(cameras, None, None, alone)
    lit = picture.accumulation[0] < 0.9  # a pixel with more may have been finished by what moves before all that is frozen
    assert float((alone.light[lit] < 0.9).float().mean()) > 0.1
    assert (once.light - alone.light)[lit].abs().max() < 1e-6
