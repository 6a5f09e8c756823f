"""Where a thin cover lies first and where it lies last: a rank of places that varies smoothly, with crisp patches.

A thin cover of mean thickness x hides the share 1 - exp(-(x / x0)^1.6) of a surface: its first flakes fall between blades and
stones and are not seen. The places of lowest rank are hidden first, as wholly as under a thick cover, so that the cover begins
as patches and not as a veil.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

WAVELENGTHS = (0.06, 1.2)  # m; shortest and longest of the patches
WAVES = 32
GRAIN = 0.3  # share of a rank's variance that differs from each place to the next
SHARPNESS = 1.6  # exponent of the cover's thickness
EDGE = 0.12  # difference of rank over which a patch ends


def ranks(metric: Float[Tensor, "n 3"], seed: int, *, grain: float = GRAIN) -> Float[Tensor, " n"]:
    """Ranks of places, evenly distributed in 0..1.

    Args:
        metric: places in metres.
        seed: of the waves and of the grain.
        grain: share of the variance that differs from each place to the next.
    """
    generator = torch.Generator().manual_seed(seed)
    shortest, longest = WAVELENGTHS
    waves = torch.nn.functional.normalize(torch.randn(WAVES, 3, generator=generator), dim=1)
    waves = waves / (longest * (shortest / longest) ** torch.rand(WAVES, 1, generator=generator))
    phases = torch.rand(WAVES, generator=generator)
    smooth = torch.sin(2 * math.pi * (metric @ waves.T + phases)).sum(1) * math.sqrt(2 / WAVES)
    each = torch.randn(len(metric), generator=generator)
    return torch.special.ndtr(math.sqrt(1 - grain) * smooth + math.sqrt(grain) * each)


def covered_share(thickness: Float[Tensor, " n"], hides: float) -> Float[Tensor, " n"]:
    """Mean share of a surface that a cover hides, 0..1.

    Args:
        thickness: of the cover in metres.
        hides: thickness in metres that hides 63 %.
    """
    return -torch.expm1(-((thickness / hides) ** SHARPNESS))


def hidden_share(share: Float[Tensor, " n"], rank: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Share of each place that is hidden, 0..1: nothing before the mean share reaches its rank, everything soon after.

    Args:
        share: mean share of the surface that is hidden at each place.
        rank: of each place.
    """
    return smooth_step((share * (1 + EDGE) - rank) / EDGE)


def smooth_step(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """A cubic from 0 at 0 to 1 at 1 that is level at both ends."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def fallen_until_hidden(rate: Float[Tensor, " n"], rank: Float[Tensor, " n"], hides: float) -> Float[Tensor, " n"]:
    """Seconds of full weather after which half of each place is hidden; inf where no cover grows.

    Args:
        rate: growth of the cover in metres per second of full weather.
        rank: of each place.
        hides: thickness in metres that hides 63 %.
    """
    share = ((rank + EDGE / 2) / (1 + EDGE)).clamp_max(1 - 1e-6)
    return hides * (-torch.log1p(-share)) ** (1 / SHARPNESS) / rate
