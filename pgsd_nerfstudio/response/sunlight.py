"""Where the sun stood when a scene was captured, how strong it was, and what clouds make of the shadows it left.

Light on a matt surface: s = A + g.B + b (1 - A) + r c, in units of a uniform sky's irradiance on open level ground. A is the
cosine-weighted share of the hemisphere that is open sky, B the mean direction of that open part (a sky that brightens towards
some side or height), b what comes from the surfaces around, c the cosine towards the sun where no surface is in its way. Colour
is albedo times s. Albedo is unknown, but neighbours that lie alike often share it: differences of log luminance between them
are compared with those of log s, under the bounded loss of Geman & McClure (1987), e^2 / (e^2 + w^2), to which the edge of a
paving stone is no more than one miss.

The sun is searched over the sky by the shadows it would cast. It is judged by how well directions found without a sixteenth of
the ground foretell what lies there, and believed only if that beats the best sky without a sun, and stands out from what suns
elsewhere in the sky achieve: their shadows lie like the true ones, but in the wrong places, as chance would have it. Overcast
skies, rooms and patterns of albedo do not pass.
"""

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

from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

POINTS, FEWEST = 6000, 400  # whose light is compared, at most and at least
NEIGHBOURS, PARTNERS = 60, 6  # of a point: how many stand for its surroundings, and with how many of these it is compared
ALIKE, TURN = 0.8, 1.0  # cosine between normals that are compared; metres that a turn of the normal by one radian counts as
NEAR = 0.06  # m off the surface, within which a point is taken to lie on it
DARKEST = 5e-3  # of the median luminance: below, a colour says nothing about light
CANDIDATES, LOWEST = 300, math.sin(math.radians(4.0))  # suns tried first, and the sine of the lowest's elevation
RIVALS, FINER = 3, (8.0, 3.0)  # suns that are looked at closely, with 24 others within so many degrees of each
RATIOS = (0.4, 1.2, 3.6, 10.8)
STRONGEST = 60.0  # ratio; the clear sky's is 5 to 10
FOLDS, CELLS = 16, 64  # of equal numbers of points: what is left out at once, and what counts as one observation
ELSEWHERE = math.cos(math.radians(35.0))  # how far away suns are whose shadows are chance
PROVEN, CERTAIN = 2.0, 5.0  # standard errors over the sky without a sun; standard deviations over suns elsewhere
SKY_RAYS, SUN_RAYS = 64, 8
SPREAD = 0.02  # rad: the disc is 0.0047, more stands for the coarseness of meshes and Gaussians
LIFT = (0.004, 0.03)  # m above the surface where rays start; within this, 0.3 of the median edge
GOLDEN = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Sunlight:
    """The sun of a captured scene."""

    direction: tuple[float, float, float]
    """Unit, metric frame (z up), towards the sun."""
    ratio: float
    """Its irradiance on a surface that faces it / that of the whole sky on open level ground; linear luminance."""
    bounce: float
    """Light on a point that sees no sky, from the surfaces around it / the sky's on open level ground."""
    explained: float
    """Share of the bounded loss of log-luminance differences between neighbours that the sun removes beyond the best sky
    without one, on ground that was left out; small even in full sun, as most of what differs between neighbours is albedo."""
    certainty: float
    """How far that stands out from what suns elsewhere in the sky achieve, in their standard deviations."""


def find_sunlight(
    points: Float[Tensor, "n 3"],  # m
    normals: Float[Tensor, "n 3"],  # unit, towards the open side
    luminance: Float[Tensor, "n"],  # linear light, not sRGB; any scale
    surface: SurfaceMesh,
    *,
    seed: int = 0,
) -> Sunlight | None:
    """The sun whose shadows the colours show; None where they show none (overcast, interior, too few points).

    Luminance that a film's or camera's curve has bent gives the ratio that it looks like after that curve.

    Raises:
        ValueError: points, normals and luminance do not fit together, or hold values that are not finite or are negative.
    """
    points, normals, luminance = _checked(points, normals, luminance)
    generator = torch.Generator().manual_seed(seed)
    yard = _yard(points, normals, luminance, surface, generator)
    if yard is None:
        return None
    sky = _fitted(yard, torch.zeros_like(yard.sky), width=yard.spread, strongest=0.0)
    width = 1.4826 * float((yard.differences - yard.contrast(sky.light)).abs().median())
    sky = _fitted(yard, torch.zeros_like(yard.sky), width=width, strongest=0.0)
    directions, cosines, best = _search(yard, surface, width)
    fits = [_fitted(yard, cosines[:, k], width=width, strongest=STRONGEST) for k in best]
    chosen = min(range(len(fits)), key=lambda k: fits[k].loss)
    fit, sun = fits[chosen], directions[best[chosen]]
    without_sun = yard.by_cell(_loss(yard.differences - yard.contrast(sky.light), width))
    losses = _losses(yard, cosines, fit.ambient, width)
    foretold = _foretold(losses)
    elsewhere = losses[directions @ sun < ELSEWHERE].sum(2).amin(1)
    certainty = float((elsewhere.mean() - foretold.sum()) / elsewhere.std().clamp_min(1e-12))
    if not (_standard_errors(without_sun - foretold) > PROVEN and certainty > CERTAIN):
        return None
    x, y, z = (float(v) for v in sun)
    explained = float(1 - foretold.sum() / without_sun.sum())
    return Sunlight((x, y, z), fit.ratio, fit.bounce, explained, certainty)


