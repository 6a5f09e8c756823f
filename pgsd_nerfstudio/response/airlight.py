"""Airlight before surfaces that are near: air scatters light mostly ahead, and ahead of a ray to a wall there is only the wall.

Koschmieder's airlight is that before an open horizon. Before a dark wall it is less, since the light that droplets would send
on is that of the wall; and the light of the wall that they send on is not lost. The delta-Eddington approximation (Joseph,
Wiscombe & Weinman, "The delta-Eddington approximation for radiative flux transfer", 1976) counts the share f = g^2 of the
scattered light as not scattered: the optical depth becomes (1 - f) tau. This holds where the surroundings fill the cone into
which air scatters half of its light, 15 degrees about the ray for g = 0.85 (Henyey & Greenstein, 1941). Surroundings of the
height H at the distance d fill the share H / (d tan 15), at most 1.

In a path-traced courtyard in fog of a visibility of 60 m, airlight relative to the sky is 0.05, 0.04, 0.06, 0.12 and 0.16 at
3.2, 4.1, 5.8, 8.5 and 9.9 m; this gives 0.06, 0.07, 0.10, 0.14 and 0.16, and Koschmieder's law 0.19, 0.24, 0.31, 0.42 and 0.48.
What is lost is sharpness: the light sent on by droplets is blurred over degrees, which is not shown.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect

ASYMMETRY = {"fog droplets": 0.85, "raindrops": 0.85, "snowflakes": 0.85, "sand grains": 0.70}
"""Mean cosine of the scattering angle: droplets and drops of water in visible light 0.85 (Hansen & Travis, "Light scattering in
planetary atmospheres", 1974), mineral dust 0.7 (Tegen, Lacis & Fung, "The influence on climate forcing of mineral aerosols from
disturbed soils", 1996)."""
HEIGHT = 2.5  # m, of the surroundings: walls, hedges and houses at the height of eyes
CONE = math.tan(math.radians(15.0))


def thinned(depth: Float[Tensor, " n"], metres: Float[Tensor, " n"], effect: Effect) -> Float[Tensor, " n"]:
    """Optical depth with which large surfaces arrive at the camera.

    Args:
        depth: optical depth on the way.
        metres: length of the way.
        effect: tells of what the air is full.
    """
    filled = (HEIGHT / (metres * CONE).clamp_min(1e-3)).clamp_max(1.0)
    return depth * (1 - ASYMMETRY[effect.emission.kind] ** 2 * filled)
