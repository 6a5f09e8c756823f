"""Deposits of an effect in a scene: the cover on its surfaces, their wetness, and dense matter."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.appearance import REACH, layer_volume
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.bodies import DRIPPED, Bodies, with_prefix, without_prefix
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.cover import Cover, CoverConfig
from pgsd_nerfstudio.physics.ground.dense import DenseMatter
from pgsd_nerfstudio.physics.ground.drips import Drips, after_film
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid, Wetting
from pgsd_nerfstudio.physics.laws.populations import MM_PER_HOUR
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

WATER = 1000.0  # kg/m^3
AGED = 0.2  # s; water spreads and dries in steps so long, and is 0.1 s too old on average: 0.1 % of it dries too early
WETTEST = 2e5  # cells of wetness in the plan, at most; in larger scenes the cells grow


class Deposits:
    """All deposits of an effect in a scene; they change from frame to frame."""

    def __init__(self, effect: Effect, surface: SurfaceMesh, domain: Domain) -> None:
        self.effect = effect
        response = effect.surface
        stays = response.landing == "stays" and len(surface.triangles) > 0
        self.cover: Cover | None = None
        if stays and response.accumulates:
            config = CoverConfig(repose_degrees=response.repose_degrees, film=response.film)
            self.cover = Cover.of(surface, domain, config)
        self.wetness: WetnessGrid | None = None
        if response.landing == "wets":
            cell = max(Wetting().cell, (domain.area / WETTEST) ** 0.5)
            self.wetness = WetnessGrid.of(surface, domain, Wetting(cell=cell))
        rains = response.landing == "wets" and effect.emission.precipitates and len(surface.triangles) > 0
        self.drips = Drips.of(surface, domain) if rains and response.drips else None
        self.dense = DenseMatter(effect.dense, response, surface, domain) if effect.dense is not None and stays else None
        self._since_aged = 0.0  # s
        self.missed = 0.0
        """m^3 of layer, or kg of water, of particles that landed where no level or cell could hold it."""

    def volumes(self, bodies: Bodies) -> Float[ndarray, " n"]:
        """Volume of the layer of each particle, m^3."""
        return layer_volume(self.effect, bodies.diameters.astype(np.float64), bodies.represents.astype(np.float64))

    def masses(self, bodies: Bodies) -> Float[ndarray, " n"]:
        """Mass of the real particles that each particle represents, kg."""
        return self.effect.material.mass(bodies.diameters.astype(np.float64)) * bodies.represents

    def lay(self, bodies: Bodies, *, heaped: bool = False) -> Float[ndarray, " n"]:
        """Add landed particles to the cover.

        Args:
            bodies: the particles at their contacts.
            heaped: the particles came to rest on each other and keep their height where that is above the cover.

        Returns:
            The thickness in metres on which each particle rests.
        """
        if self.cover is None or len(bodies) == 0:
            return np.zeros(len(bodies))
        volumes = self.volumes(bodies)
        radii = REACH * np.sqrt(volumes / (2 * np.pi * self.effect.surface.layer_thickness))
        points = bodies.positions.astype(np.float64)
        self.missed += self.cover.deposit(points, volumes, radii.clip(max=self.effect.surface.probe))
        self.cover.relax()
        height = self.cover.height(points)
        return np.maximum(height, self.cover.above(points)) if heaped else height

    def dripping(self, before: float, after: float) -> tuple[Float[ndarray, "d 3"], Float[ndarray, " d"]]:
        """Where drops let go of edges between two seconds, in metres, and how many real drops each stands for.

        Args:
            before: second.
            after: second.
        """
        if self.drips is None:
            return np.zeros((0, 3)), np.zeros(0)
        effect = self.effect
        rate = effect.emission.intensity * MM_PER_HOUR / WATER
        speedup = effect.surface.accumulation_speedup
        earlier, later = (after_film(rate * effect.timeline.fallen(seconds), speedup) for seconds in (before, after))
        edges, stands_for = self.drips.falling(earlier, later, rate)
        return self.drips.places[edges], stands_for

    def wet(self, bodies: Bodies, share: Float[ndarray, " n"]) -> None:
        """Add water of drops to the wetness. Water that drips from an edge has wetted what is above already.

        Args:
            bodies: drops at their contacts.
            share: of each drop's water that is added, 0-1.
        """
        if self.wetness is not None and len(bodies):
            share = np.where(bodies.kinds & DRIPPED, 0.0, share)
            self.missed += self.wetness.deposit(bodies.positions.astype(np.float64), share * self.masses(bodies))

    def age(self, seconds: float) -> None:
        """Let water spread and dry, now or together with the next times."""
        self._since_aged += seconds
        if self.wetness is not None and self._since_aged > AGED - 1e-6:
            self.wetness.step(self._since_aged)
            self._since_aged = 0.0

    def snapshot(self) -> dict[str, ndarray]:
        """The state as arrays, for `restore`."""
        arrays = {"missed": np.array([self.missed]), "since_aged": np.array([self._since_aged])}
        if self.cover is not None:
            arrays |= with_prefix("cover.", self.cover.snapshot())
        if self.wetness is not None:
            sums = np.array([self.wetness.deposited, self.wetness.evaporated])
            arrays |= {"water": self.wetness.water.copy(), "water_sums": sums}
        return arrays | (self.dense.snapshot() if self.dense is not None else {})

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """Take a state from `snapshot`; without arrays nothing changes."""
        if not arrays:
            return
        self.missed, self._since_aged = float(arrays["missed"][0]), float(arrays["since_aged"][0])
        if self.cover is not None:
            self.cover.restore(without_prefix("cover.", arrays))
        if self.wetness is not None:
            self.wetness.water = arrays["water"].copy()
            self.wetness.deposited, self.wetness.evaporated = (float(value) for value in arrays["water_sums"])
        if self.dense is not None:
            self.dense.restore(arrays)

    def summary(self) -> dict[str, float]:
        """Totals for the report: m^3 of cover, kg of water."""
        totals: dict[str, float] = {}
        if self.cover is not None:
            totals |= {"cover_m3": self.cover.volume, "cover_lost_m3": self.cover.lost, "cover_missed_m3": self.missed}
        if self.wetness is not None:
            wet = self.wetness
            totals |= {"water_kg": wet.held, "water_deposited_kg": wet.deposited, "water_evaporated_kg": wet.evaporated}
            totals["water_missed_kg"] = self.missed
        return totals
