"""The search for the sun of a captured scene: neighbours compared, skies fitted, suns tried. `sunlight` tells the method."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.response.rays import GOLDEN, cosine_directions, frames, open_cosines, open_sky, ray_starts
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

POINTS, FEWEST = 8000, 400  # whose light is compared, at most and at least
NEIGHBOURS, PARTNERS = 60, 6  # of a point: how many stand for its surroundings, and with how many of these it is compared
ALIKE, TURN = 0.8, 1.0  # cosine between normals that are compared; metres that a turn of the normal by one radian counts as
NEAR = 0.06  # m off the surface, within which a point is taken to lie on it
DARKEST = 5e-3  # of the median luminance: below, a colour says nothing about light
CANDIDATES, LOWEST = 300, math.sin(math.radians(4.0))  # suns tried first, and the sine of the lowest's elevation
RIVALS, FINER = 3, (8.0, 3.0)  # suns that are looked at closely, with 24 others within so many degrees of each
RATIOS = (0.4, 1.2, 3.6, 10.8)
STRONGEST = 60.0  # ratio; the clear sky's is 5 to 10
FOLDS, CELLS = 16, 64  # of equal numbers of points: what is left out at once, and what counts as one observation
SKY_RAYS = 64


@dataclass(frozen=True, eq=False)
class Yard:
    """Points on the surface, what light reaches them from where, and how their log luminance differs from their neighbours'."""

    starts: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    sky: Float[Tensor, " n"]
    slope: Float[Tensor, "n 3"]
    """Mean direction of the open part of the hemisphere, zero elsewhere: what a gradient of the sky adds."""
    first: Int[Tensor, " p"]
    second: Int[Tensor, " p"]
    differences: Float[Tensor, " p"]
    cells: Int[Tensor, " p"]

    @property
    def spread(self) -> float:
        return scatter(self.differences)

    def contrast(self, light: Float[Tensor, " n *k"]) -> Float[Tensor, " p *k"]:
        """How log light differs between neighbours."""
        log = light.clamp_min(1e-3).log()
        return log[self.first] - log[self.second]

    def by_cell(self, losses: Float[Tensor, " p *k"]) -> Float[Tensor, " cells *k"]:
        """Sums over neighbours, relative to the number of all."""
        return torch.zeros(CELLS, *losses.shape[1:]).index_add_(0, self.cells, losses) / len(self.cells)


class Fit(NamedTuple):
    """Light without albedo."""

    ratio: float
    bounce: float
    ambient: Float[Tensor, " n"]
    light: Float[Tensor, " n"]
    loss: float


def yard_of(
    points: Tensor, normals: Tensor, luminance: Tensor, surface: SurfaceMesh, generator: torch.Generator
) -> Yard | None:
    """A choice of points that covers the surface evenly; None where there are too few, or few lie like their neighbours."""
    if len(surface.triangles) == 0 or len(points) < FEWEST:
        return None
    useful = torch.nonzero(luminance > DARKEST * luminance.median())[:, 0]
    chosen = useful[_thinned(points[useful], surface.bounds, generator)]
    chosen = chosen[surface.closest(points[chosen]).distance < NEAR][:POINTS]
    if len(chosen) < FEWEST:
        return None
    place, facing, log = points[chosen], normals[chosen], luminance[chosen].log()
    starts = ray_starts(place, facing, surface)
    sky, slope = open_sky(starts, facing, surface, SKY_RAYS, generator)
    features = torch.cat([place, TURN * facing], dim=1).numpy()
    around = torch.from_numpy(KDTree(features).query(features, NEIGHBOURS + 1)[1])
    which = torch.rand(len(place), NEIGHBOURS, generator=generator).argsort(dim=1)[:, :PARTNERS] + 1
    first, second = torch.arange(len(place)).repeat_interleave(PARTNERS), around.gather(1, which).flatten()
    alike = (facing[first] * facing[second]).sum(1) > ALIKE
    first, second = first[alike], second[alike]
    if len(first) < FEWEST:
        return None
    cells = _cells(place[:, :2].numpy())[first]
    return Yard(starts, facing, sky, slope, first, second, log[first] - log[second], cells)


def _thinned(points: Float[Tensor, "n 3"], bounds: Float[Tensor, "2 3"], generator: torch.Generator) -> Int[Tensor, " m"]:
    """At most one point a cube, in random order; cubes so small that there are enough. Few points are all taken."""
    within = torch.nonzero(((points > bounds[0] - NEAR) & (points < bounds[1] + NEAR)).all(1))[:, 0]
    mixed = within[torch.randperm(len(within), generator=generator)]
    if len(mixed) <= 1.5 * POINTS:
        return mixed
    edge = float((bounds[1] - bounds[0]).norm()) / 20
    kept = np.zeros(0, np.int64)
    for _ in range(40):
        cube = torch.floor((points[mixed] - bounds[0]) / edge).long().numpy()
        kept = np.unique(cube, axis=0, return_index=True)[1]
        if len(kept) >= min(1.5 * POINTS, len(mixed) / 2):
            break
        edge *= 0.85
    return mixed[torch.from_numpy(np.sort(kept))]