def lit(sun: Sunlight, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh) -> Float[Tensor, "n"]:
    """Share of the sun's disc that points (m) see, times the cosine to their normals (unit): 0..1, soft over two degrees."""
    place, normals = _starts(points, normals, surface), normals.detach().float().cpu()
    toward = torch.tensor(sun.direction)
    side, across = _frames(toward[None])
    disc = SPREAD * _cosine_directions(SUN_RAYS)[:, :2]
    cosines = _cosines(place, normals, surface, normalize(toward + disc[:, :1] * side + disc[:, 1:] * across, dim=1))
    return cosines.mean(1).to(points)


def sky_seen(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh, *, rays: int = SKY_RAYS, seed: int = 0
) -> Float[Tensor, "n"]:
    """Cosine-weighted share of the hemisphere about each normal that is open sky, 0..1: open level ground has 1, a wall 1/2."""
    place, normals = _starts(points, normals, surface), normals.detach().float().cpu()
    return _sky(place, normals, surface, rays, torch.Generator().manual_seed(seed))[0].to(points)


def overcast_factor(sun: Sunlight, lit: Float[Tensor, "n"], sky_seen: Float[Tensor, "n"], clouds: float) -> Float[Tensor, "n"]:
    """What linear light is multiplied with when `clouds` (0..1) of the direct sun reach the ground as sky light instead.

    Open level ground keeps its light, and so does what surfaces throw at each other; `lit` and `sky_seen` as the functions of
    these names return them.

    Raises:
        ValueError: clouds are not within 0..1.
    """
    if not 0.0 <= clouds <= 1.0:
        raise ValueError(f"clouds must take a share of 0..1 of the sun, got {clouds:g}")
    # Where neither sun nor sky comes, a trace of bounced light keeps the factor defined, and at 1.
    bounced = max(sun.bounce, 1e-3) * (1 - sky_seen)
    before = sky_seen + bounced + sun.ratio * lit
    after = sky_seen * (1 + clouds * sun.ratio * sun.direction[2]) + bounced + (1 - clouds) * sun.ratio * lit
    return after / before.clamp_min(1e-6)


@dataclass(frozen=True, eq=False)
class _Yard:
    """Points on the surface, what light reaches them from where, and how their log luminance differs from their neighbours'."""

    starts: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    sky: Float[Tensor, "n"]
    slope: Float[Tensor, "n 3"]
    """Mean direction of the open part of the hemisphere, zero elsewhere: what a gradient of the sky adds."""
    first: Int[Tensor, "p"]
    second: Int[Tensor, "p"]
    differences: Float[Tensor, "p"]
    cells: Int[Tensor, "p"]

    @property
    def spread(self) -> float:
        return 1.4826 * float(self.differences.abs().median())

    def contrast(self, light: Float[Tensor, "n *k"]) -> Float[Tensor, "p *k"]:
        """How log light differs between neighbours."""
        log = light.clamp_min(1e-3).log()
        return log[self.first] - log[self.second]

    def by_cell(self, losses: Float[Tensor, "p *k"]) -> Float[Tensor, "cells *k"]:
        """Sums over neighbours, relative to the number of all."""
        return torch.zeros(CELLS, *losses.shape[1:]).index_add_(0, self.cells, losses) / len(self.cells)


class _Fit(NamedTuple):
    """Light without albedo."""

    ratio: float
    bounce: float
    ambient: Float[Tensor, "n"]
    light: Float[Tensor, "n"]
    loss: float


