"""What has come down: the cover that raises the surface, the water that wets it, and matter so thick that it moves as a
whole."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from pgsd_nerfstudio.effects.appearance import REACH, layer_volume
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.ground.cover import Cover, CoverConfig
from pgsd_nerfstudio.physics.ground.dense import DenseMatter
from pgsd_nerfstudio.physics.ground.wetness import WetnessGrid, Wetting
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

WETTEST = 2e5  # squares of the plan from which the cells of wetness grow with the scene


class Deposits:
    """All that an effect leaves in a scene; changes from frame to frame."""

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
        self.dense = DenseMatter(effect.dense, response, surface, domain) if effect.dense is not None and stays else None
        self.missed = 0.0
        """m^3 of layer, or kg of water, that came down where nothing could hold it."""

    def volumes(self, bodies: Bodies) -> Float[ndarray, " n"]:
        """m^3 of layer that particles stand for."""
        return layer_volume(self.effect, bodies.diameters.astype(np.float64), bodies.represents.astype(np.float64))

    def masses(self, bodies: Bodies) -> Float[ndarray, " n"]:
        """kg of the real particles that particles stand for."""
        return self.effect.material.mass(bodies.diameters.astype(np.float64)) * bodies.represents

    def lay(self, bodies: Bodies, *, heaped: bool = False) -> Float[ndarray, " n"]:
        """Add what has landed to the cover; returns the thickness in metres on which each particle lies.

        heaped: they came to rest on each other, and lie where they are rather than on what the cover knows of.
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

    def wet(self, bodies: Bodies, share: Float[ndarray, " n"]) -> None:
        """Add the water of drops, `share` of each."""
        if self.wetness is not None and len(bodies):
            self.missed += self.wetness.deposit(bodies.positions.astype(np.float64), share * self.masses(bodies))

    def age(self, seconds: float) -> None:
        """What time alone does: water spreads and dries."""
        if self.wetness is not None:
            self.wetness.step(seconds)

    def snapshot(self) -> dict[str, ndarray]:
        """Its state as arrays."""
        arrays = {"missed": np.array([self.missed])}
        if self.cover is not None:
            arrays |= {f"cover.{name}": value for name, value in self.cover.snapshot().items()}
        if self.wetness is not None:
            sums = np.array([self.wetness.deposited, self.wetness.evaporated])
            arrays |= {"water": self.wetness.water.copy(), "water_sums": sums}
        return arrays | (self.dense.snapshot() if self.dense is not None else {})

    def restore(self, arrays: Mapping[str, ndarray]) -> None:
        """The state that `snapshot` gave; nothing to restore is a start without anything."""
        if not arrays:
            return
        self.missed = float(arrays["missed"][0])
        if self.cover is not None:
            self.cover.restore({n.removeprefix("cover."): v for n, v in arrays.items() if n.startswith("cover.")})
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
