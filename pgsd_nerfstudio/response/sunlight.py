"""The sun of a captured scene: its direction and strength, and the change of its shadows under clouds.

Light on a matt surface is s = A + g.B + b (1 - A) + r c, in units of a uniform sky's irradiance on open level ground. A is the
cosine-weighted share of the hemisphere that is open sky, B the mean direction of that open part (for a sky whose brightness has
the gradient g), b the light of the surrounding surfaces, r the strength of the sun, and c the cosine towards the sun, or 0 in
shadow. Colour is albedo times s. The albedo is unknown, but neighbours of equal orientation often share it, so differences of
their log luminance are compared with those of log s. The bounded loss of Geman & McClure (1987), e^2 / (e^2 + w^2), counts the
edge of a paving stone as one miss and not more.

The search tries suns over the whole sky by the shadows that they would cast. Cross-validation judges them: suns found without a
sixteenth of the ground predict the differences there. A sun is accepted only if it predicts better than the best sky without a
sun, and clearly better than suns elsewhere in the sky, whose shadows have the same shapes in the wrong places. Overcast skies,
rooms and patterns of albedo give no sun.
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
    losses_by_cell,
    predicted_losses,
    sample_surface,
    scatter,
    search,
    standard_errors,
)
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

ELSEWHERE = math.cos(math.radians(35.0))  # cosine of the least angle to suns whose shadows match only by chance
PROVEN, CERTAIN = 2.0, 5.0  # least gain over a sky without sun in standard errors, over suns elsewhere in standard deviations
SUN_RAYS = 8
SPREAD = 0.02  # rad; radius of the disc. The true 0.0047 is widened by the coarseness of meshes and Gaussians


@dataclass(frozen=True)
class Sunlight:
    """The sun of a captured scene."""

    direction: tuple[float, float, float]
    """Unit vector towards the sun in the metric frame."""
    ratio: float
    """Irradiance of the sun on a surface that faces it, divided by that of the whole sky on open level ground; linear
    luminance."""
    bounce: float
    """Irradiance of surrounding surfaces on a point that sees no sky, divided by that of the sky on open level ground."""
    explained: float
    """Share of the bounded loss that the sun removes beyond the best sky without a sun, in cross-validation. It is small even
    in full sun, since most differences between neighbours are differences of albedo."""
    certainty: float
    """Gain over suns elsewhere in the sky, in standard deviations of theirs."""


def find_sunlight(
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    luminance: Float[Tensor, " n"],
    surface: SurfaceMesh,
    *,
    seed: int = 0,
) -> Sunlight | None:
    """Find the sun whose shadows the colours show.

    Args:
        points: on the surface, in metres.
        normals: unit, towards the open side.
        luminance: linear light in any scale, not sRGB. If the curve of a camera has changed it, the ratio is the one that the
            picture shows after that curve.
        surface: the mesh in metres, which casts shadows.
        seed: of the choice of points and rays.

    Returns:
        None if the colours show no shadows of a sun (overcast sky, interior, too few points).

    Raises:
        ValueError: points, normals and luminance do not fit together, or hold values that are not finite or are negative.
    """
    points, normals, luminance = _checked(points, normals, luminance)
    generator = torch.Generator().manual_seed(seed)
    samples = sample_surface(points, normals, luminance, surface, generator)
    if samples is None:
        return None
    sky = fitted(samples, torch.zeros_like(samples.sky), width=samples.spread, strongest=0.0)
    width = scatter(samples.differences - samples.contrast(sky.light))
    sky = fitted(samples, torch.zeros_like(samples.sky), width=width, strongest=0.0)
    directions, cosines, best = search(samples, surface, width)
    fits = [fitted(samples, cosines[:, k], width=width, strongest=STRONGEST) for k in best]
    chosen = min(range(len(fits)), key=lambda k: fits[k].loss)
    fit, sun = fits[chosen], directions[best[chosen]]
    without_sun = samples.by_cell(bounded_loss(samples.differences - samples.contrast(sky.light), width))
    losses = losses_by_cell(samples, cosines, fit.ambient, width)
    predicted = predicted_losses(losses)
    elsewhere = losses[directions @ sun < ELSEWHERE].sum(2).amin(1)
    certainty = float((elsewhere.mean() - predicted.sum()) / elsewhere.std().clamp_min(1e-12))
    if not (standard_errors(without_sun - predicted) > PROVEN and certainty > CERTAIN):
        return None
    x, y, z = (float(v) for v in sun)
    explained = float(1 - predicted.sum() / without_sun.sum())
    return Sunlight((x, y, z), fit.ratio, fit.bounce, explained, certainty)


def lit(
    sun: Sunlight, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], surface: SurfaceMesh
) -> Float[Tensor, " n"]:
    """Share of the sun's disc that points see, times the cosine to their normals: 0..1, with soft shadows over two degrees.

    Args:
        sun: gives the direction.
        points: in metres.
        normals: unit, towards the open side.
        surface: the mesh in metres, which casts shadows.
    """
    place, normals = ray_starts(points, normals, surface), normals.detach().float().cpu()
    toward = torch.tensor(sun.direction)
    side, across = frames(toward[None])
    disc = SPREAD * cosine_directions(SUN_RAYS)[:, :2]
    cosines = open_cosines(place, normals, surface, normalize(toward + disc[:, :1] * side + disc[:, 1:] * across, dim=1))
    return cosines.mean(1).to(points)


def overcast_factor(
    sun: Sunlight, lit: Float[Tensor, " n"], sky_seen: Float[Tensor, " n"], clouds: float
) -> Float[Tensor, " n"]:
    """Factor on linear light when clouds turn a share of the direct sun into sky light.

    Open level ground keeps its light, and the light between surfaces stays too.

    Args:
        sun: the sun without clouds.
        lit: share of the sun at each point, from the function `lit`.
        sky_seen: share of the sky at each point, as Exposure.sky.
        clouds: share of the direct sun that the clouds take, 0..1.

    Raises:
        ValueError: clouds are not within 0..1.
    """
    if not 0.0 <= clouds <= 1.0:
        raise ValueError(f"clouds must take a share of 0..1 of the sun, got {clouds:g}")
    # A trace of bounced light keeps the factor defined, and near 1, at points that neither sun nor sky reaches.
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
