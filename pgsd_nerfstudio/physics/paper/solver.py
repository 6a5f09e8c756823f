"""The paper's solver: dynamic particles of one material among stationary ones, in a unit cube.

A frame takes 13 substeps of the published length. The original divides by zero or reads outside of its grid with stiff matter,
long steps or hardened snow. Here substeps are shortened until sound and the fastest particle together travel at most `courant`
cells, and a frame that would need more than `max_substeps` is refused before it blows up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm.layout import C, F, V, X
from pgsd_nerfstudio.physics.mpm.runtime import dtype_of, start, started
from pgsd_nerfstudio.physics.paper import kernels
from pgsd_nerfstudio.physics.paper.config import DENSITY, PASCAL, PaperConfig
from pgsd_nerfstudio.physics.paper.kernels import FRICTION_DEGREES, SAND, SNOW, WATER, WIDTH, J

MARGIN = 0.05  # boxes between the domain and the faces of the cube

_KINDS = {"snow": SNOW, "water": WATER, "sand": SAND}
_QUANTITIES = {
    "position": slice(X, X + 3),
    "velocity": slice(V, V + 3),
    "velocity gradient": slice(C, C + 9),
    "deformation": slice(F, F + 9),
    "volume ratio": slice(J, J + 1),
}


@dataclass(frozen=True)
class Box:
    """Place of the unit cube in metres. It is not rotated and has the same scale on all axes.

    The longest edge of the domain spans 0.05 .. 0.95 of the cube. The domain's floor is at height 0.05, and the domain is
    centred on the two horizontal axes. The paper stretches the vertical axis until it fills the cube; here shapes are kept.
    """

    corner: Float[ndarray, "3"]
    """Lower corner of the cube, in metres."""
    metres: float
    """Edge of the cube, in metres."""
    bounds: Float[ndarray, "2 3"]
    """Lower and upper corner of the domain, in boxes; particles outside have left the simulation."""

    @staticmethod
    def of(domain: Domain) -> Box:
        """The cube around a domain."""
        lower, size = np.asarray(domain.lower, np.float64), np.asarray(domain.size, np.float64)
        metres = float(size.max()) / (1 - 2 * MARGIN)
        edges = size / metres
        low = np.array([0.5 - edges[0] / 2, 0.5 - edges[1] / 2, MARGIN])
        return Box(lower - metres * low, metres, np.stack([low, low + edges]))

    def to_box(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """From metres to boxes."""
        return (np.asarray(points, np.float64) - self.corner) / self.metres

    def to_metres(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
        """From boxes to metres."""
        return self.corner + self.metres * np.asarray(points, np.float64)


class PaperSolver:
    """Particles in the cube, in the order of their birth; `keep` drops those that have ended."""

    def __init__(self, config: PaperConfig, box: Box, stationary: Float[ndarray, "s 3"]) -> None:
        """Allocate the grid and the stationary particles.

        Args:
            config: the numbers of the effect.
            box: place of the unit cube.
            stationary: positions of the stationary particles in boxes; those outside of the grid are left out.

        Raises:
            ValueError: a stationary position is not finite, or the device is not there.
        """
        self.config, self.box = config, box
        self.frame = 0
        """Frame that is being simulated or was simulated last."""
        self.substeps = 0
        self._start = start(config.device, config.precision, config.threads)
        self._real = {"dtype": dtype_of(config.precision), "device": config.device}
        points = torch.as_tensor(np.asarray(stationary, np.float64).reshape(-1, 3))
        if not points.isfinite().all():
            bad = int((~points.isfinite().all(1)).sum())
            raise ValueError(f"stationary positions must be finite, but {bad} of {len(points)} are not")
        low, high = 0.5 * config.dx, 1 - 1.5 * config.dx  # within, the stencil of a particle lies on the grid
        within = ((points >= low) & (points < high - 1e-6)).all(1)
        self.stationary = self._at_rest(points[within])
        self._all = torch.ones(len(self.stationary), dtype=torch.int32, device=config.device)
        self.state = torch.zeros(0, WIDTH, **self._real)
        """One row per particle: position, velocity, its gradient C, deformation F and the ratio J."""
        self._inside = torch.zeros(0, dtype=torch.int32, device=config.device)
        self._signal = torch.zeros(0, **self._real)
        self._grid = torch.zeros(config.cells**3, kernels.NODE, **self._real)
        self._bounds = torch.as_tensor(box.bounds).to(**self._real)

    def __len__(self) -> int:
        return len(self.state)

    @property
    def positions(self) -> Float[ndarray, "n 3"]:
        """Positions in boxes, a copy. A particle that left has its first position outside."""
        return self.state[:, X : X + 3].numpy(force=True).astype(np.float64)

    @property
    def velocities(self) -> Float[ndarray, "n 3"]:
        """Velocities in boxes/s, a copy."""
        return self.state[:, V : V + 3].numpy(force=True).astype(np.float64)

    @property
    def inside(self) -> Bool[ndarray, " n"]:
        """Which particles have not left the domain."""
        return self._inside.numpy(force=True) > 0

    @property
    def grid(self) -> Float[Tensor, "nodes 4"]:
        """Mass in kg and velocity in boxes/s of each node after the last substep."""
        return self._grid.clone()

    def emit(self, positions: Float[ndarray, "n 3"], velocities: Float[ndarray, "n 3"]) -> None:
        """Add particles without deformation and velocity gradient.

        Args:
            positions: boxes.
            velocities: boxes/s.

        Raises:
            RuntimeError: another solver has started Taichi anew since.
        """
        self._require_alive()
        new = self._at_rest(torch.as_tensor(positions))
        new[:, V : V + 3] = torch.as_tensor(velocities).to(**self._real)
        self.state = torch.cat([self.state, new])
        position, bounds = new[:, X : X + 3], self._bounds
        within = ((position >= bounds[0]) & (position <= bounds[1])).all(1)
        self._inside = torch.cat([self._inside, within.int()])
        self._signal = torch.cat([self._signal, new[:, V : V + 3].norm(dim=1) + self.config.sound_speed])

    def keep(self, which: Bool[ndarray, " n"]) -> None:
        """Keep only the chosen particles."""
        chosen = torch.as_tensor(which, device=self.config.device)
        self.state, self._inside, self._signal = self.state[chosen], self._inside[chosen], self._signal[chosen]

    def step(self) -> int:
        """Advance by one frame.

        Returns:
            The number of substeps; 0 where there are no particles.

        Raises:
            ValueError: more than `max_substeps` would be needed, and the message names the cause; or a quantity became NaN or
                infinite, and the message names the quantity and the frame.
            RuntimeError: another solver has started Taichi anew since.
        """
        self._require_alive()
        self.frame += 1
        done, left = 0, self.config.frame_seconds
        while left > 0 and len(self):
            longest = self._longest_dt()
            needed = max(1, math.ceil(left / longest * (1 - 1e-9)))
            if done + needed > self.config.max_substeps:
                raise ValueError(self._cause(done + needed, longest))
            dt = left / needed
            self.substep(dt)
            done += 1
            left = left - dt if needed > 1 else 0.0
        self.substeps += done
        self._require_finite()
        return done

    def substep(self, dt: float) -> None:
        """Advance without a check of stability.

        Args:
            dt: s.
        """
        config, count = self.config, len(self)
        mu, lam = config.moduli
        kind, mass = _KINDS[config.material], DENSITY * config.particle_volume
        low, high = config.plastic_range
        slope = (3 * lam + 2 * mu) / (2 * mu) * _cone() if mu else 0.0
        matter = (config.cells, kind, mu, lam, config.particle_volume, mass, low, high, slope)
        kernels.clear(self._grid)
        if len(self.stationary) and config.stationary == "mass":
            kernels.scatter_stationary(self.stationary, self._grid, len(self.stationary), mass, config.cells)
        elif len(self.stationary):
            kernels.scatter(self.stationary, self._all, self._grid, len(self.stationary), dt, *matter)
        kernels.scatter(self.state, self._inside, self._grid, count, dt, *matter)
        kernels.move(self._grid, dt, *config.gravity)
        where = (self.state, self._inside, self._signal, self._grid, self._bounds)
        kernels.gather(*where, count, dt, config.cells, kind, lam + 2 * mu, DENSITY)

    def _at_rest(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 25"]:
        """State rows of particles without velocity and deformation."""
        rows = torch.zeros(len(positions), WIDTH, **self._real)
        rows[:, X : X + 3] = positions.to(**self._real)
        rows[:, [F, F + 4, F + 8]] = 1.0
        rows[:, J] = 0.0 if self.config.material == "sand" else 1.0
        return rows

    def _longest_dt(self) -> float:
        fastest = float(self._signal.max())
        if not math.isfinite(fastest):
            self._require_finite()
            raise ValueError(f"the speed of sound is not finite in frame {self.frame}")
        reach = self.config.courant * self.config.dx
        pull = math.sqrt(sum(g * g for g in self.config.gravity))
        longest = min(self.config.step * self.config.dx, reach / fastest)
        return min(longest, math.sqrt(reach / pull)) if pull > 0 else longest

    def _cause(self, needed: int, dt: float) -> str:
        config, worst = self.config, int(self._signal.argmax())
        speed = float(self.state[worst, V : V + 3].norm())
        sound = float(self._signal[worst]) - speed
        if dt >= config.step * config.dx * (1 - 1e-9):
            cause, remedy = f"the longest step is {config.step:g} dx", "raise step"
        elif speed > sound:
            cause, remedy = f"a particle moves at {speed:.3g} boxes/s", "lower the initial velocity or gravity"
        else:
            ratio = f" (volume ratio {float(self.state[worst, J]):.2f})" if config.material != "sand" else ""
            cause = f"sound travels at {sound:.3g} boxes/s in {config.material} of {PASCAL * config.young:.3g} Pa{ratio}"
            remedy = "lower young"
        return (
            f"frame {self.frame} of {1e3 * config.frame_seconds:g} ms needs {needed} substeps of {dt:.2g} s on "
            f"{config.cells}^3 cells because {cause}; allowed are {config.max_substeps}: {remedy}, or raise max_substeps"
        )

    def _require_finite(self) -> None:
        if self.state.isfinite().all():
            return
        for name, columns in _QUANTITIES.items():
            bad = ~self.state[:, columns].isfinite().all(1)
            if bad.any():
                first = int(bad.nonzero()[0])
                raise ValueError(
                    f"the {name} of {int(bad.sum())} particles (first: {first}) is not finite in frame {self.frame}"
                )

    def _require_alive(self) -> None:
        if self._start != started():
            raise RuntimeError(
                "this PaperSolver can no longer run: another solver started Taichi with another precision, device or number of "
                "threads; make it anew"
            )


def _cone() -> float:
    """Opening of the Drucker-Prager cone through triaxial compression (Klar et al. 2016)."""
    sine = math.sin(math.radians(FRICTION_DEGREES))
    return math.sqrt(2 / 3) * 2 * sine / (3 - sine)
