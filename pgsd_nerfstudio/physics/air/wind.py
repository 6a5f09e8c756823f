"""Moving air: a mean wind with gusts, slowed by the ground, and turbulence without divergence.

The turbulence is the curl of a vector potential, a sum of Fourier modes A = sum_m g(z) b_m sin(2 pi (k_m . (x - U t) + s_m t +
p_m)). It has no divergence for any g; g is chosen to calm the air at the ground. The modes are drawn once from the seed, and
their energy follows Kolmogorov's -5/3 law (Kraichnan, "Diffusion by a random velocity field", 1970, has the same construction
in free air). U t carries the pattern along (Taylor's frozen flow). The mean wind follows the logarithmic law of the wall. All
is a function of place and time, so no state is stored and any frame can be computed alone.

Obstacles (`deflection`) deflect the mean wind. Beside them the potential of the turbulence is ramped down, as g does above the
ground, which keeps it free of divergence (Bridson, Hourihan & Nordenstam, "Curl-noise for procedural fluid flow", 2007).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import DTypeLike

from pgsd_nerfstudio.effects.effect import Wind
from pgsd_nerfstudio.physics.laws.boundary_layer import calming, law_of_the_wall

GUST_WAVES = 6


@runtime_checkable
class Obstructed(Protocol):
    """Change of a wind by obstacles; `deflection.Deflection` has it."""

    @property
    def first(self) -> Float[ndarray, "3"]:
        """First node of the lattice, m."""
        ...

    @property
    def cell(self) -> float:
        """Distance between nodes, m."""
        ...

    def velocity(self, points: Float[ndarray, "n 3"], wind: Float[ndarray, "2"]) -> Float[ndarray, "n 3"]:
        """Difference to the undisturbed wind in m/s.

        Args:
            points: m.
            wind: undisturbed wind along x and y at the reference height, m/s.
        """
        ...

    def shelter(self, points: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 3"]]:
        """Share of the turbulence that is left, 0-1, and its gradient in 1/m.

        Args:
            points: m.
        """
        ...

    def nodes(self, wind: Float[ndarray, "2"], dtype: DTypeLike) -> tuple[ndarray, ndarray, ndarray]:
        """Arrays for the kernel of `airborne`.

        Args:
            wind: undisturbed wind along x and y at the reference height, m/s.
            dtype: of the first two arrays.

        Returns:
            Spline coefficients of the difference to the undisturbed wind [i, j, k, 3], the share of the turbulence that is left
            [i, j, k], and whether that share is below 1 at any of the eight nodes from each node on [i, j, k].
        """
        ...


@dataclass(frozen=True)
class WindField:
    """One realisation of a random wind; phases are in turns."""

    waves: Float[ndarray, "m 3"]
    """Wave vectors in turns per metre."""
    swirls: Float[ndarray, "m 3"]
    """2 pi k x b: amplitude of the velocity of each mode, m/s."""
    potentials: Float[ndarray, "m 3"]
    """b: amplitude of the vector potential, m^2/s."""
    drifts: Float[ndarray, " m"]
    """s: rate at which each mode changes by itself, turns/s."""
    phases: Float[ndarray, " m"]
    """p: phase of each mode at the origin at time 0."""
    mean: Float[ndarray, "2"]
    """Mean wind at the reference height, m/s."""
    gusts: Float[ndarray, "2 w 3"]
    """Amplitude, hertz and phase of each of w waves of the gusts, along and across the wind."""
    gustiness: float
    """Root mean square of the gusts along the wind, relative to the mean wind; across it is half as large."""
    reference_height: float
    """m."""
    roughness: float
    """Roughness length of the ground, m."""
    deflection: Obstructed | None = None
    """Change of the wind by obstacles; None in open country."""

    @staticmethod
    def draw(wind: Wind, seed: int, deflection: Obstructed | None = None) -> WindField:
        """Draw the modes and gusts of a wind.

        Args:
            wind: speed, direction, gusts and turbulence.
            seed: of all random numbers.
            deflection: change of the wind by obstacles; None in open country.
        """
        rng = np.random.default_rng([seed, 0x317D])
        count = max(wind.modes, 0) if wind.turbulence > 0 else 0
        magnitude = np.geomspace(1 / wind.largest_eddy, 1 / wind.smallest_eddy, count) if count else np.zeros(0)
        waves = magnitude[:, None] * _spread_directions(count, rng)
        across = np.cross(waves, rng.normal(size=(count, 3)))
        across /= np.linalg.norm(across, axis=1, keepdims=True).clip(1e-12)
        # Energy per mode of a logarithmic spacing: k E(k) ~ k^(-2/3); the three components together carry 3 rms^2.
        energy = magnitude ** (-2 / 3)
        amplitude = np.sqrt(2 * 3 * wind.turbulence**2 * energy / energy.sum()) if count else magnitude
        swirls = amplitude[:, None] * across
        square = (waves**2).sum(1, keepdims=True)
        angle = math.radians(wind.direction_degrees)
        hertz = np.exp(rng.uniform(math.log(0.4), math.log(2.5), (2, GUST_WAVES))) / (2 * wind.gust_seconds)
        weight = rng.uniform(0.5, 1.0, (2, GUST_WAVES))
        weight *= np.array([[1.0], [0.5]]) * np.sqrt(2 / (weight**2).sum(1, keepdims=True))
        return WindField(
            waves=waves,
            swirls=swirls,
            potentials=np.cross(swirls, waves) / (2 * math.pi * square) if count else swirls,
            drifts=0.5 * wind.turbulence * magnitude * rng.normal(size=count),
            phases=rng.uniform(size=count),
            mean=wind.speed * np.array([math.cos(angle), math.sin(angle)]),
            gusts=np.stack([weight, hertz, rng.uniform(size=(2, GUST_WAVES))], 2),
            gustiness=wind.gustiness,
            reference_height=wind.reference_height,
            roughness=wind.roughness,
            deflection=deflection,
        )

    def still(self) -> WindField:
        """The same field without mean wind and turbulence; for tests and figures."""
        return replace(self, swirls=0 * self.swirls, potentials=0 * self.potentials, mean=0 * self.mean)

    @property
    def undisturbed(self) -> WindField:
        """The same wind over open ground."""
        return replace(self, deflection=None)

    def at_reference(self, time: float) -> Float[ndarray, "2"]:
        """Mean wind with its gusts at the reference height, m/s.

        Args:
            time: s.
        """
        amplitude, hertz, phase = np.moveaxis(self.gusts, 2, 0)
        along, across = (amplitude * np.sin(2 * math.pi * (hertz * time + phase))).sum(1)
        crosswise = np.array([-self.mean[1], self.mean[0]])
        return self.mean * (1 + self.gustiness * along) + crosswise * (self.gustiness * across)

    def phases_at(self, time: float) -> Float[ndarray, " m"]:
        """Phase of every mode at the origin, in turns, 0..1.

        Args:
            time: s.
        """
        return (self.phases + (self.drifts - self.waves[:, :2] @ self.mean) * time) % 1.0

    def velocity(self, points: Float[ndarray, "n 3"], time: float) -> Float[ndarray, "n 3"]:
        """Air velocity in m/s. This is the plain form that checks the kernel of `airborne`.

        Args:
            points: m, z up.
            time: s.
        """
        profile = law_of_the_wall(points[:, 2], self.roughness, self.reference_height)
        calm, slope = calming(points[:, 2])
        angle = 2 * math.pi * (points @ self.waves.T + self.phases_at(time))
        swirl = np.cos(angle) @ self.swirls
        lifted = np.sin(angle) @ np.stack([-self.potentials[:, 1], self.potentials[:, 0], 0 * self.phases], 1)
        velocity = calm[:, None] * swirl + slope[:, None] * lifted
        if self.deflection is not None:
            shelter, ramp = self.deflection.shelter(points)
            rise = np.cross(calm[:, None] * ramp, np.sin(angle) @ self.potentials)
            velocity = shelter[:, None] * velocity + rise + self.deflection.velocity(points, self.at_reference(time))
        velocity[:, :2] += profile[:, None] * self.at_reference(time)
        return velocity


def _spread_directions(count: int, rng: np.random.Generator) -> Float[ndarray, "m 3"]:
    """Unit vectors that cover the sphere evenly (golden spiral), in random order and with a random rotation."""
    at = np.arange(count) + 0.5
    z, turn = 1 - 2 * at / max(count, 1), math.pi * (1 + math.sqrt(5)) * at
    flat = np.sqrt(1 - z**2)
    spiral = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)[rng.permutation(count)]
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return spiral @ rotation