def _cells(ground: Float[np.ndarray, "n 2"]) -> Int[Tensor, " n"]:
    """Cells of equal numbers of points, halved along their longer side; consecutive ones together make a fold."""
    labels, parts = np.zeros(len(ground), np.int64), [np.arange(len(ground))]
    while len(parts) < CELLS:
        halves = []
        for part in parts:
            order = part[np.argsort(ground[part, np.ptp(ground[part], axis=0).argmax()], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves
    for label, part in enumerate(parts):
        labels[part] = label
    return torch.from_numpy(labels)


def scatter(errors: Float[Tensor, " p"]) -> float:
    """Standard deviation by the median of magnitudes; never zero, as where a scene is of one colour."""
    return max(1.4826 * float(errors.abs().median()), 1e-4)


def bounded_loss(errors: Tensor, width: float) -> Tensor:
    squares = errors.square()
    return squares / (squares + width**2)


def _bounded(z: np.ndarray) -> np.ndarray:
    """The same of squares in units of the width, with its first two derivatives."""
    return np.stack([z / (1 + z), (1 + z) ** -2.0, -2 * (1 + z) ** -3.0])


def fitted(yard: Yard, cosines: Float[Tensor, " n"], *, width: float, strongest: float) -> Fit:
    """Ratio, bounce and gradient of the sky with the least loss, for one sun; `strongest` = 0: for none."""
    closed = 1 - yard.sky
    shares = torch.cat([cosines[:, None], closed[:, None], yard.slope], dim=1)

    def light(x: np.ndarray) -> Tensor:
        return (yard.sky + shares @ torch.from_numpy(x).float()).clamp_min(1e-3)

    def residuals(x: np.ndarray) -> np.ndarray:
        return (yard.differences - yard.contrast(light(x))).double().numpy() / width

    def jacobian(x: np.ndarray) -> np.ndarray:
        slopes = shares / light(x)[:, None]
        return (slopes[yard.second] - slopes[yard.first]).double().numpy() / width

    # The gradient keeps the sky's radiance positive; 2 upwards is the overcast sky of the CIE.
    upper = [max(strongest, 1e-9), 1.5, 0.7, 0.7, 2.0]
    found = least_squares(
        residuals,
        [upper[0] / 30, 0.25, 0.0, 0.0, 0.0],
        jacobian,  # pyright: ignore[reportArgumentType]
        bounds=([0.0, 0.0, -0.7, -0.7, -0.7], upper),
        loss=_bounded,  # pyright: ignore[reportArgumentType]
        max_nfev=30,
    ).x
    # Such a sky gives open level ground 1 + 2/3 of its vertical gradient.
    level, ambient = 1 + 2 / 3 * found[4], light(np.concatenate([[0.0], found[1:]]))
    loss = float(bounded_loss(yard.differences - yard.contrast(light(found)), width).mean())
    return Fit(float(found[0] / level), float(found[1] / level), ambient, light(found), loss)


def losses_by_cell(
    yard: Yard, cosines: Float[Tensor, "n d"], ambient: Float[Tensor, " n"], width: float
) -> Float[Tensor, "d ratios cells"]:
    """How badly each sun at each ratio foretells the differences."""
    ratios, losses = torch.tensor(RATIOS), []
    for cosine in cosines.unbind(1):
        light = ambient[:, None] + cosine[:, None] * ratios
        losses.append(yard.by_cell(bounded_loss(yard.differences[:, None] - yard.contrast(light), width)).T)
    return torch.stack(losses)


def search(yard: Yard, surface: SurfaceMesh, width: float) -> tuple[Float[Tensor, "d 3"], Float[Tensor, "n d"], list[int]]:
    """All suns tried, their cosines at the points, and which few are the best; under a plain sky."""
    plain = yard.sky + 0.2 * (1 - yard.sky)

    def judged(directions: Tensor) -> tuple[Tensor, Tensor]:
        cosines = open_cosines(yard.starts, yard.normals, surface, directions)
        return cosines, losses_by_cell(yard, cosines, plain, width).sum(2).amin(1)

    directions = _above(CANDIDATES)
    cosines, losses = judged(directions)
    best: list[int] = []
    for k in losses.argsort().tolist():
        if all(directions[k] @ directions[other] < math.cos(math.radians(15)) for other in best):
            best.append(k)
        if len(best) == RIVALS:
            break
    for degrees in FINER:
        disc = math.radians(degrees) * cosine_directions(24)[:, :2]
        for rival, k in enumerate(best):
            side, across = frames(directions[k, None])
            around = normalize(directions[k] + disc[:, :1] * side + disc[:, 1:] * across, dim=1)
            around = around[around[:, 2] > LOWEST / 2]
            more = judged(around)
            near = torch.tensor([k, *range(len(directions), len(directions) + len(around))])
            directions, cosines = torch.cat([directions, around]), torch.cat([cosines, more[0]], dim=1)
            losses = torch.cat([losses, more[1]])
            best[rival] = int(near[losses[near].argmin()])
    return directions, cosines, best


def foretold_losses(losses: Float[Tensor, "d ratios cells"]) -> Float[Tensor, " cells"]:
    """Losses by cell of the sun, and ratio, that is best without the cell's fold."""
    choices = losses.flatten(0, 1)
    folds = choices.reshape(len(choices), FOLDS, CELLS // FOLDS)
    chosen = (folds.sum((1, 2))[:, None] - folds.sum(2)).argmin(0)
    return folds[chosen, torch.arange(FOLDS)].flatten()


def standard_errors(gains: Float[Tensor, " cells"]) -> float:
    """The mean in units of its standard error."""
    return float(gains.mean() / (gains.std() / math.sqrt(len(gains))).clamp_min(1e-12))


def _above(count: int) -> Float[Tensor, "k 3"]:
    """Directions spread evenly over the sky above the lowest elevation of a sun."""
    k = torch.arange(count) + 0.5
    z = LOWEST + (1 - LOWEST) * k / count
    level = (1 - z**2).sqrt()
    return torch.stack([level * (GOLDEN * k).cos(), level * (GOLDEN * k).sin(), z], dim=1)
