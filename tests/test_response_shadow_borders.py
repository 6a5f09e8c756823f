"""Shadows of the sun and its colour, on a floor whose light and albedo are known: a square roof casts a shadow."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from pgsd_nerfstudio.response.shadow_borders import FEWEST, Shade, plausible, seen_by_colors, sun_colors
from pgsd_nerfstudio.response.sunlight import Sunlight, lit, overcast_factor
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

SUN = Sunlight((0.6, 0.0, 0.8), 5.0, 0.15, 0.1, 9.0)
COLORS = torch.tensor([8.0, 5.0, 2.5])  # of the sun relative to the sky: shadows are blue
HALF, HEIGHT = 0.6, 1.0  # m; of the roof
OFF = 0.07  # m by which the mesh is off


@dataclass(frozen=True)
class Floor:
    places: Tensor
    albedo: Tensor
    seen: Tensor
    light: Tensor
    shade: Shade


def roofed(off: float, *, colors: Tensor = COLORS, side: int = 90) -> Floor:
    """A floor of 4.5 m with slabs and grain of known albedo; the mesh has its roof `off` metres from where it is."""
    generator = torch.Generator().manual_seed(1)
    x, y = torch.meshgrid(*[torch.linspace(-2.25, 2.25, side)] * 2, indexing="ij")
    places = torch.stack([x.flatten(), y.flatten(), torch.zeros(side**2)], dim=1)
    places[:, :2] += 0.01 * torch.randn(side**2, 2, generator=generator)
    slab = (places[:, :2] / 0.45 + 5).floor().long()
    stone = 0.5 * torch.rand(12, 12, 1, generator=generator) + torch.tensor([-0.05, 0.0, 0.05])
    albedo = 0.25 * (stone[slab[:, 0], slab[:, 1]] + 0.08 * torch.randn(side**2, 3, generator=generator)).exp()
    middle = torch.tensor([-0.75 * HEIGHT, 0.0])  # where the shadow falls
    # Soft over 4 cm.
    seen = ((((places[:, :2] - middle).abs().amax(1) - HALF) / 0.04) + 0.5).clamp(0, 1)
    light = albedo * (1 + colors * (0.8 * seen)[:, None]) / 5
    corners = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    roof = torch.cat([corners * HALF + torch.tensor([off, off]), torch.full((4, 1), HEIGHT)], dim=1)
    ground = torch.cat([corners * 3, torch.zeros(4, 1)], dim=1)
    quad = torch.tensor([[0, 1, 2], [0, 2, 3]])
    mesh = SurfaceMesh(torch.cat([roof, ground]), torch.cat([quad, quad + 4]).int())
    up, n = torch.tensor([0.0, 0, 1]).expand(side**2, 3), side**2
    by_mesh = lit(SUN, places, up, mesh)
    shade = Shade.of(SUN, places, up, light, by_mesh, torch.ones(n), torch.ones(n, dtype=torch.bool))
    return Floor(places, albedo, seen, light, shade)


def overcast(floor: Floor, share: Tensor, ratios: Tensor) -> Tensor:
    """Light under clouds, divided by the albedo: 1 / 5 of what is the same everywhere."""
    factors = [
        overcast_factor(replace(SUN, ratio=r), floor.shade.cosines * share, torch.ones(len(share)), 1.0)
        for r in ratios.tolist()
    ]
    return floor.light * torch.stack(factors, dim=1) * plausible(floor.shade, ratios, share)[:, None] / floor.albedo * 5


@pytest.mark.parametrize("off", [0.0, OFF])
def test_the_sun_has_the_colours_that_lit_and_shaded_stones_differ_by(off):
    floor = roofed(off)
    found = sun_colors(floor.shade, floor.shade.solid, SUN)
    assert torch.allclose(found, COLORS, rtol=0.12)


def test_borders_are_where_the_colours_have_them_and_not_where_the_mesh_is_off():
    floor = roofed(OFF)
    by_mesh = (floor.shade.seen - floor.seen).abs()
    by_colors = (seen_by_colors(floor.shade, COLORS) - floor.seen).abs()
    assert (by_mesh > 0.5).sum() > 100
    assert (by_colors > 0.5).sum() < 0.05 * (by_mesh > 0.5).sum()


def test_where_the_mesh_is_right_colours_change_no_shadow():
    floor = roofed(0.0)
    clear = (floor.seen == 0) | (floor.seen == 1)
    assert (seen_by_colors(floor.shade, COLORS) - floor.seen)[clear].abs().mean() < 0.02


def test_a_white_wall_in_the_sun_is_not_taken_for_shade_that_was_lit():
    """A slab six times as bright as the others, in full sun, in the midst of them."""
    floor = roofed(0.0)
    bright = (floor.places[:, :2] - torch.tensor([1.2, 1.0])).abs().amax(1) < 0.3
    light = torch.where(bright[:, None], 6 * floor.light, floor.light)
    shade = replace(floor.shade, light=light.log())
    assert seen_by_colors(shade, COLORS)[bright].mean() > 0.95


def test_under_clouds_no_shadow_is_left_in_brightness_or_colour():
    floor = roofed(OFF)
    ratios = sun_colors(floor.shade, floor.shade.solid, SUN)
    light = overcast(floor, seen_by_colors(floor.shade, ratios), ratios).log2()
    apart = light[floor.seen > 0.99].median(0).values - light[floor.seen < 0.01].median(0).values
    assert (light[floor.seen > 0.99].median(0).values - (1 + 0.8 * COLORS).log2()).abs().max() < 0.1
    assert apart.abs().max() < 0.15  # in the clear picture 2 to 3 stops
    at_border = ((floor.places[:, :2] - torch.tensor([-0.75, 0.0])).abs().amax(1) - HALF).abs() < 0.2
    assert (light[at_border] - light.median(0).values).abs().quantile(0.95) < 0.6


def test_few_gaussians_keep_the_shadows_of_the_mesh_and_a_white_sun():
    floor = roofed(0.0, side=13)
    assert len(floor.places) < FEWEST
    assert torch.equal(seen_by_colors(floor.shade, COLORS), floor.shade.seen)
    assert torch.equal(sun_colors(floor.shade, floor.shade.solid, SUN), torch.full((3,), 5.0))
    assert torch.equal(plausible(floor.shade, COLORS, floor.shade.seen), torch.ones(len(floor.places)))


def test_what_was_sunlit_and_is_taken_for_shade_gets_no_brighter_than_what_is_around_it():
    floor = roofed(0.0)
    wrong = (floor.places[:, :2] - torch.tensor([1.2, 1.0])).abs().amax(1) < 0.2
    factor = plausible(floor.shade, COLORS, torch.where(wrong, 0.0, floor.seen))
    assert factor[wrong].median() < 0.5 and (factor[floor.seen > 0.99] == 1)[~wrong[floor.seen > 0.99]].all()
    assert (factor[floor.seen == 0] > 0.9).float().mean() > 0.9
