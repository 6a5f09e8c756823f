"""Arcs of the rings near a camera: thin Gaussians along the two steepest circles of each ring on standing water."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from pgsd_nerfstudio.response.ripples import DT, STEEPEST, Ripples, crests
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

MOST_RINGS = 160  # drawn in one view: those that are largest in the picture and steepest
ARCS = 14  # of each circle of a ring
AGES = (0.015, 0.5)  # s, between which rings are drawn: before, water still splashes, and after, they are too flat to be seen
FINEST = 0.5  # pixels between the two circles of a ring from which it is drawn
CLEAR = 0.06  # slope at which an arc has reached most of its opacity
OPACITY = 0.65
THIN = 3e-4  # m; standard deviation of an arc across the water
OVERLAP = 0.55  # standard deviation along an arc relative to its length
BROAD = 0.42  # standard deviation across an arc relative to the distance of the two circles
MARGIN = 0.1  # share of a picture's size around it in which rings are still drawn


@dataclass(frozen=True, eq=False)
class Arcs:
    """a arcs on level water."""

    places: Float[ndarray, "a 2"]
    """Metres."""
    slopes: Float[ndarray, "a 2"]
    """Of the water there, along x and y."""
    turns: Float[ndarray, " a"]
    """Direction from the middle of the ring, radians."""
    lengths: Float[ndarray, " a"]
    """Standard deviation along the arc, metres."""
    widths: Float[ndarray, " a"]
    """Standard deviation across the arc, metres."""

    def select(self, which: ndarray) -> Arcs:
        """The chosen arcs, by mask or index."""
        return Arcs(*(getattr(self, f.name)[which] for f in fields(self)))

    def gaussians(self, points: Float[Tensor, "a 3"], share: Float[Tensor, " a"], rgb: Float[Tensor, "a 3"]) -> Gaussians:
        """The arcs as Gaussians in metres, with their own light kept at any resolution.

        Args:
            points: their centres.
            share: of standing water at each, 0..1.
            rgb: sRGB.
        """
        half = torch.from_numpy(self.turns).float() / 2
        zero = torch.zeros_like(half)
        steep = torch.from_numpy(np.linalg.norm(self.slopes, axis=1)).float()
        thick = np.stack([self.widths, self.lengths, np.full(len(self.widths), THIN)], 1)
        return Gaussians(
            points,
            torch.stack([half.cos(), zero, zero, half.sin()], 1),
            torch.from_numpy(thick).float(),
            OPACITY * share * (1 - torch.exp(-steep / CLEAR)),
            rgb,
            antialiased=True,
        )


def arcs_of(ripples: Ripples, seconds: float, camera: Cameras, height: float) -> Arcs:
    """The arcs of the rings that one camera sees best.

    Args:
        ripples: the rings.
        seconds: since the beginning of the weather.
        camera: one camera in metres.
        height: of the ground at the origin, metres.
    """
    first, last = np.searchsorted(ripples.times, [seconds - AGES[1], seconds - AGES[0]])
    places, numbers = ripples.places[first:last], ripples.tables[first:last]
    row = np.rint((seconds - ripples.times[first:last]) / DT).astype(int)
    radii, slopes = (table[numbers, row] for table in crests())
    slopes = ripples.depths[first:last, None] * slopes
    apart = np.abs(radii[:, 0] - radii[:, 1])
    pixels = pixels_per_metre(np.concatenate([places, np.full((len(places), 1), height)], 1), camera)
    steep = np.abs(slopes).max(1)
    worth = np.where(pixels * apart > FINEST, pixels * steep * radii.mean(1), 0.0)
    best = np.argsort(-worth)[:MOST_RINGS]
    best = best[worth[best] > 0]
    places, radii, slopes, apart = places[best], radii[best], slopes[best], apart[best]
    slopes = np.clip(slopes, -STEEPEST, STEEPEST)
    # Every ring is turned by another angle, so that arcs of neighbours do not line up.
    turns = 2 * math.pi * (np.arange(ARCS) / ARCS + np.modf(1e3 * places.sum(1))[0][:, None])
    out = np.stack([np.cos(turns), np.sin(turns)], -1)[:, None]  # [rings, 1, ARCS, 2]
    size = (len(best), 2, ARCS)
    arc = 2 * math.pi * radii / ARCS * OVERLAP
    return Arcs(
        places=(places[:, None, None] + radii[:, :, None, None] * out).reshape(-1, 2),
        slopes=(slopes[:, :, None, None] * out).reshape(-1, 2),
        turns=np.broadcast_to(turns[:, None], size).reshape(-1),
        lengths=np.broadcast_to(arc[:, :, None], size).reshape(-1),
        widths=np.broadcast_to((BROAD * apart)[:, None, None], size).reshape(-1),
    )


def pixels_per_metre(places: Float[ndarray, "n 3"], camera: Cameras) -> Float[ndarray, " n"]:
    """Scale of the picture at places in metres, 0 where the camera does not see them."""
    viewmat, K = camera.viewmats[0].double().numpy(), camera.Ks[0].double().numpy()
    at = places @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = at[:, 2].clip(1e-3)
    x, y = K[0, 0] * at[:, 0] / depth + K[0, 2], K[1, 1] * at[:, 1] / depth + K[1, 2]
    wide, high = MARGIN * camera.width, MARGIN * camera.height
    inside = (at[:, 2] > 0.05) & (x > -wide) & (x < camera.width + wide) & (y > -high) & (y < camera.height + high)
    return np.where(inside, K[0, 0] / depth, 0.0)
