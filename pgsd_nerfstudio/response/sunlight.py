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

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.response.rays import cosine_directions, frames, open_cosines, ray_starts
from pgsd_nerfstudio.response.sun_search import (
    STRONGEST,
    bounded_loss,
    fitted,
    foretold_losses,
    losses_by_cell,
    scatter,
    search,
    standard_errors,
    yard_of,
)
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

ELSEWHERE = math.cos(math.radians(35.0))  # how far away suns are whose shadows are chance
PROVEN, CERTAIN = 2.0, 5.0  # standard errors over the sky without a sun; standard deviations over suns elsewhere
SUN_RAYS = 8
SPREAD = 0.02  # rad: the disc is 0.0047, more stands for the coarseness of meshes and Gaussians


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
    luminance: Float[Tensor, " n"],  # linear light, not sRGB; any scale
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
    yard = yard_of(points, normals, luminance, surface, generator)
    if yard is None:
        return None
    sky = fitted(yard, torch.zeros_like(yard.sky), width=yard.spread, strongest=0.0)
    width = scatter(yard.differences - yard.contrast(sky.light))
    sky = fitted(yard, torch.zeros_like(yard.sky), width=width, strongest=0.0)
    directions, cosines, best = search(yard, surface, width)
    fits = [fitted(yard, cosines[:, k], width=width, strongest=STRONGEST) for k in best]
    chosen = min(range(len(fits)), key=lambda k: fits[k].loss)
    fit, sun = fits[chosen], directions[best[chosen]]
    without_sun = yard.by_cell(bounded_loss(yard.differences - yard.contrast(sky.light), width))
    losses = losses_by_cell(yard, cosines, fit.ambient, width)
    foretold = foretold_losses(losses)
    elsewhere = losses[directions @ sun < ELSEWHERE].sum(2).amin(1)
    certainty = float((elsewhere.mean() - foretold.sum()) / elsewhere.std().clamp_min(1e-12))
    if not (standard_errors(without_sun - foretold) > PROVEN and certainty > CERTAIN):
        return None
    x, y, z = (float(v) for v in sun)
    explained = float(1 - foretold.sum() / without_sun.sum())
    return Sunlight((x, y, z), fit.ratio, fit.bounce, explained, certainty)


def lit(
    sun: Sunlight, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh
) -> Float[Tensor, " n"]:
    """Share of the sun's disc that points (m) see, times the cosine to their normals (unit): 0..1, soft over two degrees."""
    place, normals = ray_starts(points, normals, surface), normals.detach().float().cpu()
    toward = torch.tensor(sun.direction)
    side, across = frames(toward[None])
    disc = SPREAD * cosine_directions(SUN_RAYS)[:, :2]
    cosines = open_cosines(place, normals, surface, normalize(toward + disc[:, :1] * side + disc[:, 1:] * across, dim=1))
    return cosines.mean(1).to(points)


def overcast_factor(
    sun: Sunlight, lit: Float[Tensor, " n"], sky_seen: Float[Tensor, " n"], clouds: float
) -> Float[Tensor, " n"]:
    """What linear light is multiplied with when `clouds` (0..1) of the direct sun reach the ground as sky light instead.

    Open level ground keeps its light, and so does what surfaces throw at each other; `lit` as the function of this
    name returns it, `sky_seen` as in Exposure.sky.

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
