"""The coating of the frozen scene: cover (snow, sand) and wetness (water) on each Gaussian, as functions of time.

The cover grows by the falling mass that each Gaussian catches (`exposure`), in the time lapse of the effect. It stays a film on
slopes above the angle of repose, and nothing stays where the slope does not hold it. The water follows dw/dt = rain - w / tau,
the balance of `physics.ground.wetness`, at every place by itself. A thin cover leaves some spots bare (`patchiness`), and a
light rain leaves some dry: the share that is wet is 1 - exp(-x / x0) (x0 of the cover: SurfaceResponse.hides, of the water:
SurfaceResponse.darkens).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.ground.wetness import Wetting
from pgsd_nerfstudio.physics.laws.populations import MM_PER_HOUR, fall_speed, integral, number_density
from pgsd_nerfstudio.response.exposure import LOOSE_MOST, Exposure
from pgsd_nerfstudio.response.patchiness import covered_share, hidden_share, ranks

ROUGHNESS = 0.35  # standard deviation of the logarithm of the caught mass, so that no edge of a cover is a straight line
PATCHES = (0.15, 1.5)  # m; shortest and longest wavelength of that variation
STEPS_PER_SECOND = 50  # of the balance of water, whose time constant is minutes


@dataclass(frozen=True)
class Coating:
    """Cover and wetness of N Gaussians as functions of time."""

    thickness_rate: Float[Tensor, " n"]
    """Growth of the cover in metres per second of full weather, normal to the surface."""
    thickest: Float[Tensor, " n"]
    """Greatest thickness in metres: a film on steep Gaussians, infinite on the others."""
    most: Float[Tensor, " n"]
    """Greatest share of the Gaussian that a cover can hide, 0..1."""
    water_rate: Float[Tensor, " n"]
    """Water in kg/(m^2 s) in full rain."""
    rank: Float[Tensor, " n"]
    """Order in which Gaussians are hidden, 0..1."""
    effect: Effect

    @staticmethod
    def of(
        effect: Effect,
        exposure: Exposure,
        metric: Float[Tensor, "n 3"],
        *,
        seed: int = 0,
        most: Float[Tensor, " n"] | None = None,
    ) -> Coating:
        """The coating of Gaussians under an effect.

        Args:
            effect: its surface response tells whether particles accumulate or wet.
            exposure: of the same Gaussians.
            metric: their centres in metres.
            seed: of the variation from place to place.
            most: greatest share of each that a cover can hide, as from `exposure.most_hidden`; None: all but of what is loose.
        """
        response = effect.surface
        rate = falling_mass(effect) * exposure.catches * _uneven(metric, seed)
        none = torch.zeros_like(rate)
        slope = torch.rad2deg(torch.arccos(exposure.normals[:, 2].clamp(-1, 1)))
        gathers = response.landing == "stays" and response.accumulates
        ramp = max(response.slips_degrees - response.holds_degrees, 1e-6)
        holds = ((response.slips_degrees - slope) / ramp).clamp(0, 1)
        steep = (slope > response.repose_degrees) & ~exposure.loose
        return Coating(
            thickness_rate=rate * holds * (response.accumulation_speedup / response.layer_density) if gathers else none,
            thickest=torch.where(steep, response.film, math.inf),
            most=torch.where(exposure.loose, LOOSE_MOST, 1.0) if most is None else most,
            water_rate=rate if response.landing == "wets" else none,
            # Each leaf is hidden by itself; ground and walls in patches.
            rank=torch.where(exposure.loose, ranks(metric, seed, grain=1.0), ranks(metric, seed)),
            effect=effect,
        )

    def thickness(self, seconds: float) -> Float[Tensor, " n"]:
        """Thickness of the cover in metres at a second."""
        return torch.minimum(self.thickness_rate * self.effect.timeline.fallen(seconds), self.thickest)

    def hidden(self, seconds: float) -> Float[Tensor, " n"]:
        """Share of each Gaussian that the cover hides at a second, 0..1."""
        return self.most * hidden_share(covered_share(self.thickness(seconds), self.effect.surface.hides), self.rank)

    def water(self, seconds: float) -> Float[Tensor, " n"]:
        """Water in kg/m^2, which is mm, at a second."""
        return self.water_rate * rained(self.effect, seconds)

    def wet(self, seconds: float) -> Float[Tensor, " n"]:
        """Share of each Gaussian that is wet at a second, 0..1."""
        return -torch.expm1(-self.water(seconds) / self.effect.surface.darkens)


def falling_mass(effect: Effect) -> float:
    """Mass in kg that falls on an open horizontal square metre in a second of full weather."""
    emission = effect.emission
    if emission.precipitates:
        return emission.intensity * MM_PER_HOUR
    diameters = np.geomspace(emission.smallest, emission.largest, 512)
    density = number_density(diameters, emission, effect.material)
    return integral(density * fall_speed(diameters, effect.material) * effect.material.mass(diameters), diameters)


def rained(effect: Effect, seconds: float) -> float:
    """Seconds of full rain whose water has not dried at a second.

    It is W with dW/dt = s - W / tau and W(0) = 0, where s is the share of the timeline until its end and tau the drying time.
    """
    tau, timeline = Wetting().drying_seconds, effect.timeline
    until = min(max(seconds, 0.0), timeline.ends)
    at = np.linspace(0.0, until, max(math.ceil(until * STEPS_PER_SECOND), 1) + 1)
    coming = np.array([timeline.share(t) for t in at])
    return integral(coming * np.exp((at - seconds) / tau), at)


def _uneven(metric: Float[Tensor, "n 3"], seed: int) -> Float[Tensor, " n"]:
    """Factors with mean 1 that vary smoothly from place to place and slightly from one Gaussian to the next."""
    generator = torch.Generator().manual_seed(seed)
    shortest, longest = PATCHES
    waves = torch.nn.functional.normalize(torch.randn(24, 3, generator=generator), dim=1)
    waves = waves / (longest * (shortest / longest) ** torch.rand(24, 1, generator=generator))
    phases = torch.rand(24, generator=generator)
    smooth = torch.sin(2 * math.pi * (metric @ waves.T + phases)).sum(1) * math.sqrt(2 / 24)
    each = torch.randn(len(metric), generator=generator)
    log = ROUGHNESS * (0.8 * smooth + 0.6 * each)
    return torch.exp(log - 0.5 * ROUGHNESS**2)
