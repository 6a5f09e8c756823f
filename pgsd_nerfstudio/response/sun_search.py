"""Search for the sun of a captured scene: compare neighbours, fit skies, try suns. `sunlight` describes the method."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.response.rays import GOLDEN, cosine_directions, frames, open_cosines, open_sky, ray_starts
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

POINTS, FEWEST = 8000, 400  # greatest and least number of points whose light is compared
NEIGHBOURS, PARTNERS = 60, 6  # nearest neighbours of a point, and the number of them that it is compared with
ALIKE, TURN = 0.8, 1.0  # least cosine between compared normals; distance in metres that one radian between normals counts as
NEAR = 0.06  # m; points this close to the mesh are on it
DARKEST = 5e-3  # share of the median luminance; darker colours tell nothing about light
CANDIDATES, LOWEST = 300, math.sin(math.radians(4.0))  # number of suns tried first, and sine of their least elevation
RIVALS, FINER = 3, (8.0, 3.0)  # number of suns that are refined, and degrees within which 24 others are tried around each
RATIOS = (0.4, 1.2, 3.6, 10.8)  # ratios of sun to sky that are tried
STRONGEST = 60.0  # greatest ratio; that of a clear sky is 5 to 10
FOLDS, CELLS = 16, 64  # parts with equal numbers of points: left out together, and counted as one observation
SKY_RAYS = 64


@dataclass(frozen=True, eq=False)
class Samples:
    """N points on the surface with their view of the sky, and P pairs of neighbours with their difference of log luminance."""

    starts: Float[Tensor, "n 3"]
    """Starts of rays in metres."""
    normals: Float[Tensor, "n 3"]
    sky: Float[Tensor, " n"]
    """Share of the sky, weighted by the cosine."""
    slope: Float[Tensor, "n 3"]
    """Mean over the hemisphere of the open directions, which is the light of a gradient of the sky."""
    first: Int[Tensor, " p"]
    """Index of the first point of each pair."""
    second: Int[Tensor, " p"]
    """Index of the second point of each pair."""
    differences: Float[Tensor, " p"]
    """Log luminance of the first point minus that of the second."""
    cells: Int[Tensor, " p"]
    """Cell of the first point, 0..CELLS-1."""

    @property
    def spread(self) -> float:
        """Standard deviation of the differences."""
        return scatter(self.differences)

    def contrast(self, light: Float[Tensor, " n *k"]) -> Float[Tensor, " p *k"]:
        """Differences of log light in the pairs, from light at the points."""
        log = light.clamp_min(1e-3).log()
        return log[self.first] - log[self.second]

    def by_cell(self, losses: Float[Tensor, " p *k"]) -> Float[Tensor, " cells *k"]:
        """Sums over the pairs of each cell, divided by the number of all pairs."""
        return torch.zeros(CELLS, *losses.shape[1:]).index_add_(0, self.cells, losses) / len(self.cells)


class Fit(NamedTuple):
    """The light of a fitted sun and sky, without albedo."""

    ratio: float
    """Sun to sky, as Sunlight.ratio."""
    bounce: float
    """Surroundings to sky, as Sunlight.bounce."""
    ambient: Float[Tensor, " n"]
    """Light without the sun."""
    light: Float[Tensor, " n"]
    loss: float
    """Mean bounded loss of the pairs."""


def sample_surface(
    points: Tensor, normals: Tensor, luminance: Tensor, surface: SurfaceMesh, generator: torch.Generator
) -> Samples | None:
    """Choose points that cover the surface evenly, and pair them with neighbours.

    Args:
        points: [n, 3] in metres.
        normals: [n, 3] unit, towards the open side.
        luminance: [n] linear.
        surface: the mesh in metres.
        generator: source of the choice.

    Returns:
        None if there are too few points, or too few with the orientation of their neighbours.
    """
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
    return Samples(starts, facing, sky, slope, first, second, log[first] - log[second], cells)


def _thinned(points: Float[Tensor, "n 3"], bounds: Float[Tensor, "2 3"], generator: torch.Generator) -> Int[Tensor, " m"]:
    """Indices of points near the mesh, at most one in a cube. The cubes shrink until there are enough points; if there are few,
    all are taken."""
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
    """Cells of equal numbers of points, made by halving along the longer side; consecutive cells make a fold."""
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
    """Standard deviation from the median of magnitudes, at least 1e-4, for scenes of one colour."""
    return max(1.4826 * float(errors.abs().median()), 1e-4)


def bounded_loss(errors: Tensor, width: float) -> Tensor:
    """The loss of Geman & McClure (1987), e^2 / (e^2 + w^2), elementwise with the width w."""
    squares = errors.square()
    return squares / (squares + width**2)


def _bounded(z: np.ndarray) -> np.ndarray:
    """The loss of squares in units of the width, with its first two derivatives."""
    return np.stack([z / (1 + z), (1 + z) ** -2.0, -2 * (1 + z) ** -3.0])


def fitted(samples: Samples, cosines: Float[Tensor, " n"], *, width: float, strongest: float) -> Fit:
    """Fit ratio, bounce and gradient of the sky to the differences of neighbours, for one sun.

    Args:
        samples: points and pairs.
        cosines: between normals and the sun at the points, 0 in shadow.
        width: of the bounded loss.
        strongest: greatest ratio; 0 for a sky without a sun.
    """
    from scipy.optimize import least_squares  # a tenth of a second to import, and an answer is kept

    closed = 1 - samples.sky
    shares = torch.cat([cosines[:, None], closed[:, None], samples.slope], dim=1)

    def light(x: np.ndarray) -> Tensor:
        return (samples.sky + shares @ torch.from_numpy(x).float()).clamp_min(1e-3)

    def residuals(x: np.ndarray) -> np.ndarray:
        return (samples.differences - samples.contrast(light(x))).double().numpy() / width

    def jacobian(x: np.ndarray) -> np.ndarray:
        slopes = shares / light(x)[:, None]
        return (slopes[samples.second] - slopes[samples.first]).double().numpy() / width

    # The bounds keep the radiance of the sky positive; an upward gradient of 2 is the overcast sky of the CIE.
    upper = [max(strongest, 1e-9), 1.5, 0.7, 0.7, 2.0]
    found = least_squares(
        residuals,
        [upper[0] / 30, 0.25, 0.0, 0.0, 0.0],
        jacobian,  # pyright: ignore[reportArgumentType]
        bounds=([0.0, 0.0, -0.7, -0.7, -0.7], upper),
        loss=_bounded,  # pyright: ignore[reportArgumentType]
        max_nfev=30,
    ).x
    # The irradiance of such a sky on open level ground is 1 + 2/3 of its vertical gradient.
    level, ambient = 1 + 2 / 3 * found[4], light(np.concatenate([[0.0], found[1:]]))
    loss = float(bounded_loss(samples.differences - samples.contrast(light(found)), width).mean())
    return Fit(float(found[0] / level), float(found[1] / level), ambient, light(found), loss)


def losses_by_cell(
    samples: Samples, cosines: Float[Tensor, "n d"], ambient: Float[Tensor, " n"], width: float
) -> Float[Tensor, "d ratios cells"]:
    """Bounded loss by cell of each sun at each of the RATIOS.

    Args:
        samples: points and pairs.
        cosines: between normals and each sun at the points, 0 in shadow.
        ambient: light without the sun at the points.
        width: of the bounded loss.
    """
    ratios, losses = torch.tensor(RATIOS), []
    for cosine in cosines.unbind(1):
        light = ambient[:, None] + cosine[:, None] * ratios
        losses.append(samples.by_cell(bounded_loss(samples.differences[:, None] - samples.contrast(light), width)).T)
    return torch.stack(losses)


def search(
    samples: Samples, surface: SurfaceMesh, width: float
) -> tuple[Float[Tensor, "d 3"], Float[Tensor, "n d"], list[int]]:
    """Try suns over the whole sky under a uniform sky, and refine the best.

    Args:
        samples: points and pairs.
        surface: the mesh in metres, which casts shadows.
        width: of the bounded loss.

    Returns:
        Unit directions of all suns tried, their cosines at the points, and the indices of the best few.
    """
    plain = samples.sky + 0.2 * (1 - samples.sky)

    def judged(directions: Tensor) -> tuple[Tensor, Tensor]:
        cosines = open_cosines(samples.starts, samples.normals, surface, directions)
        return cosines, losses_by_cell(samples, cosines, plain, width).sum(2).amin(1)

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


def predicted_losses(losses: Float[Tensor, "d ratios cells"]) -> Float[Tensor, " cells"]:
    """Losses by cell by cross-validation: each fold is predicted by the sun and ratio that fit the other folds best."""
    choices = losses.flatten(0, 1)
    folds = choices.reshape(len(choices), FOLDS, CELLS // FOLDS)
    chosen = (folds.sum((1, 2))[:, None] - folds.sum(2)).argmin(0)
    return folds[chosen, torch.arange(FOLDS)].flatten()


def standard_errors(gains: Float[Tensor, " cells"]) -> float:
    """The mean of `gains` in units of its standard error."""
    return float(gains.mean() / (gains.std() / math.sqrt(len(gains))).clamp_min(1e-12))


def _above(count: int) -> Float[Tensor, "k 3"]:
    """Unit directions that cover the sky evenly above the least elevation of a sun."""
    k = torch.arange(count) + 0.5
    z = LOWEST + (1 - LOWEST) * k / count
    level = (1 - z**2).sqrt()
    return torch.stack([level * (GOLDEN * k).cos(), level * (GOLDEN * k).sin(), z], dim=1)
