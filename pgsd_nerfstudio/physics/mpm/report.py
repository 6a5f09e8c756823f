"""Sums over a simulation: masses by state, momenta, energies. Everything is summed in double precision."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgsd_nerfstudio.physics.mpm.layout import ACTIVE, ENERGY, MASS, REMOVED, RESTING, STATE, C, V, X


@dataclass(frozen=True)
class Report:
    """Sums over all particles; momenta and energies over those that have not left the domain."""

    seconds: float
    """Simulated time so far."""
    substeps: int
    active: int
    resting: int
    removed: int
    """Particles by state."""
    mass_active: float
    mass_resting: float
    mass_removed: float
    """kg."""
    momentum: tuple[float, float, float]
    """kg m/s."""
    angular_momentum: tuple[float, float, float]
    """About the origin, with the spin that particles carry, kg m^2/s."""
    kinetic: float
    """J, with the affine part of the particles' motion."""
    potential: float
    """J, relative to the height of the origin."""
    elastic: float
    """J."""

    @property
    def mass(self) -> float:
        """Mass of all particles ever emitted, kg."""
        return self.mass_active + self.mass_resting + self.mass_removed

    @property
    def energy(self) -> float:
        """Kinetic, potential and elastic, in J."""
        return self.kinetic + self.potential + self.elastic

    @staticmethod
    def of(
        state: Tensor,
        tags: Tensor,
        *,
        lower: tuple[float, float, float],
        gravity: tuple[float, float, float],
        dx: float,
        seconds: float,
        substeps: int,
    ) -> Report:
        """Sum over particles.

        Args:
            state: rows of the particles, as `layout` describes them.
            tags: their whole numbers.
            lower: lower corner of the domain, m.
            gravity: m/s^2.
            dx: spacing of the grid, m.
            seconds: simulated time so far.
            substeps: substeps so far.
        """
        condition = tags[:, STATE]
        here = condition != REMOVED
        rows = state.double()
        mass = rows[:, MASS]
        m, x, v = mass[here], rows[here, X : X + 3] + rows.new_tensor(lower), rows[here, V : V + 3]
        affine = rows[here, C : C + 9].reshape(-1, 3, 3)
        inertia = dx * dx / 4  # second moment of the quadratic spline
        spin = torch.stack([affine[:, i, j] - affine[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1) * inertia
        momentum = (m[:, None] * v).sum(0).tolist()
        angular = (m[:, None] * (torch.linalg.cross(x, v) + spin)).sum(0).tolist()
        return Report(
            seconds=seconds,
            substeps=substeps,
            active=int((condition == ACTIVE).sum()),
            resting=int((condition == RESTING).sum()),
            removed=int((condition == REMOVED).sum()),
            mass_active=float(mass[condition == ACTIVE].sum()),
            mass_resting=float(mass[condition == RESTING].sum()),
            mass_removed=float(mass[condition == REMOVED].sum()),
            momentum=(momentum[0], momentum[1], momentum[2]),
            angular_momentum=(angular[0], angular[1], angular[2]),
            kinetic=float(0.5 * (m * ((v * v).sum(1) + inertia * (affine * affine).sum((1, 2)))).sum()),
            potential=float(-(m * (x @ rows.new_tensor(gravity))).sum()),
            elastic=float(rows[here, ENERGY].sum()),
        )
