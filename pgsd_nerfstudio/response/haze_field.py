"""The air of a weather as a function of place and time: how much light it takes, where it is thick, how it comes.

Fog and sand: Koschmieder (1924), extinction = ln 50 / visibility. Rain and snow: twice the shadow of the particles that bring
the precipitation, in all the sizes that nature has and not only those that are simulated. Rain comes to 1.15-1.25 times the
1.076 R^0.67 dB/km that Carbonneau & Wisely (1998) give, from 1 to 50 mm/h. Flakes are as lacy as the aggregates of Mitchell,
"Use of mass- and area-dimensional power laws for determining precipitation particle terminal velocities" (1996, table 1),
A = 0.2285 D^1.88 in cm, a third of a disc: full discs would be three times as thick. Half a mile is seen in 1 mm/h of water,
where weather services draw the line to moderate snow; storms differ from each other by a factor of three and more (Rasmussen
et al., "The estimation of snowfall rate using visibility", 1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.laws import populations
from pgsd_nerfstudio.rendering.medium import Froxels, Medium
from pgsd_nerfstudio.response.patches import Patches
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.storage import content_key

WALL = 5.0  # m, over which a front rises from clear air to all of it
FADE_IN = 0.2  # of the onset: a front is not there all at once
EDGE = 1.0  # m, over which parcels of fog take over from the medium
FIRST_SLICE = 0.4  # m
SLICES, RAYS = 64, 44  # along the way and across the image, for patches whose logarithm deviates by 0.5
RAINDROPS = 0.1e-3, 6e-3  # m, where Marshall & Palmer's law holds; few are larger
SNOWFLAKES = 1e-3, 12e-3  # m, where Locatelli & Hobbs measured
OPAQUE = 6.0  # optical depth beyond which nothing is told apart


def full_extinction(effect: Effect) -> float:
    """Of the whole weather, 1/m, on average; 0 where it has no haze."""
    emission = effect.emission
    if effect.haze is None:
        return 0.0
    if not emission.precipitates:
        return effect.haze.amount * populations.extinction(emission)
    flakes = emission.kind == "snowflakes"
    diameters = np.geomspace(*(SNOWFLAKES if flakes else RAINDROPS), 1024)
    density = populations.number_density(diameters, emission, effect.material)
    taken = 2 * 1e-4 * 0.2285 * (1e2 * diameters) ** 1.88 if flakes else populations.cross_section(diameters)
    return effect.haze.amount * populations.integral(density * taken, diameters)


@dataclass(frozen=True, kw_only=True)
class Front:
    """A wall of weather that the wind carries over the ground, clear before it and all of it behind."""

    along: tuple[float, float]
    """Horizontal direction of its way, of length 1, metric."""
    start: float
    """Where it stands at second 0, in metres along its way."""
    speed: float
    """m/s."""

    @staticmethod
    def of(arrival: Arrival) -> Front:
        """That of the particles, which starts at the domain's upwind corner.

        Raises:
            ValueError: they do not come behind a front.
        """
        if not arrival.is_front:
            raise ValueError(f"only what arrives as a front within an onset has one, found {arrival.timeline}")
        start = arrival.front_position(0.0)
        x, y = arrival.along.tolist()
        return Front(along=(x, y), start=start, speed=arrival.front_position(1.0) - start)

    def passed(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """How much of the weather has reached metric points, 0..1."""
        behind = self.start + self.speed * seconds - points[:, 0] * self.along[0] - points[:, 1] * self.along[1]
        return _smooth_step(behind / WALL + 0.5)

    def left(self, domain: Domain, seconds: float) -> float:
        """Metres by which all of it is beyond the domain; negative before."""
        return self.start + self.speed * seconds - WALL / 2 - _extent(domain, self.along)[1]


@dataclass(frozen=True, eq=False, kw_only=True)
class HazeField:
    """What hangs in the air of one scene under one weather."""

    airlight: tuple[float, float, float]
    extinction: float
    """Of the whole weather at the ground, 1/m; 0: the air is clear."""
    timeline: Timeline
    front: Front | None
    """None: it comes everywhere at once."""
    scale_height: float
    patches: Patches | None
    domain: Domain
    parcels: float
    """Share of the extinction within the domain that simulated particles bring, each by its own opacity; the field leaves it to
    them."""
    frame: Frame
    identity: str
    """Hash of all that it was made from."""

    @staticmethod
    def of(effect: Effect, frame: Frame, domain: Domain, *, seed: int = 0) -> HazeField:
        """The haze of an effect.

        Args:
            effect: its haze may be None: then the air is clear at all times.
            frame: of the scene.
            domain: box of air that the particles are simulated in.
            seed: of the patches.
        """
        haze, wind, timeline = effect.haze, effect.wind, effect.timeline
        extinction = full_extinction(effect)
        arrival = Arrival.of(timeline, domain, wind)
        front, patches = Front.of(arrival) if arrival.is_front else None, None
        if haze is not None and haze.patchiness > 0:
            angle = math.radians(wind.direction_degrees)
            drift = wind.speed * math.cos(angle), wind.speed * math.sin(angle), 0.0
            patches = Patches.draw(haze.patchiness, haze.patch_size, drift, turbulence=wind.turbulence, seed=seed)
        made_from = haze, effect.emission, effect.material, effect.wind, effect.appearance, timeline, domain, front, seed
        return HazeField(
            airlight=(0.0, 0.0, 0.0) if haze is None else haze.rgb,
            extinction=extinction,
            timeline=timeline,
            front=front,
            scale_height=math.inf if haze is None else haze.scale_height,
            patches=patches,
            domain=domain,
            # Where opacity comes from the droplets that a particle stands for, particles are the medium.
            parcels=effect.emission.share if effect.appearance.active.opacity is None else 0.0,
            frame=frame,
            identity=content_key(*made_from, frame.metres_per_unit, frame.rotation, frame.origin),
        )

    def at(self, seconds: float) -> Medium | None:
        """The air at a second, in scene units; None where it is clear."""
        strength = self._strength(seconds)
        if strength == 0.0:
            return None
        airlight, per_unit = torch.tensor(self.airlight), strength * self.frame.metres_per_unit
        if self._is_even(seconds):
            return Medium(airlight, per_unit)

        def extinction(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
            return per_unit * self.density(self.frame.to_metric(points), seconds)

        return Medium(airlight, extinction, self._froxels())

    def key(self, seconds: float) -> bytes:
        """Moments with the same key have the same air; empty where it is clear."""
        strength = self._strength(seconds)
        if strength == 0.0:
            return b""
        moves = (self.patches is not None or self.front is not None) and not self._is_even(seconds)
        return f"{self.identity} {strength!r} {seconds if moves else None!r}".encode()

    def density(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """Extinction at metric points relative to that of the whole weather at the ground, particles left out."""
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
        """Extinction in 1/m where all of what has come by then is."""
        share = self.timeline.share(seconds)
        return self.extinction * (min(share / FADE_IN, 1.0) if self.front is not None else share)

    def _is_even(self, seconds: float) -> bool:
        """Whether the air is the same everywhere, as far as anything is seen."""
        gone = self.front is None or self.front.left(self.domain, seconds) > self._reach
        return gone and self.patches is None and math.isinf(self.scale_height) and self.parcels == 0.0

    @property
    def _deviation(self) -> float:
        return 0.0 if self.patches is None else self.patches.deviation

    @property
    def _reach(self) -> float:
        """Metres beyond which nothing is told apart; longer among patches, as most of the air is thinner than its mean."""
        opaque = OPAQUE / self.extinction * math.exp(0.5 * self._deviation**2)
        return min(max(opaque, 60.0), 20_000.0)

    def _froxels(self) -> Froxels:
        unit = self.frame.metres_per_unit
        # What is off grows with the contrast of the patches, and falls with the square of how far apart the samples are.
        finer = max(1.0, self._deviation / 0.5) ** 0.3
        return Froxels(
            nearest=FIRST_SLICE / unit, farthest=self._reach / unit, slices=round(SLICES * finer), rays=round(RAYS * finer)
        )


def _extent(domain: Domain, along: tuple[float, float]) -> tuple[float, float]:
    """Least and greatest coordinate of a domain along a horizontal direction."""
    ends = [
        [min(a * low, a * high), max(a * low, a * high)]
        for a, low, high in zip(along, domain.lower[:2], domain.upper[:2], strict=True)
    ]
    return ends[0][0] + ends[1][0], ends[0][1] + ends[1][1]


def _inside(domain: Domain, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """1 within, 0 outside; a soft edge whose middle is the face, so that across it nothing is counted twice."""
    lower, upper = torch.tensor(domain.lower).to(points), torch.tensor(domain.upper).to(points)
    return (_smooth_step((points - lower) / EDGE + 0.5) * _smooth_step((upper - points) / EDGE + 0.5)).prod(dim=1)


def _smooth_step(x: Tensor) -> Tensor:
    """From 0 at 0 to 1 at 1, level at both ends."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
