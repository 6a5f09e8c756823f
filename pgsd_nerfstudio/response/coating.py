"""What lies on the frozen scene by a second of the weather: a layer of snow or sand that hides it, water that wets it.

Layer: what comes down and is caught (`exposure`), in the time lapse of the effect; no more than its film where it is steeper
than its angle of repose, nothing where it does not hold. Water: dw/dt = rain - w / tau, the balance of `physics.wetness` for
every place by itself. What shows is a share 1 - exp(-x / x0): of a layer thin on average some spots are bare, of a sprinkled
surface some are dry (x0 of a layer: SurfaceResponse.hides, of water: SurfaceResponse.darkens).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.integrate import trapezoid
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.ground.wetness import Wetting
from pgsd_nerfstudio.physics.laws.populations import MM_PER_HOUR, fall_speed, integral, number_density
from pgsd_nerfstudio.response.exposure import LOOSE_MOST, Exposure

ROUGHNESS = 0.35  # standard deviation of the logarithm of what neighbours catch: no edge of a cover is a line
PATCHES = (0.15, 1.5)  # m, wavelengths of that
SHARPNESS = 1.6  # exponent of a layer's thickness: the first flakes fall between blades and stones and are not seen
STEPS_PER_SECOND = 50  # of the water's balance; its time constant is minutes


@dataclass(frozen=True)
class Coating:
    """What lies on N Gaussians; functions of time."""

    thickness_rate: Float[Tensor, " n"]
    """Metres per second of full weather, normal to the surface."""
    thickest: Float[Tensor, " n"]
    """Metres; where it is steep a film, elsewhere without bound."""
    most: Float[Tensor, " n"]
    """Greatest share that can be hidden."""
    water_rate: Float[Tensor, " n"]
    """kg/(m^2 s) of full rain."""
    effect: Effect

    @staticmethod
    def of(effect: Effect, exposure: Exposure, metric: Float[Tensor, "n 3"], *, seed: int = 0) -> Coating:
        """Of Gaussians at metric places; nothing accumulates or wets where the effect says so."""
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
            most=torch.where(exposure.loose, LOOSE_MOST, 1.0),
            water_rate=rate if response.landing == "wets" else none,
            effect=effect,
        )

    def thickness(self, seconds: float) -> Float[Tensor, " n"]:
        """Metres of layer by then."""
        return torch.minimum(self.thickness_rate * self.effect.timeline.fallen(seconds), self.thickest)

    def hidden(self, seconds: float) -> Float[Tensor, " n"]:
        """Share of each Gaussian that the layer hides, 0..1."""
        return self.most * -torch.expm1(-((self.thickness(seconds) / self.effect.surface.hides) ** SHARPNESS))

    def water(self, seconds: float) -> Float[Tensor, " n"]:
        """kg of water on a square metre, which are mm."""
        return self.water_rate * rained(self.effect, seconds)

    def wet(self, seconds: float) -> Float[Tensor, " n"]:
        """Share of each Gaussian that is wet, 0..1."""
        return -torch.expm1(-self.water(seconds) / self.effect.surface.darkens)


def falling_mass(effect: Effect) -> float:
    """kg that come down on an open horizontal square metre in a second of full weather."""
    emission = effect.emission
    if emission.precipitates:
        return emission.intensity * MM_PER_HOUR
    diameters = np.geomspace(emission.smallest, emission.largest, 512)
    density = number_density(diameters, emission, effect.material)
    return integral(density * fall_speed(diameters, effect.material) * effect.material.mass(diameters), diameters)


def rained(effect: Effect, seconds: float) -> float:
    """Seconds of full rain that are still there: W with dW/dt = share of the timeline until it ends - W / tau, W(0) = 0."""
    tau, timeline = Wetting().drying_seconds, effect.timeline
    until = min(max(seconds, 0.0), timeline.ends)
    at = np.linspace(0.0, until, max(math.ceil(until * STEPS_PER_SECOND), 1) + 1)
    coming = np.array([timeline.share(t) for t in at])
    return float(trapezoid(coming * np.exp((at - seconds) / tau), at))


def _uneven(metric: Float[Tensor, "n 3"], seed: int) -> Float[Tensor, " n"]:
    """Factors about 1 that vary smoothly from place to place and by a hair from one Gaussian to the next."""
    generator = torch.Generator().manual_seed(seed)
    shortest, longest = PATCHES
    waves = torch.nn.functional.normalize(torch.randn(24, 3, generator=generator), dim=1)
    waves = waves / (longest * (shortest / longest) ** torch.rand(24, 1, generator=generator))
    phases = torch.rand(24, generator=generator)
    smooth = torch.sin(2 * math.pi * (metric @ waves.T + phases)).sum(1) * math.sqrt(2 / 24)
    each = torch.randn(len(metric), generator=generator)
    log = ROUGHNESS * (0.8 * smooth + 0.6 * each)
    return torch.exp(log - 0.5 * ROUGHNESS**2)
