"""Light of single particles that changes with time and with the view: facets that flash, lights that pulse, and a glow.

Particles keep no memory for it and nothing is drawn at random: all follows from the particle's id, the second and the direction
to the camera, so that any frame can be made alone and all cameras agree.

- Glitter. A facet turns about an axis at right angles to its normal and mirrors the light to the camera where its normal n is
  near the half vector h between the two directions; both sides mirror. Its brightness follows the lobe |n.h|^e (Blinn, "Models
  of light reflection for computer synthesized pictures", 1977). The normals of many particles are even over the sphere, where
  the mean of the lobe is 1 / (e + 1): glitter gathers light into flashes and adds none to the mean over particles, at any time
  and for any camera.
- Twinkle. A pulse has the shape exp(k cos) / I0(k), the density of von Mises (1918): its mean over time is 1.
- Glow. The factor 1 + GAIN glow, a core that is whiter than the rest, since what is far brighter than a picture can show takes
  up all of its channels, and a faint halo around the particle in the particle's colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.effects.effect import StateLook
from pgsd_nerfstudio.rendering.display import GAMMA, encoded, linear
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

SUN = (0.36, 0.22, 0.907)  # direction to the brightest part of the sky: a glint needs one, and even a clouded sky has it above
LOBE = 40.0  # e; a facet is at half of its brightness 11 degrees beside the mirror's direction
GATHERED = 0.5  # part of a particle's light that goes into flashes at full glitter; the rest stays as it is
TURNS = 0.6  # turns per second, give or take a half: a flash lasts a tenth of a second
PULSE = 2.0  # k; between pulses 0.06 of the mean is left, at their height there is 3.2 of it
GAIN = 6.0  # times the light of a white particle that one adds at a glow of 1
HOT = 0.15  # part of the way to white of the core, at a glow of 1
WIDER, FAINTER = 5.0, 0.05  # a halo has WIDER times the size and, at a glow of 1, FAINTER times the opacity

_STEPS = tuple(0.5 ** (k / 7) for k in range(1, 7))


@dataclass(frozen=True)
class Sparkle:
    """What active particles do with light over time; see StateLook for the ranges."""

    glitter: float = 0.0
    glow: float = 0.0
    twinkle_hertz: float = 0.0
    halo: bool = True
    """Whether a glow has a halo: parcels of fog are wide already."""

    @staticmethod
    def of(look: StateLook) -> Sparkle | None:
        """The sparkle of a look; None if its particles shine evenly."""
        if not (look.glitter or look.glow or look.twinkle_hertz):
            return None
        return Sparkle(look.glitter, look.glow, look.twinkle_hertz, halo=look.opacity is not None)

    @property
    def widening(self) -> float:
        """Largest size that is drawn, in sizes of the particle."""
        return WIDER if self.glow and self.halo else 1.0

    def brightness(self, ids: Int[Tensor, " n"], second: float, to_camera: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Factor on the linear light of particles.

        Its mean is 1 + GAIN glow: of glitter over many particles, of twinkle over the time of each.

        Args:
            ids: of the particles.
            second: of the frame.
            to_camera: unit vectors from the particles to the camera, metric frame.
        """
        factor = to_camera.new_full((len(ids),), 1.0 + GAIN * self.glow)
        if self.glitter:
            part = GATHERED * self.glitter
            factor = factor * (1.0 - part + part * (LOBE + 1.0) * _mirrored(ids, second, to_camera))
        if self.twinkle_hertz:
            rate = self.twinkle_hertz * (0.7 + 0.6 * _even(ids, 4))
            angle = math.tau * (_even(ids, 5) + rate * second)
            factor = factor * (torch.exp(PULSE * torch.cos(angle)) / torch.special.i0(angle.new_tensor(PULSE))).to(factor)
        return factor


def sparkling(
    gaussians: Gaussians, ids: Int[Tensor, " n"], second: float, center: Float[Tensor, "3"], sparkle: Sparkle
) -> Gaussians:
    """The Gaussians as they sparkle for one camera, followed by the halos of those that glow.

    Args:
        gaussians: in metres, plain RGB; the first n are the active particles.
        ids: of the active particles.
        second: of the frame.
        center: position of the camera, metres.
        sparkle: of the active particles.
    """
    n = len(ids)
    to_camera = torch.nn.functional.normalize(center - gaussians.means[:n], dim=1)
    own = gaussians.colors[:n]
    factor = sparkle.brightness(ids, second, to_camera)[:, None] ** (1 / GAMMA)  # of light, on display values
    core = encoded(torch.lerp(linear(own), torch.ones_like(own), HOT * sparkle.glow)) if sparkle.glow else own
    lit = replace(gaussians, colors=torch.cat([core * factor, gaussians.colors[n:]]))
    if n == 0 or sparkle.widening == 1.0:
        return lit
    halos = lit.select(torch.arange(n, device=ids.device))
    faint = halos.opacities * (FAINTER * sparkle.glow)
    return concatenate([lit, replace(halos, scales=halos.scales * WIDER, opacities=faint, colors=own * factor)])


def _mirrored(ids: Int[Tensor, " n"], second: float, to_camera: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """|n.h|^LOBE of each particle's facet."""
    height, around = 2.0 * _even(ids, 0) - 1.0, math.tau * _even(ids, 1)
    turned = math.tau * (_even(ids, 2) + TURNS * (0.5 + _even(ids, 3)) * second)
    # The axis is (flat cos, flat sin, height); these two are at right angles to it and to each other.
    flat = (1.0 - height * height).clamp_min(0.0).sqrt()
    level = torch.stack([-around.sin(), around.cos(), torch.zeros_like(around)], 1)
    steep = torch.stack([-height * around.cos(), -height * around.sin(), flat], 1)
    normal = (turned.cos()[:, None] * level + turned.sin()[:, None] * steep).to(to_camera)
    half = torch.nn.functional.normalize(to_camera + to_camera.new_tensor(SUN), dim=1)
    return (normal * half).sum(1).abs() ** LOBE


def _even(ids: Int[Tensor, " n"], which: int) -> Float[Tensor, " n"]:
    """Numbers in 0..1 that fill it evenly over ascending ids, independent for each `which`: a Kronecker sequence."""
    return torch.remainder((ids.double() + 0.5) * _STEPS[which], 1.0)