def _checked(points: Tensor, normals: Tensor, luminance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    n = len(points)
    for name, values, shape in (("points", points, (n, 3)), ("normals", normals, (n, 3)), ("luminance", luminance, (n,))):
        if tuple(values.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, found {tuple(values.shape)}")
        if bad := int((~torch.isfinite(values)).sum()):
            raise ValueError(f"{bad} values of the {name} are NaN or infinite")
    if bad := int((luminance < 0).sum()):
        raise ValueError(
            f"luminance is linear light and never negative, found {bad} values down to {float(luminance.min()):.3g}"
        )
    points, normals, luminance = (values.detach().float().cpu() for values in (points, normals, luminance))
    return points, normals, luminance


def _yard(points: Tensor, normals: Tensor, luminance: Tensor, surface: SurfaceMesh, generator: torch.Generator) -> _Yard | None:
    """A choice of points that covers the surface evenly; None where there are too few, or few lie like their neighbours."""
    if len(surface.triangles) == 0 or len(points) < FEWEST:
        return None
    useful = torch.nonzero(luminance > DARKEST * luminance.median())[:, 0]
    chosen = useful[_thinned(points[useful], surface.bounds, generator)]
    chosen = chosen[surface.closest(points[chosen]).distance < NEAR][:POINTS]
    if len(chosen) < FEWEST:
        return None
    place, facing, log = points[chosen], normals[chosen], luminance[chosen].log()
    starts = _starts(place, facing, surface)
    sky, slope = _sky(starts, facing, surface, SKY_RAYS, generator)
    features = torch.cat([place, TURN * facing], dim=1).numpy()
    around = torch.from_numpy(KDTree(features).query(features, NEIGHBOURS + 1)[1])
    which = torch.rand(len(place), NEIGHBOURS, generator=generator).argsort(dim=1)[:, :PARTNERS] + 1
    first, second = torch.arange(len(place)).repeat_interleave(PARTNERS), around.gather(1, which).flatten()
    alike = (facing[first] * facing[second]).sum(1) > ALIKE
    first, second = first[alike], second[alike]
    if len(first) < FEWEST:
        return None
    cells = _cells(place[:, :2].numpy())[first]
    return _Yard(starts, facing, sky, slope, first, second, log[first] - log[second], cells)


def _thinned(points: Float[Tensor, "n 3"], bounds: Float[Tensor, "2 3"], generator: torch.Generator) -> Int[Tensor, "m"]:
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


def _cells(ground: Float[np.ndarray, "n 2"]) -> Int[Tensor, "n"]:
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


def _loss(errors: Tensor, width: float) -> Tensor:
    squares = errors.square()
    return squares / (squares + width**2)


def _bounded(z: np.ndarray) -> np.ndarray:
    """The same of squares in units of the width, with its first two derivatives."""
    return np.stack([z / (1 + z), (1 + z) ** -2.0, -2 * (1 + z) ** -3.0])


def _fitted(yard: _Yard, cosines: Float[Tensor, "n"], *, width: float, strongest: float) -> _Fit:
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
    loss = float(_loss(yard.differences - yard.contrast(light(found)), width).mean())
    return _Fit(float(found[0] / level), float(found[1] / level), ambient, light(found), loss)


def _losses(
    yard: _Yard, cosines: Float[Tensor, "n d"], ambient: Float[Tensor, "n"], width: float
) -> Float[Tensor, "d ratios cells"]:
    """How badly each sun at each ratio foretells the differences."""
    ratios, losses = torch.tensor(RATIOS), []
    for cosine in cosines.unbind(1):
        light = ambient[:, None] + cosine[:, None] * ratios
        losses.append(yard.by_cell(_loss(yard.differences[:, None] - yard.contrast(light), width)).T)
    return torch.stack(losses)


def _search(yard: _Yard, surface: SurfaceMesh, width: float) -> tuple[Float[Tensor, "d 3"], Float[Tensor, "n d"], list[int]]:
    """All suns tried, their cosines at the points, and which few are the best; under a plain sky."""
    plain = yard.sky + 0.2 * (1 - yard.sky)

    def judged(directions: Tensor) -> tuple[Tensor, Tensor]:
        cosines = _cosines(yard.starts, yard.normals, surface, directions)
        return cosines, _losses(yard, cosines, plain, width).sum(2).amin(1)

    directions = _above(CANDIDATES)
    cosines, losses = judged(directions)
    best: list[int] = []
    for k in losses.argsort().tolist():
        if all(directions[k] @ directions[other] < math.cos(math.radians(15)) for other in best):
            best.append(k)
        if len(best) == RIVALS:
            break
    for degrees in FINER:
        disc = math.radians(degrees) * _cosine_directions(24)[:, :2]
        for rival, k in enumerate(best):
            side, across = _frames(directions[k, None])
            around = normalize(directions[k] + disc[:, :1] * side + disc[:, 1:] * across, dim=1)
            around = around[around[:, 2] > LOWEST / 2]
            more = judged(around)
            near = torch.tensor([k, *range(len(directions), len(directions) + len(around))])
            directions, cosines = torch.cat([directions, around]), torch.cat([cosines, more[0]], dim=1)
            losses = torch.cat([losses, more[1]])
            best[rival] = int(near[losses[near].argmin()])
    return directions, cosines, best


def _foretold(losses: Float[Tensor, "d ratios cells"]) -> Float[Tensor, "cells"]:
    """Losses by cell of the sun, and ratio, that is best without the cell's fold."""
    choices = losses.flatten(0, 1)
    folds = choices.reshape(len(choices), FOLDS, CELLS // FOLDS)
    chosen = (folds.sum((1, 2))[:, None] - folds.sum(2)).argmin(0)
    return folds[chosen, torch.arange(FOLDS)].flatten()


def _standard_errors(gains: Float[Tensor, "cells"]) -> float:
    """The mean in units of its standard error."""
    return float(gains.mean() / (gains.std() / math.sqrt(len(gains))).clamp_min(1e-12))


def _starts(points: Tensor, normals: Tensor, surface: SurfaceMesh) -> Float[Tensor, "n 3"]:
    """Where rays start: a little above the surface for points on it or below, else the points themselves."""
    points, normals = points.detach().float().cpu(), normals.detach().float().cpu()
    if len(surface.triangles) == 0:
        return points
    corners = surface.vertices[surface.triangles.long()]
    lift = 0.3 * float((corners[:, 0] - corners[:, 1]).norm(dim=1).median())
    lift = min(max(lift, LIFT[0]), LIFT[1])
    closest = surface.closest(points)
    # Leaves are open on both sides: there the point's own normal says which.
    turned = (closest.normals * normals).sum(1, keepdim=True) < -0.5
    out = torch.where(turned, -closest.normals, closest.normals)
    height = ((points - closest.points) * out).sum(1)
    return torch.where((height < lift)[:, None], closest.points + lift * out, points)


def _cosines(
    starts: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh, directions: Float[Tensor, "d 3"]
) -> Float[Tensor, "n d"]:
    """Cosines between normals and directions, zero where they face away or the surface is in the way."""
    cosines = (normals @ directions.T).clamp_min(0.0)
    for k, direction in enumerate(directions):
        facing = torch.nonzero(cosines[:, k])[:, 0]
        cosines[facing[_blocked(surface, starts[facing], direction.expand(len(facing), 3))], k] = 0.0
    return cosines


def _sky(
    starts: Tensor, normals: Tensor, surface: SurfaceMesh, rays: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Open share of the cosine-weighted hemisphere, and its first moment; each point turns the same rays by another angle."""
    side, across = _frames(normals)
    turn = 2 * math.pi * torch.rand(len(normals), 1, generator=generator)
    side, across = turn.cos() * side + turn.sin() * across, turn.cos() * across - turn.sin() * side
    seen, moment = torch.zeros(len(normals)), torch.zeros(len(normals), 3)
    for x, y, z in _cosine_directions(rays):
        direction = x * side + y * across + z * normals
        free = ((direction[:, 2] > 0) & ~_blocked(surface, starts, direction)).float()
        seen += free
        moment += free[:, None] * direction
    return seen / rays, moment / rays


def _blocked(surface: SurfaceMesh, origins: Tensor, directions: Tensor) -> Tensor:
    if len(surface.triangles) == 0 or len(origins) == 0:
        return torch.zeros(len(origins), dtype=torch.bool)
    return torch.from_numpy(surface.raycasting.test_occlusions(queries(origins, directions)).numpy())


def _frames(normals: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors across each normal."""
    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    side = normalize(torch.linalg.cross(helper, normals), dim=1)
    return side, torch.linalg.cross(normals, side)


def _cosine_directions(count: int) -> Float[Tensor, "k 3"]:
    """Directions about +z whose density is proportional to the cosine; x and y spread evenly over the disc (Vogel's spiral)."""
    k = torch.arange(count) + 0.5
    radius = (k / count).sqrt()
    return torch.stack([radius * (GOLDEN * k).cos(), radius * (GOLDEN * k).sin(), (1 - radius**2).sqrt()], dim=1)


def _above(count: int) -> Float[Tensor, "k 3"]:
    """Directions spread evenly over the sky above the lowest elevation of a sun."""
    k = torch.arange(count) + 0.5
    z = LOWEST + (1 - LOWEST) * k / count
    level = (1 - z**2).sqrt()
    return torch.stack([level * (GOLDEN * k).cos(), level * (GOLDEN * k).sin(), z], dim=1)
