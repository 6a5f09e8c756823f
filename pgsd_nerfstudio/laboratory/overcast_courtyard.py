"""The courtyard of the demo under an overcast sky, computed exactly: its albedo times the light that rays bring, in float64.

The sky has the CIE's overcast law, (1 + 2 sin) / 3 (ISO 15469:2004). Open level ground keeps the light of the capture, in
brightness and colour, as under a camera that is set to it. Surfaces lend each other light by the rule of the courtyard's own
baking: half of that on open level ground, times their mean albedo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import LUMINANCE
from pgsd_nerfstudio.response.rays import cosine_directions, frames
from pgsd_nerfstudio.scene.courtyard import courtyard
from pgsd_nerfstudio.scene.courtyard.baking import SUN, SUN_LIGHT, SUN_SPREAD, as_tensor, develop, raycasting, sky_light
from pgsd_nerfstudio.scene.courtyard.surfels import Part, join
from pgsd_nerfstudio.scene.demo import SEED

if TYPE_CHECKING:
    import open3d as o3d

LEVEL_SKY = 7 / 9  # irradiance of the overcast sky on open level ground, relative to that of a sky as bright as its zenith
LENT = 0.5  # light on surfaces that lend it, relative to that on open level ground, as the baking's BOUNCE is
SUN_RAYS = 16
NEAR, PARTNERS = 0.3, 24  # m between the sides of a border, and how many samples on the other side are looked at
SAME_WAY, SAME_ALBEDO, SAME_LIGHT = 0.97, 0.05, 0.2  # in a pair: least cosine of normals; most differences of logarithms
OPEN, FACING = 0.1, 0.25  # share of the sky and cosine to the sun from which a surface is judged


@dataclass(frozen=True)
class OvercastCourtyard:
    """N samples of the courtyard's parts, which are the first N Gaussians of the demo."""

    light: Float[Tensor, "n 3"]
    """Linear light under clouds, developed as the capture is."""
    sunlit: Bool[Tensor, " n"]
    """Solid, and sees the whole sun."""
    shaded: Bool[Tensor, " n"]
    """Solid, and in a shadow that something casts: it faces the sun and sees nothing of it."""
    lit_side: Int[Tensor, " p"]
    """Sunlit samples of pairs across the border of a cast shadow, of equal albedo, orientation and light under clouds."""
    shaded_side: Int[Tensor, " p"]
    """Shaded samples of the pairs."""


def overcast_courtyard(rays: int) -> OvercastCourtyard:
    """The courtyard under clouds.

    Args:
        rays: for the light of each sample.
    """
    parts = courtyard(np.random.default_rng(SEED))
    everything, sizes = join([p.patch for p in parts]), [len(p.patch) for p in parts]
    albedo, leafy = np.concatenate([p.albedo for p in parts]), np.repeat([p.leafy for p in parts], sizes)
    normal = everything.normal / np.linalg.norm(everything.normal, axis=1, keepdims=True)
    normal = np.where((leafy & (normal[:, 2] < 0))[:, None], -normal, normal)
    start = everything.position + 0.004 * normal
    sky, lent, sun = _rays_of(parts, start, normal, rays)
    level = sky_light(cosine_directions(4000).double().numpy()).mean(0) + SUN_LIGHT * SUN[2]
    light = linear(torch.from_numpy(develop(albedo * level * (sky[:, None] / LEVEL_SKY + LENT * lent)))).float()
    judged = ~leafy & (sky > OPEN) & (normal @ SUN > FACING)
    sunlit, shaded = judged & (sun > 0.95), judged & (sun == 0)
    logs = np.concatenate([np.log(albedo), np.log((light @ torch.tensor(LUMINANCE)).numpy().clip(1e-6))[:, None]], axis=1)
    first, second = _across(sunlit, shaded, everything.position)
    part = np.repeat(np.arange(len(parts)), sizes)
    alike = (part[first] == part[second]) & ((normal[first] * normal[second]).sum(1) > SAME_WAY)
    alike &= (np.abs(logs[first] - logs[second]) < [SAME_ALBEDO] * 3 + [SAME_LIGHT]).all(1)
    lit_side, shaded_side = torch.from_numpy(first[alike]), torch.from_numpy(second[alike])
    return OvercastCourtyard(light, torch.from_numpy(sunlit), torch.from_numpy(shaded), lit_side, shaded_side)


def _rays_of(parts: list[Part], start: NDArray, normal: NDArray, rays: int) -> tuple[NDArray, NDArray, NDArray]:
    """Irradiance [n] of a sky as bright as 1 in its zenith, mean albedo [n, 3] of what surfaces see times its share, and share
    [n] of the sun that they see."""
    everything = join([p.patch for p in parts])
    mesh = raycasting(everything.vertices, everything.triangles)
    tints = np.stack([p.albedo.mean(0) if len(p.albedo) else np.full(3, 0.2) for p in parts] + [np.zeros(3)])
    owner = np.append(np.repeat(np.arange(len(parts)), [len(p.patch.triangles) for p in parts]), len(parts))
    side, across = (axis.numpy() for axis in frames(torch.from_numpy(normal).float()))
    sky, lent = np.zeros(len(start)), np.zeros((len(start), 3))
    for x, y, z in cosine_directions(rays).double().numpy():
        direction = x * side + y * across + z * normal
        met = mesh.cast_rays(_queries(start, direction))["primitive_ids"].numpy().astype(np.int64)
        free = met == mesh.INVALID_ID
        sky += free * (direction[:, 2] > 0) * (1 + 2 * direction[:, 2]) / 3 / rays
        lent += tints[owner[np.where(free, -1, met)]] / rays
    sun = np.zeros(len(start))
    beside, above = (axis[0].double().numpy() for axis in frames(torch.from_numpy(SUN[None]).float()))
    for x, y, _ in cosine_directions(SUN_RAYS).double().numpy():
        towards = np.broadcast_to(SUN + SUN_SPREAD * (x * beside + y * above), start.shape)
        sun += ~mesh.test_occlusions(_queries(start, towards)).numpy() / SUN_RAYS
    return sky, lent, sun


def _queries(start: NDArray, direction: NDArray) -> o3d.core.Tensor:
    return as_tensor(np.concatenate([start, direction], axis=1))


def _across(sunlit: NDArray, shaded: NDArray, places: NDArray) -> tuple[NDArray, NDArray]:
    """Indices of sunlit and shaded samples that are near each other."""
    lit, dark = sunlit.nonzero()[0], shaded.nonzero()[0]
    apart, which = map(np.asarray, KDTree(places[dark]).query(places[lit], PARTNERS, distance_upper_bound=NEAR))
    rows, columns = np.isfinite(apart).nonzero()
    return lit[rows], dark[which[rows, columns]]
