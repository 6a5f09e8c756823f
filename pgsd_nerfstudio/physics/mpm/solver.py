"""The dense regime of the motion prior: matter that touches itself, by the material point method.

    snow = Mpm(MpmConfig(dx=0.02), Domain((-1, -1, 0), (1, 1, 2)), Obstacle.plane((0, 0, 0.1), (0, 0, 1)))
    snow.emit(positions, velocities, Snow(), volume=1e-6)
    snow.step(0.04)

MLS-MPM (Hu et al. 2018) with affine transfers. A step is divided as stability asks for: in a substep a sound wave and the
fastest particle together travel `courant` cells at most, with the speed of sound at the hardening and stretch of the moment.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import blocks, constitutive, contact, transfer
from pgsd_nerfstudio.physics.mpm.config import MpmConfig, Sleep
from pgsd_nerfstudio.physics.mpm.layout import ACTIVE, CELLS, MARGIN, MATERIAL, NODE, QUIET, RESTING, STATE, C, F, J, V, X
from pgsd_nerfstudio.physics.mpm.materials import Matter
from pgsd_nerfstudio.physics.mpm.obstacle import Obstacle
from pgsd_nerfstudio.physics.mpm.particles import Particles
from pgsd_nerfstudio.physics.mpm.report import Report
from pgsd_nerfstudio.physics.mpm.runtime import dtype_of, start, started


class Unstable(RuntimeError):
    """A step would need more substeps than allowed; the message names the cause."""


class Mpm:
    """Particles in a domain. Ids count up from 0 in the order of emission and stay."""

    def __init__(self, config: MpmConfig, domain: Domain, obstacle: Obstacle | None = None) -> None:
        """Lay out the grid.

        Raises:
            ValueError: the grid would have more than config.max_cells nodes.
        """
        self.config, self.domain, self.obstacle = config, domain, obstacle
        self.seconds, self.substeps = 0.0, 0
        _require_room(config, domain)
        self._start = start(config.device, config.precision, config.threads)
        real = {"dtype": dtype_of(config.precision), "device": config.device}
        self._particles = Particles(**real)
        self._blocks = blocks.Blocks.of(transfer.grid_shape(domain.size, config.dx), config.device)
        nodes = math.prod(self._blocks.shape) * CELLS
        self._grid = torch.zeros(nodes, NODE, **real)
        self._rest = torch.zeros(nodes if config.sleep else 1, 1, **real)
        self._resting = False
        self._atomic = config.device != "cpu"
        self._parts = len(obstacle.parts) if obstacle else 0
        self._wall = (obstacle or Obstacle(())).at_nodes(self._blocks.shape, domain.lower, config.dx).to(**real)

    def emit(
        self,
        positions: Float[Tensor, "n 3"],
        velocities: Float[Tensor, "n 3"],
        material: Matter,
        volume: float | Float[Tensor, "n"],
        deformation: Float[Tensor, "n 3 3"] | None = None,
    ) -> Int[Tensor, "n"]:
        """Add particles; returns their ids.

        Args:
            positions: m. One inside an obstacle is put onto its surface; one that cannot be, or that lies outside the domain,
                counts as removed.
            velocities: m/s.
            volume: m^3 of each particle at rest, from the density of the sampling (not from the grid).
            deformation: elastic deformation gradients; None: none. What starts under its own weight starts calmer with it.

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
            longest = self._longest_dt()
            needed = max(1, math.ceil(left / longest * (1 - 1e-9)))
            if done + needed > self.config.max_substeps:
                raise Unstable(self._cause(seconds, done + needed, longest))
            dt = left / needed
            self._substep(dt)
            done += 1
            self.substeps += 1
            self.seconds += dt
            left = left - dt if needed > 1 else 0.0
        self.seconds += left
        self._particles.require_finite(self.seconds)
        if self.config.sleep:
            self._fall_asleep(self.config.sleep)
        self._particles.relist()
        return done

    def wake(self) -> None:
        """Make all resting particles active again."""
        tags = self._particles.tags[: len(self)]
        tags[:, STATE][tags[:, STATE] == RESTING] = ACTIVE
        tags[:, QUIET] = 0
        self._rest.zero_()
        self._resting = False
        self._particles.relist()
        self._particles.respond(self._particles.active)

    def __len__(self) -> int:
        return self._particles.count

    @property
    def positions(self) -> Float[Tensor, "n 3"]:
        """m; a copy, as are the other read-outs (`.numpy(force=True)` for arrays). Of a removed particle: where it left."""
        x = self._rows(X, 3)
        return x + x.new_tensor(self.domain.lower)

    @property
    def velocities(self) -> Float[Tensor, "n 3"]:
        """m/s."""
        return self._rows(V, 3)

    @property
    def states(self) -> Int[Tensor, "n"]:
        """ACTIVE, RESTING or REMOVED."""
        return self._particles.tags[: len(self), STATE].clone()

    @property
    def deformations(self) -> Float[Tensor, "n 3 3"]:
        """Elastic deformation gradients."""
        return self._rows(F, 9).reshape(-1, 3, 3)

    @property
    def volume_ratios(self) -> Float[Tensor, "n"]:
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
        p, b, dx, (bx, by, bz) = self._particles, self._blocks, self.config.dx, self._blocks.shape
        count = len(p.active)
        blocks.clear(self._grid, b.table, b.lists, b.heads)
        listing = (p.state, p.tags, p.active, p.order, b.table, b.lists, b.heads, count, 1 / dx)
        if not self._atomic:
            blocks.sort(*listing, bx, by, bz)
            for colour in range(blocks.COLOURS):
                transfer.scatter_colour(p.state, self._grid, p.order, b.table, b.lists, b.heads, colour, dt, dx, by, bz)
            count = int(b.heads[blocks.N_PARTICLES])  # without those that left in this step
        else:
            blocks.touch(*listing, by, bz)
            transfer.scatter_atomic(p.state, p.tags, self._grid, p.order, count, dt, dx, by, bz)
        resting, size = int(self._resting), self.domain.size
        contact.move_nodes(self._grid, self._wall, self._rest, b.lists, b.heads, self._parts, resting, dt, *self.config.gravity)
        transfer.gather(p.state, p.tags, self._grid, self._wall, p.order, count, self._parts, dt, dx, by, bz, *size)
        constitutive.respond(p.state, p.tags, p.signal, p.table, p.order, count, dt)

    def _longest_dt(self) -> float:
        fastest = float(self._particles.signal[: len(self)].max())
        if not math.isfinite(fastest):
            self._particles.require_finite(self.seconds)
            raise FloatingPointError(f"the speed of sound is not finite at {self.seconds:.6g} s")
        reach = self.config.courant * self.config.dx
        longest = reach / max(fastest, 1e-30)
        pull = math.sqrt(sum(g * g for g in self.config.gravity))
        if pull > 0:  # for what starts from rest and has no stiffness to speak of
            longest = min(longest, math.sqrt(reach / pull))
        return min(longest, self.config.max_dt or math.inf)

    def _cause(self, seconds: float, needed: int, dt: float) -> str:
        p = self._particles
        worst = int(p.signal[: len(self)].argmax())
        speed = float(p.state[worst, V : V + 3].norm())
        sound = max(float(p.signal[worst]) - speed, 0.0)
        matter = p.materials[int(p.tags[worst, MATERIAL])]
        if self.config.max_dt is not None and dt >= self.config.max_dt:
            cause, remedy = f"max_dt is {self.config.max_dt:g} s", "raise max_dt"
        elif speed > sound:
            cause, remedy = f"a particle of {matter.name} moves at {speed:.3g} m/s", "take shorter steps or a larger dx"
        else:
            cause, remedy = f"sound travels at {sound:.3g} m/s in {matter.name}", "use a softer material or a larger dx"
            if matter.name == "snow":
                cause += f" (plastic volume ratio {float(p.state[worst, J]):.2f})"
        return (
            f"a step of {seconds:g} s needs {needed} substeps of {dt:.2g} s at dx = {self.config.dx:g} m because {cause}; "
            f"allowed are {self.config.max_substeps}: {remedy}, or raise max_substeps"
        )

    def _fall_asleep(self, sleep: Sleep) -> None:
        p, dx, (_, by, bz) = self._particles, self.config.dx, self._blocks.shape
        count = len(p.active)
        if count == 0:
            return
        limits = (self._parts, int(self._resting), sleep.speed, sleep.frames, dx, by, bz)
        contact.fall_asleep(p.state, p.tags, self._wall, self._rest, p.active, count, *limits)
        new = p.active[p.tags[p.active.long(), STATE] == RESTING]
        if len(new):
            p.state[new.long(), V : V + 3] = 0
            p.state[new.long(), C : C + 9] = 0
            p.signal[new.long()] = 0
            contact.deposit(p.state, self._rest, new, len(new), 1 / dx, by, bz)
            self._resting = True

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
