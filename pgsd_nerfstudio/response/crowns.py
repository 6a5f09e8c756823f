"""Crowns: the sheets and jets of water that stand for an instant where a drop has met a surface.

A crown widens with the root of time, R = D (2/3)^(1/4) (v t / h)^(1/2) for a film of h = D / 2 (Yarin & Weiss, "Impact of drops
on solid surfaces: self-similar capillary waves, and splashing as a new type of kinematic discontinuity", Journal of Fluid
Mechanics 283, 1995), and rises and falls within some hundredths of a second. Its sheet of water is so thin and even that one
sees through it, so only the jets of its rim are drawn, as wide as the droplets into which they break. Water that
is round shows nearly all that is around it, small and upside down (Garg & Nayar, "Vision and rain", International Journal of
Computer Vision 75, 2007): here half of it is ground and half is sky.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.display import encoded
from pgsd_nerfstudio.response.impacts import Impacts
from pgsd_nerfstudio.response.ring_arcs import pixels_per_metre
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

MOST = 300  # crowns in one view
JETS = 9  # of a crown
LIVES = 0.06  # s
HEIGHT = 3.0  # of the highest jets in diameters of the drop
WIDEST = 1.6  # radius of a crown in diameters, at most
PER_DIAMETER = 0.36  # standard deviation of a jet across, relative to its diameter: it covers what a disc does
OPACITY = 0.97
SKY = 0.5  # share of the sky in the light of a jet
SMALLEST = 1.2e-3  # m; drops below make no crown (Splash.joule_per_droplet)
FAINT = 0.18  # pixels of a drop's diameter below which its crown is not drawn


def crowned(impacts: Impacts, seconds: float, camera: Cameras) -> Impacts:
    """The drops whose crowns one camera sees, the largest in its picture first.

    Args:
        impacts: of all drops.
        seconds: since the beginning of the weather.
        camera: one camera in metres.
    """
    young = impacts.between(seconds - LIVES, seconds)
    size = young.diameters * pixels_per_metre(young.places, camera)
    size = np.where(young.diameters > SMALLEST, size, 0.0)
    best = np.argsort(-size)[:MOST]
    return young.select(best[size[best] > FAINT])


def crowns_of(
    young: Impacts, seconds: float, ground: Float[Tensor, "k 3"], sky: Float[Tensor, "3"], jet: float, legibility: float
) -> Gaussians:
    """Crowns as Gaussians in metres.

    Args:
        young: drops that have just fallen, as `crowned` returns them.
        seconds: since the beginning of the weather.
        ground: linear light of what they fell on.
        sky: linear light of the sky.
        jet: diameter of a jet relative to that of the drop (`Splash.diameter`).
        legibility: as Appearance.legibility; jets are wider by its root, as drops are, and no longer.
    """
    diameter = young.diameters[:, None]
    age = (seconds - young.times)[:, None] / LIVES
    radius = diameter * np.minimum((2 / 3) ** 0.25 * np.sqrt(2 * young.speeds[:, None] * LIVES * age / diameter), WIDEST)
    # Jets of a crown differ; the places of drops draw how.
    draw = np.modf(1e4 * young.places[:, :1] * (1 + np.arange(JETS)))[0] ** 2
    height = diameter * HEIGHT * (0.4 + 0.6 * draw) * 4 * age * (1 - age)
    turn = 2 * math.pi * (np.arange(JETS) / JETS + draw / JETS)
    at = young.places[:, None] + np.stack([radius * np.cos(turn), radius * np.sin(turn), height / 2 + 0.002], -1)
    wide = np.broadcast_to(PER_DIAMETER * jet * math.sqrt(legibility) * diameter, height.shape)
    scales = np.stack([wide, wide, np.maximum(height / 2, wide)], -1)
    opacity = OPACITY * np.broadcast_to(1 - age**2, height.shape)
    light = encoded(SKY * sky + (1 - SKY) * ground)
    total = len(young) * JETS
    return Gaussians(
        torch.from_numpy(at.reshape(total, 3)).float(),
        torch.tensor([1.0, 0, 0, 0]).expand(total, 4),
        torch.from_numpy(scales.reshape(total, 3)).float(),
        torch.from_numpy(opacity.reshape(total)).float(),
        light.float().repeat_interleave(JETS, 0),
        antialiased=True,
    )
