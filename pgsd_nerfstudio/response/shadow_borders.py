"""What the sun shines on in a captured scene, with the borders of shadows where the colours have them; the sun's colour.

Rays on the mesh say where shadows are, but their borders lie some centimetres off those of the picture, and thin things are
missing. Colour is albedo times light (`sunlight`), and neighbours often share an albedo. Each share of the sun that a Gaussian
could see asks for an albedo; the more sure neighbours have about that albedo, the likelier the share (a density of Gaussian
kernels, Parzen 1962). Before the choice the costs are averaged over neighbours of like colour (Hosni et al., "Fast cost-volume
filtering for visual correspondence and beyond", 2013), which keeps borders sharp and takes out single errors. The strength of
the sun in red, green and blue is the mode of what pairs of neighbours on either side of a border say.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.response.sunlight import Sunlight

TURN = 0.1  # m that a difference of 1 between unit normals counts as
AROUND, WIDTH = 24, 0.15  # neighbours whose costs are averaged, and the distance in metres at which they count 1/e
AGREE = 0.1  # greatest difference between the shares of a Gaussian and its neighbours for the mesh to be sure of its shadow
REFERENCES, REACH = 24, 1.0  # sure neighbours whose albedos are compared, and the distance in metres at which they count 1/e
THINNED = 32  # one of this many sure Gaussians is a reference: they reach beyond what the mesh takes for shade by mistake
ALBEDO = 0.3  # standard deviation of the kernel, in log light
ANYWHERE = 3.0  # weight of albedos of the whole scene, beside that of 1 of neighbours
STRANGE = 0.005  # likelihood of an albedo that nothing has
LIKE_COLOR = 0.5  # difference of log light at which a neighbour's cost counts 1/e
SURE, UNSURE = 5.0, 2.0  # cost of leaving the mesh's share by 1, where it is sure and where it is not
SHARP = 4.0  # factor on the costs in the softmax
CERTAIN = 0.95  # probability of full sun or full shade from which a Gaussian serves the others as a reference
ROUNDS, CHOICES = 2, 5
GRAZING = 0.1  # cosine to the sun below which the sun changes too little to be told by colours
HIGHEST, MARGIN = 0.8, 1.3  # quantile of the references' albedos, and factor on it, up to which shade is brightened
FEWEST = 200  # references or pairs; with fewer the mesh is believed, and the sun is white
ACROSS, PARTNERS, ALIKE = 0.4, 8, 0.9  # m between the sides of a border, partners on the other side, least cosine of normals
MODES = (1.0, 0.6, 0.4, 0.3, 0.3, 0.3)  # widths of the loss in log ratio, by which the mode is closed in upon
FARTHEST = 3.0  # greatest factor between the ratio of a channel and that of the luminance
DARKEST = 1e-3  # linear light
BOXES = 81  # of the histogram of all albedos, in each channel
CHUNK = 50_000  # Gaussians at a time, which bounds the memory


@dataclass(frozen=True, eq=False)
class Shade:
    """N Gaussians with their light and the shadows that the mesh casts on them."""

    places: Float[Tensor, "n 3"]
    """Centres in metres."""
    normals: Float[Tensor, "n 3"]
    """Unit normals."""
    light: Float[Tensor, "n 3"]
    """Logarithm of the linear light."""
    ambient: Float[Tensor, " n"]
    """Light of sky and surroundings, relative to that of the sky on open level ground."""
    cosines: Float[Tensor, " n"]
    """Between normals and the sun, at least 0."""
    seen: Float[Tensor, " n"]
    """Share of the sun's disc that the mesh leaves free, 0..1."""
    solid: Bool[Tensor, " n"]
    """Whether a Gaussian is opaque."""

    @staticmethod
    def of(
        sun: Sunlight,
        places: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        light: Float[Tensor, "n 3"],
        lit: Float[Tensor, " n"],
        sky: Float[Tensor, " n"],
        solid: Bool[Tensor, " n"],
    ) -> Shade:
        """Gaussians under a sun.

        Args:
            sun: of the scene.
            places: centres in metres.
            normals: unit, towards the open side.
            light: linear.
            lit: share of the sun times the cosine, from `sunlight.lit`.
            sky: share of the sky, as Exposure.sky.
            solid: whether a Gaussian is opaque.
        """
        cosines = (normals @ torch.tensor(sun.direction).to(normals)).clamp_min(0.0)
        seen = (lit / cosines.clamp_min(GRAZING / 2)).clamp(0, 1)
        ambient = (sky + sun.bounce * (1 - sky)).clamp_min(0.02)
        return Shade(places, normals, light.clamp_min(DARKEST).log(), ambient, cosines, seen, solid)

    def log_light(self, ratios: Float[Tensor, "3"], share: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Logarithm of the light on each Gaussian, without albedo, if it sees `share` of a sun of `ratios`."""
        return (self.ambient[:, None] + ratios * (self.cosines * share)[:, None]).log()

    def albedos(self, ratios: Float[Tensor, "3"], share: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Logarithm of the albedos that the light asks for, if it sees `share` of a sun of `ratios`."""
        return self.light - self.log_light(ratios, share)

    def nearest(self, count: int, among: Int[Tensor, " m"]) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
        """Distances in metres, in which differences of normals count, and indices of the nearest of some Gaussians.

        Args:
            count: greatest number of neighbours; the Gaussian itself is one of them if it is among the Gaussians.
            among: indices of the Gaussians that are looked for.
        """
        features = torch.cat([self.places, TURN * self.normals], dim=1).numpy()
        apart, which = KDTree(features[among.numpy()]).query(features, min(count, len(among)))
        distance = torch.from_numpy(apart).reshape(len(features), -1).float()
        return distance, among[torch.from_numpy(which).reshape(len(features), -1)]

    @cached_property
    def around(self) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
        """Distances and indices of the Gaussians around each, itself the first."""
        return self.nearest(AROUND + 1, torch.arange(len(self.seen)))

    @cached_property
    def facing(self) -> Bool[Tensor, " n"]:
        """Whether the sun could change the light of a Gaussian."""
        return self.cosines > GRAZING

    @cached_property
    def sure(self) -> Bool[Tensor, " n"]:
        """Solid Gaussians that face the sun and whose neighbours are as much in the mesh's shadow as they are."""
        shares = self.seen[self.around[1]]
        return self.facing & self.solid & (shares.amax(1) - shares.amin(1) < AGREE)


def sun_colors(shade: Shade, smooth: Bool[Tensor, " n"], sun: Sunlight) -> Float[Tensor, "3"]:
    """Ratio of sun to sky as Sunlight.ratio, in red, green and blue.

    Gaussians of a surface that the mesh shows in full sun are compared with those in full shade beside them. Pairs of one
    material agree with each other and the others do not, so the mode is taken, by reweighting with the loss of Geman & McClure.

    Args:
        shade: of the scene.
        smooth: whether a Gaussian is part of a smooth surface.
        sun: gives the ratio of the luminance, which is taken for all channels if there are too few pairs.
    """
    white = torch.full((3,), sun.ratio)
    bright, dark = ((shade.sure & smooth & side).nonzero()[:, 0] for side in (shade.seen > 1 - AGREE, shade.seen < AGREE))
    if len(bright) == 0 or len(dark) == 0:
        return white
    places = shade.places.numpy()
    apart, partner = KDTree(places[dark.numpy()]).query(places[bright.numpy()], PARTNERS, distance_upper_bound=ACROSS)
    rows, columns = torch.from_numpy(apart).isfinite().nonzero(as_tuple=True)
    first, second = bright[rows], dark[torch.from_numpy(partner)[rows, columns]]
    level = (shade.normals[first] * shade.normals[second]).sum(1) > ALIKE
    first, second = first[level], second[level]
    if len(first) < FEWEST:
        return white
    contrast = (shade.light[first] - shade.light[second]).exp()
    found = (contrast * shade.ambient[second, None] - shade.ambient[first, None]) / shade.cosines[first, None]
    logs = found.clamp_min(0.01).log()
    mode = logs.median(0).values
    for width in MODES:
        weights = (1 + (logs - mode).square().sum(1) / width**2) ** -2.0
        mode = (weights[:, None] * logs).sum(0) / weights.sum()
    return torch.minimum(torch.maximum(mode.exp(), white / FARTHEST), white * FARTHEST)


def seen_by_colors(shade: Shade, ratios: Float[Tensor, "3"]) -> Float[Tensor, " n"]:
    """Share of the sun that each Gaussian sees, 0..1, by the mesh and by its colour among its neighbours'.

    Args:
        shade: of the scene.
        ratios: of sun to sky in red, green and blue, from `sun_colors`.
    """
    choices = torch.linspace(0, 1, CHOICES)
    logs = torch.stack([shade.log_light(ratios, torch.full_like(shade.seen, choice)) for choice in choices.tolist()], dim=1)
    leaving = torch.where(shade.sure, SURE, UNSURE)[:, None] * (choices - shade.seen[:, None]).abs()
    share, known = shade.seen, shade.sure
    for _ in range(ROUNDS):
        if int(known.sum()) < FEWEST:
            return share
        likely = _likelihoods(shade, shade.albedos(ratios, share), logs, known)
        costs = leaving - (likely + STRANGE).log()
        probable = torch.softmax(-SHARP * _averaged(shade, costs), dim=1)
        share = torch.where(shade.facing, probable @ choices, shade.seen)
        known = shade.facing & shade.solid & (torch.maximum(probable[:, 0], probable[:, -1]) > CERTAIN)
    return share


def plausible(shade: Shade, ratios: Float[Tensor, "3"], share: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Factor 0..1 on the light of what is taken for shaded, with which its albedo is one that references around it have.

    What was sunlit and is taken for shaded leaves no bright fringe.

    Args:
        shade: of the scene.
        ratios: of sun to sky in red, green and blue.
        share: of the sun that each Gaussian sees, from `seen_by_colors`.
    """
    known = shade.facing & shade.solid & ((share < 1 - CERTAIN) | (share > CERTAIN))
    if int(known.sum()) < FEWEST:
        return torch.ones_like(share)
    albedo = luminance(shade.albedos(ratios, share).exp())
    _, near = shade.nearest(REFERENCES + 1, _references(known))
    most = MARGIN * torch.cat([albedo[part].quantile(HIGHEST, dim=1) for part in near.split(CHUNK)])
    return torch.where(share < 0.5, (most / albedo).clamp_max(1.0), 1.0)


def _references(known: Bool[Tensor, " n"]) -> Int[Tensor, " m"]:
    """Indices of some of the Gaussians whose shade is known."""
    which = known.nonzero()[:, 0]
    mixed = which[torch.randperm(len(which), generator=torch.Generator().manual_seed(0))]
    return mixed[: max(len(which) // THINNED, FEWEST)]


def _likelihoods(
    shade: Shade, albedos: Float[Tensor, "n 3"], logs: Float[Tensor, "n c 3"], known: Bool[Tensor, " n"]
) -> Float[Tensor, "n c"]:
    """How many references around a Gaussian, and anywhere, have the albedo that each choice of light asks for.

    Where the mesh is wrong over a wide area, the references around are wrong too, but few others have such an albedo.

    Args:
        shade: of the scene.
        albedos: logarithms, of all Gaussians as they are known so far.
        logs: logarithm of the light for each choice.
        known: Gaussians whose shade is known.
    """
    distance, near = shade.nearest(REFERENCES + 1, _references(known))
    weights = torch.exp(-distance / REACH) * (near != torch.arange(len(near))[:, None]) + 1e-9
    frequencies = _frequencies(albedos[shade.facing & shade.solid])
    found = []
    for part in torch.arange(len(near)).split(CHUNK):
        asked = shade.light[part, None] - logs[part]
        apart = (asked[:, :, None] - albedos[near[part]][:, None]).square().sum(3)
        density = (torch.exp(-apart / (2 * ALBEDO**2)) * weights[part, None]).sum(2) / weights[part].sum(1, keepdim=True)
        found.append(density + ANYWHERE * frequencies[_boxes(asked)])
    return torch.cat(found)


def _frequencies(albedos: Float[Tensor, "m 3"]) -> Float[Tensor, " boxes"]:
    """Share of all albedos in each box of the kernel's size and those around it, a third of it: about a density of kernels."""
    counts = torch.bincount(_boxes(albedos), minlength=BOXES**3).float() / len(albedos)
    return 9 * torch.nn.functional.avg_pool3d(counts.view(1, 1, BOXES, BOXES, BOXES), 3, 1, 1).flatten()


def _boxes(albedos: Float[Tensor, "*n 3"]) -> Int[Tensor, "*n"]:
    """Index of the box of each logarithm of an albedo."""
    red, green, blue = ((albedos / ALBEDO).round().long() + BOXES // 2).clamp(0, BOXES - 1).unbind(-1)
    return (red * BOXES + green) * BOXES + blue


def _averaged(shade: Shade, costs: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
    """Costs averaged over the neighbours of like colour."""
    distance, around = shade.around
    found = []
    for part in torch.arange(len(around)).split(CHUNK):
        near = around[part]
        colors = (shade.light[near] - shade.light[part, None]).square().sum(2)
        weights = torch.exp(-colors / LIKE_COLOR**2) * (torch.exp(-((distance[part] / WIDTH) ** 2)) + 1e-4)
        found.append((costs[near] * weights[:, :, None]).sum(1) / weights.sum(1, keepdim=True))
    return torch.cat(found)
