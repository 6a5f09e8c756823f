"""The dense regime of the motion prior: matter that touches itself, by the material point method.

    snow = Mpm(MpmConfig(dx=0.02), Domain((-1, -1, 0), (1, 1, 2)), Obstacle.plane((0, 0, 0.1), (0, 0, 1)))
    snow.emit(positions, velocities, Snow(), volume=1e-6)
    snow.step(0.04)

MLS-MPM (Hu et al. 2018) with affine transfers. A step is divided as stability asks for: in a substep a sound wave and the
fastest particle together travel `courant` cells at most, with the speed of sound at the hardening and stretch of the moment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import blocks, constitutive, substep, transfer
from pgsd_nerfstudio.physics.mpm.config import MpmConfig
from pgsd_nerfstudio.physics.mpm.layout import CELLS, MARGIN, NODE, RESTING, STATE, F, J, V, X
from pgsd_nerfstudio.physics.mpm.materials import Matter
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.particles import Particles
from pgsd_nerfstudio.physics.mpm.report import Report
from pgsd_nerfstudio.physics.mpm.rest import Rest
from pgsd_nerfstudio.physics.mpm.runtime import dtype_of, start, started
from pgsd_nerfstudio.physics.mpm.snapshot import materials_as_tensor, materials_from, require_fitting
from pgsd_nerfstudio.physics.mpm.stability import longest_substep, refusal


class Mpm:
    """Particles in a domain. Ids count up from 0 in the order of emission and stay."""

    def __init__(self, config: MpmConfig, domain: Domain, obstacle: Obstacle | None = None) -> None:
        """Lay out the grid.

        Raises:
            ValueError: the grid would have more than config.max_cells nodes, or a plate is thinner than two cells.
        """
        self.config, self.domain, self.obstacle = config, domain, obstacle
        self.seconds, self.substeps = 0.0, 0
        _require_room(config, domain)
        if obstacle is not None:
            obstacle.require_thick(config.dx)
        self._start = start(config.device, config.precision, config.threads)
        real = {"dtype": dtype_of(config.precision), "device": config.device}
        self._particles = Particles(**real)
        self._blocks = blocks.Blocks(transfer.grid_shape(domain.size, config.dx), **real)
        nodes = math.prod(self._blocks.shape) * CELLS
        self._grid = torch.zeros(nodes, NODE, **real)
        self._rest = Rest(config.sleep, self._blocks, config.dx, **real)
        self._atomic = config.device != "cpu"
        self._parts = len(obstacle.parts) if obstacle else 0
        self._wall = (obstacle or Obstacle(())).at_nodes(self._blocks.shape, domain.lower, config.dx).to(**real)

    def emit(
        self,
        positions: Float[Tensor, "n 3"],
        velocities: Float[Tensor, "n 3"],
        material: Matter,
        volume: float | Float[Tensor, " n"],
        deformation: Float[Tensor, "n 3 3"] | None = None,
    ) -> Int[Tensor, " n"]:
        """Add particles; returns their ids.

        Args:
            positions: m. One inside an obstacle is put onto its surface; one that cannot be, or that lies outside the domain,
                counts as removed.
            velocities: m/s.
            volume: m^3 of each particle at rest, from the density of the sampling (not from the grid).
            deformation: elastic deformation gradients; None: none. Matter under its own weight starts calmer with them.

        Raises:
            ValueError: shapes do not fit, a value is not finite, or a volume is not positive.
        """
        self._require_alive()
        x, v = _plain(positions).reshape(-1, 3), _plain(velocities).reshape(-1, 3)
        size = _plain(volume).expand(len(x))
        f = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3) if deformation is None else _plain(deformation)
        if v.shape != x.shape or f.shape != (len(x), 3, 3):
            raise ValueError(f"{len(x)} positions need as many velocities and deformations, got {len(v)} and {len(f)}")
        for name, values in (("positions", x), ("velocities", v), ("volumes", size), ("deformations", f)):
            if not values.isfinite().all():
                raise ValueError(f"emitted {name} must be finite, but {int((~values.isfinite()).sum())} values are not")
        if not (size > 0).all():
            raise ValueError(f"particle volumes must be positive, got {float(size.min()):g} m^3")
        if not (torch.linalg.det(f) > 0).all():
            raise ValueError("deformation gradients must have a positive determinant")
        removed = torch.zeros(len(x), dtype=torch.bool)
        if self.obstacle is not None:
            x = self.obstacle.freed(x)
            removed = self.obstacle.distance(x) < -0.1 * self.config.dx
        x = x - x.new_tensor(self.domain.lower)
        removed |= ~((x >= 0) & (x <= x.new_tensor(self.domain.size))).all(1)
        return self._particles.add(x, v, f, size, removed, material)

    def step(self, seconds: float) -> int:
        """Advance by `seconds`, in as many substeps as stability asks for; returns how many there were.

        Raises:
            Unstable: more than config.max_substeps would be needed; the message names the cause. Mostly this is known before
                anything has moved; where matter stiffens on the way, what was simulated so far is kept.
            FloatingPointError: a quantity became NaN or infinite; the message names it.
        """
        self._require_alive()
        if not (math.isfinite(seconds) and seconds >= 0):
            raise ValueError(f"a step takes a finite number of seconds >= 0, got {seconds:g}")
        done, left = 0, seconds
        while left > 0 and len(self._particles.active):
            longest = longest_substep(self._particles, self.config, self.seconds)
            needed = max(1, math.ceil(left / longest * (1 - 1e-9)))
            if done + needed > self.config.max_substeps:
                raise refusal(self._particles, self.config, seconds, done + needed, longest)
            dt = left / needed
            self._substep(dt)
            done += 1
            self.substeps += 1
            self.seconds += dt
            left = left - dt if needed > 1 else 0.0
        self.seconds += left
        self._particles.require_finite(self.seconds)
        self._rest.settle(self._particles, self._wall, self._parts)
        self._particles.relist()
        return done

    def wake(self) -> None:
        """Make all resting particles active again. Matter that is hit fast enough (`Sleep.wake_speed`) wakes by itself."""
        self._rest.wake(self._particles, torch.nonzero(self.states == RESTING)[:, 0])

    def snapshot(self) -> dict[str, Tensor]:
        """All that the next step depends on, as copies on the CPU; `restore` takes it, in this or in another process."""
        p = self._particles
        return {
            "state": p.state[: p.count].cpu().clone(),
            "tags": p.tags[: p.count].cpu().clone(),
            "signal": p.signal[: p.count].cpu().clone(),
            "materials": materials_as_tensor(p.materials),
            **self._rest.saved(),
            "seconds": torch.tensor(self.seconds, dtype=torch.float64),
            "substeps": torch.tensor(self.substeps),
            "setting": self._setting,
        }

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Go on from a snapshot and forget all that was simulated here before. The steps that follow are bit for bit those that
        would have followed there.

        Raises:
            ValueError: the snapshot was taken with another config, domain or obstacle, or is not one.
        """
        self._require_alive()
        require_fitting(snapshot, self._setting, self._particles.state.dtype)
        materials = materials_from(snapshot["materials"])
        self._particles.restore(snapshot["state"], snapshot["tags"], snapshot["signal"], materials)
        self._rest.restore(snapshot["rest_nodes"], snapshot["rest"], self._particles)
        self.seconds, self.substeps = float(snapshot["seconds"]), int(snapshot["substeps"])

    @cached_property
    def _setting(self) -> Tensor:
        """Numbers that differ where config, domain or obstacle do."""
        c, d = self.config, self.domain
        own = [c.dx, *d.lower, *d.upper, *c.gravity, float(c.sleep is not None), float(self._parts)]
        return torch.cat([torch.tensor(own, dtype=torch.float64), self._wall.double().sum(0).cpu()])

    def __len__(self) -> int:
        return self._particles.count

    @property
    def positions(self) -> Float[Tensor, "n 3"]:
        """m; a copy, as are the other read-outs (`.numpy(force=True)` for arrays). A removed particle stays where it left."""
        x = self._rows(X, 3)
        return x + x.new_tensor(self.domain.lower)

    @property
    def velocities(self) -> Float[Tensor, "n 3"]:
        """m/s."""
        return self._rows(V, 3)

    @property
    def states(self) -> Int[Tensor, " n"]:
        """ACTIVE, RESTING or REMOVED."""
        return self._particles.tags[: len(self), STATE].clone()

    @property
    def deformations(self) -> Float[Tensor, "n 3 3"]:
        """Elastic deformation gradients."""
        return self._rows(F, 9).reshape(-1, 3, 3)

    @property
    def volume_ratios(self) -> Float[Tensor, " n"]:
        """Water: volume relative to that at rest; snow: plastic volume ratio; sand: logarithm of the volume it gained."""
        return self._rows(J, 1)[:, 0]

    def report(self) -> Report:
        """Masses, momenta and energies."""
        return Report.of(
            self._particles.state[: len(self)],
            self._particles.tags[: len(self)],
            lower=self.domain.lower,
            gravity=self.config.gravity,
            dx=self.config.dx,
            seconds=self.seconds,
            substeps=self.substeps,
        )

    def _rows(self, column: int, width: int) -> Tensor:
        return self._particles.state[: len(self), column : column + width].clone()

    def _substep(self, dt: float) -> None:
        p, b, dx, count = self._particles, self._blocks, self.config.dx, len(self._particles.active)
        bx, by, bz = b.shape
        space = (self._grid, self._wall, self._rest.shares)
        contacts = (self._parts, int(self._rest.any), self._rest.wake_speed)
        geometry = (dt, dx, by, bz, *self.config.gravity, *self.domain.size)
        tables = (b.table, b.lists, b.heads)
        if self._atomic:
            order = p.active
            substep.advance_atomic(p.state, p.tags, order, *tables, *space, count, *contacts, *geometry)
        else:
            order = p.order
            blocks.sort(p.state, p.tags, p.active, order, *tables, count, 1 / dx, bx, by, bz)
            b.make_room()
            count = int(b.heads[blocks.N_PARTICLES])  # without those that left in this step
            substep.advance(p.state, p.tags, order, *tables, b.halo, *space, *contacts, *geometry)
        constitutive.respond(p.state, p.tags, p.signal, p.table, order, count, dt)
        self._rest.wake_marked(p)

    def _require_alive(self) -> None:
        if self._start != started():
            raise RuntimeError(
                "this Mpm can no longer run: another one started Taichi with another precision, device or number of threads; "
                "make it anew"
            )


def _plain(values: float | Tensor) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64).detach().cpu()


def _require_room(config: MpmConfig, domain: Domain) -> None:
    cells = math.prod(length / config.dx + 2 * MARGIN + 1 for length in domain.size)
    if not cells <= config.max_cells:
        raise ValueError(
            f"a domain of {' x '.join(f'{length:g}' for length in domain.size)} m at dx = {config.dx:g} m needs {cells:.3g} "
            f"grid nodes, allowed are {config.max_cells:.3g}; use a smaller domain, or dx = "
            f"{config.dx * (cells / config.max_cells) ** (1 / 3):.2g} m"
        )
