"""Crowns: the sheets and jets of water that stand for an instant where a drop has met a surface.

A crown widens with the root of time, R = D (2/3)^(1/4) (v t / h)^(1/2) for a film of h = D / 2 (Yarin & Weiss, "Impact of drops
on solid surfaces: self-similar capillary waves, and splashing as a new type of kinematic discontinuity", Journal of Fluid
Mechanics 283, 1995), and rises and falls within some hundredths of a second.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.response.impacts import Impacts
from pgsd_nerfstudio.response.ring_arcs import pixels_per_metre
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

MOST = 300  # crowns in one view
JETS = 9  # of a crown
LIVES = 0.06  # s
HEIGHT = 3.0  # of the highest jets in diameters of the drop
WIDEST = 1.6  # radius of a crown in diameters, at most
WIDE = 0.38  # standard deviation of a jet in diameters
OPACITY = 0.85
SMALLEST = 1.2e-3  # m; drops below make no crown (Splash.joule_per_droplet)
FAINT = 0.3  # pixels of a drop's diameter below which its crown is not drawn


def crowns_of(impacts: Impacts, seconds: float, camera: Cameras, white: Float[Tensor, "3"], legibility: float) -> Gaussians:
    """The crowns that one camera sees, as Gaussians in metres.

    Args:
        impacts: of drops.
        seconds: since the beginning of the weather.
        camera: one camera in metres.
        white: sRGB of water that scatters the light of the sky.
        legibility: as Appearance.legibility; crowns are wider by its fourth root, half as much as drops.
    """
    young = impacts.between(seconds - LIVES, seconds)
    size = legibility**0.25 * young.diameters * pixels_per_metre(young.places, camera)
    size = np.where(young.diameters > SMALLEST, size, 0.0)
    best = np.argsort(-size)[:MOST]
    young = young.select(best[size[best] > FAINT])
    count, diameter = len(young), legibility**0.25 * young.diameters[:, None]
    age = (seconds - young.times)[:, None] / LIVES
    radius = diameter * np.minimum((2 / 3) ** 0.25 * np.sqrt(2 * young.speeds[:, None] * LIVES * age / diameter), WIDEST)
    # Jets of a crown differ; the places of drops draw how.
    draw = np.modf(1e4 * young.places[:, :1] * (1 + np.arange(JETS)))[0] ** 2
    height = diameter * HEIGHT * (0.4 + 0.6 * draw) * 4 * age * (1 - age)
    turn = 2 * math.pi * (np.arange(JETS) / JETS + draw / JETS)
    at = young.places[:, None] + np.stack([radius * np.cos(turn), radius * np.sin(turn), height / 2 + 0.002], -1)
    scales = np.stack([np.broadcast_to(WIDE * diameter, height.shape)] * 2 + [np.maximum(height / 2, WIDE * diameter)], -1)
    opacity = OPACITY * np.broadcast_to(1 - age**2, height.shape)
    total = count * JETS
    return Gaussians(
        torch.from_numpy(at.reshape(total, 3)).float(),
        torch.tensor([1.0, 0, 0, 0]).expand(total, 4),
        torch.from_numpy(scales.reshape(total, 3)).float(),
        torch.from_numpy(opacity.reshape(total)).float(),
        white.expand(total, 3),
        antialiased=True,
    )
