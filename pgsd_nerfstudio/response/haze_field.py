"""The haze of a weather as a function of place and time: its extinction, its patches, and its arrival.

Fog and sand follow from their visibility (`physics.laws.populations.extinction`). For rain and snow the extinction is twice the
shadow of the particles that bring the precipitation, of all natural sizes and not only the simulated ones. For rain this is
1.15-1.25 times the 1.076 R^0.67 dB/km of Carbonneau & Wisely (1998), from 1 to 50 mm/h. Flakes have the area of the aggregates
of Mitchell, "Use of mass- and area-dimensional power laws for determining precipitation particle terminal velocities" (1996,
table 1), A = 0.2285 D^1.88 in cm, a third of a disc; full discs would give three times the extinction. At 1 mm/h of water,
where weather services draw the line to moderate snow and say half a mile, 5 % of the contrast are left at three quarters of
that; storms differ by a factor of three and more (Rasmussen et al., "The estimation of snowfall rate using visibility", 1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws import populations
from pgsd_nerfstudio.rendering.medium import Froxels, Lengths, Medium
from pgsd_nerfstudio.response.front import Front
from pgsd_nerfstudio.response.patches import Patches
from pgsd_nerfstudio.response.patchiness import smooth_step
from pgsd_nerfstudio.response.shown_share import ShownShare
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.storage import content_key

FADE_IN = 0.2  # share of the onset in which a front becomes visible
EDGE = 1.0  # m; over this the parcels of fog take over from the haze
FIRST_SLICE = 0.4  # m
SLICES, RAYS = 64, 44  # samples along a ray and across the image, for patches whose logarithm deviates by 0.5
RAINDROPS = 0.1e-3, 6e-3  # m; diameters for which Marshall & Palmer's law holds; few are larger
SNOWFLAKES = 1e-3, 12e-3  # m; diameters that Locatelli & Hobbs measured
OPAQUE = 6.0  # optical depth beyond which nothing is seen


def full_extinction(effect: Effect) -> float:
    """Mean extinction of the full weather in 1/m; 0 if the effect has no haze."""
    emission = effect.emission
    if effect.haze is None:
        return 0.0
    if not emission.precipitates:
        return effect.haze.amount * populations.extinction(emission)
    diameters, areas = areas_in_air(effect)
    return effect.haze.amount * 2 * populations.integral(areas, diameters)


def areas_in_air(effect: Effect) -> tuple[Float[ndarray, " a"], Float[ndarray, " a"]]:
    """Diameters in metres of flakes or drops of all natural sizes, and the density of their areas, 1/m^2 per metre of diameter.

    Args:
        effect: snow or rain.
    """
    flakes = effect.emission.kind == "snowflakes"
    diameters = np.geomspace(*(SNOWFLAKES if flakes else RAINDROPS), 1024)
    density = populations.number_density(diameters, effect.emission, effect.material)
    return diameters, density * (flake_area(diameters) if flakes else 0.25 * math.pi * diameters**2)


def flake_area(diameters: Float[ndarray, " a"]) -> Float[ndarray, " a"]:
    """Area in m^2 of aggregates with diameters in metres (Mitchell 1996, table 1)."""
    return 1e-4 * 0.2285 * (1e2 * diameters) ** 1.88


@dataclass(frozen=True, eq=False, kw_only=True)
class HazeField:
    """The haze of one scene under one weather."""

    airlight: tuple[float, float, float]
    """Colour of the haze, sRGB."""
    extinction: float
    """Extinction of the full weather at the ground in 1/m; 0: the air is clear."""
    timeline: Timeline
    front: Front | None
    """None: the haze arrives everywhere at once."""
    scale_height: float
    """Height in metres over which the haze thins to 1 / e."""
    patches: Patches | None
    domain: Domain
    """Box of air in metres in which the particles are simulated."""
    parcels: float
    """Share of the extinction within the domain that the simulated particles contribute by their own opacity. The haze leaves
    it out there."""
    frame: Frame
    identity: str
    """Hash of all that the haze was made from."""
    shown: ShownShare | None = None
    """What of the haze is left beside the particles that are shown; None: all of it."""

    @staticmethod
    def of(effect: Effect, frame: Frame, domain: Domain, *, seed: int = 0) -> HazeField:
        """The haze of an effect.

        Args:
            effect: if its haze is None, the air is clear at all times.
            frame: metric frame of the scene.
            domain: box of air in metres in which the particles are simulated.
            seed: of the patches.
        """
        haze, wind, timeline = effect.haze, effect.wind, effect.timeline
        extinction = full_extinction(effect)
        arrival = Arrival.of(timeline, domain, wind)
        front, patches = Front.of(arrival, domain, seed) if arrival.is_front else None, None
        if haze is not None and haze.patchiness > 0:
            angle = math.radians(wind.direction_degrees)
            drift = wind.speed * math.cos(angle), wind.speed * math.sin(angle), 0.0
            patches = Patches.draw(haze.patchiness, haze.patch_size, drift, turbulence=wind.turbulence, seed=seed)
        made_from = haze, effect.emission, effect.material, effect.wind, effect.appearance, timeline, domain, seed
        return HazeField(
            airlight=(0.0, 0.0, 0.0) if haze is None else haze.rgb,
            extinction=extinction,
            timeline=timeline,
            front=front,
            scale_height=math.inf if haze is None else haze.scale_height,
            patches=patches,
            domain=domain,
            # If the opacity of particles follows from their droplets, the particles are the haze.
            parcels=effect.emission.share if effect.appearance.active.opacity is None else 0.0,
            frame=frame,
            identity=content_key(*made_from, frame.metres_per_unit, frame.rotation, frame.origin),
        )

    def beside(self, effect: Effect, sharpness: float | None) -> HazeField:
        """The haze beside the particles of a simulation, which take their part of the light themselves.

        Args:
            effect: the weather.
            sharpness: as `ParticleHistory.about` has it; None: thinning did not depend on distance, and nothing is left out.
        """
        if sharpness is None or not effect.emission.precipitates:
            return replace(self, shown=None)
        shown = ShownShare.of(effect, sharpness, areas_in_air(effect))
        return replace(self, shown=shown, identity=content_key(self.identity, sharpness))

    def at(self, seconds: float) -> Medium | None:
        """The haze at a second as a medium in scene units; None if the air is clear."""
        strength = self._strength(seconds)
        if strength == 0.0:
            return None
        airlight, per_unit = torch.tensor(self.airlight), strength * self.frame.metres_per_unit
        if self._is_even(seconds):
            return Medium(airlight, per_unit, None, self._lengths)

        def extinction(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
            return per_unit * self.density(self.frame.to_metric(points), seconds)

        return Medium(airlight, extinction, self._froxels(), self._lengths)

    def key(self, seconds: float) -> bytes:
        """Name of the haze at a second; equal names mean equal haze, and clear air has an empty name."""
        strength = self._strength(seconds)
        if strength == 0.0:
            return b""
        moves = (self.patches is not None or self.front is not None) and not self._is_even(seconds)
        return f"{self.identity} {strength!r} {seconds if moves else None!r}".encode()

    def density(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """Extinction without the particles, relative to that of the full weather at the ground.

        Args:
            points: places in metres.
            seconds: the moment.
        """
        found = torch.ones_like(points[:, 0])
        if math.isfinite(self.scale_height):
            found = torch.exp(-points[:, 2].clamp_min(0.0) / self.scale_height)
        if self.patches is not None:
            found = found * self.patches.density(points, seconds)
        if self.front is not None:
            found = found * self.front.passed(points, seconds)
        if self.parcels > 0:
            found = found * (1.0 - self.parcels * _inside(self.domain, points))
        return found

    def _strength(self, seconds: float) -> float:
        """Greatest mean extinction in 1/m at a second: that behind the front, or that of all air if there is no front."""
        share = self.timeline.share(seconds)
        return self.extinction * (min(share / FADE_IN, 1.0) if self.front is not None else share)

    def _is_even(self, seconds: float) -> bool:
        """Whether the haze is the same everywhere within sight."""
        gone = self.front is None or self.front.left(self.domain, seconds, self._reach)
        return gone and self.patches is None and math.isinf(self.scale_height) and self.parcels == 0.0

    @property
    def _lengths(self) -> Lengths | None:
        if self.shown is None:
            return None
        shown, unit = self.shown, self.frame.metres_per_unit
        return lambda distances: shown.before(distances * unit) / unit

    @property
    def _deviation(self) -> float:
        return 0.0 if self.patches is None else self.patches.deviation

    @property
    def _reach(self) -> float:
        """Distance in metres beyond which nothing is seen. It is longer with patches, where most of the air is thinner than the
        mean."""
        opaque = OPAQUE / self.extinction * math.exp(0.5 * self._deviation**2)
        return min(max(opaque, 60.0), 20_000.0)

    def _froxels(self) -> Froxels:
        unit = self.frame.metres_per_unit
        # The error grows with the contrast of the patches and with the square of the distance between samples.
        finer = max(1.0, self._deviation / 0.5) ** 0.3
        return Froxels(
            nearest=FIRST_SLICE / unit, farthest=self._reach / unit, slices=round(SLICES * finer), rays=round(RAYS * finer)
        )


def _inside(domain: Domain, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """1 inside the domain and 0 outside, with a soft edge centred on the faces, so that no extinction is counted twice."""
    lower, upper = torch.tensor(domain.lower).to(points), torch.tensor(domain.upper).to(points)
    return (smooth_step((points - lower) / EDGE + 0.5) * smooth_step((upper - points) / EDGE + 0.5)).prod(dim=1)
