"""The published numbers of the four effects.

Lengths are in edges of the unit cube ("boxes"), axis 2 points up, and seconds are those of the solver. The numbers are from the
supplement, "Motion Simulation Parameters" and "Implementation Details", and otherwise from the authors' code: E is in 1e6 Pa,
the density is 1000, the step is 2e-2 dx, a frame is 4 ms, rain and snow start in the upper sixth, and fog has the modulus and
Poisson's ratio below. Nothing is scaled to the scene: whatever its size, gravity is 9.8 boxes/s^2 and a particle fills a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from pgsd_nerfstudio.effects.effect import SurfaceResponse
from pgsd_nerfstudio.physics.mpm.materials import lame

Range = tuple[float, float]
Material = Literal["snow", "water", "sand"]

DENSITY = 1000.0  # kg/m^3
PASCAL = 1e6  # of `young`
SMALLEST_GRID = 32  # nodes per axis; with fewer, the margin of the domain is narrower than the stencil of a particle


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """One effect as the paper simulates it."""

    effect: str
    """Name of the effect."""
    material: Material
    """Snow (Stomakhin et al. 2013), water (pressure only) or sand (Drucker-Prager, friction angle of 45 degrees)."""
    young: float
    """Young's modulus in 1e6 Pa ("E_scale")."""
    poisson: float
    """Poisson's ratio, 0-0.49."""
    emit: int = 1000
    """Particles per emission."""
    emit_every: int = 2
    """Frames from one emission to the next; 0: a single emission in frame 0."""
    region: Literal["above", "side", "volume"] = "above"
    """Where particles start, uniformly: in the upper sixth of the domain, in the sixth at its lower x, or in all of it."""
    velocity: tuple[Range, Range, Range]
    """Bounds of the uniformly drawn initial velocity along each axis, in boxes/s."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.8)
    """boxes/s^2."""
    threshold: float = 0.001
    """Boxes per frame; a particle that moves less is taken to have collided, wherever it is. The default is 0.25 boxes/s."""
    stationary: Literal["mass", "particles"] = "mass"
    """How the scene's Gaussians are put onto the grid: as mass alone, or as whole particles whose deformation is decomposed and
    whose momentum of zero is added, as in the original. The motion is the same, the cost is not."""
    near: float = 3.0
    """Cells from the mesh within which a particle that came to rest is projected onto it. Particles share nodes with stationary
    particles up to 3 cells away, so snow stops 1.6 to 2.8 cells above the surface; the paper does not give a distance."""
    diameter: float
    """Metres, for rendering. The solver gives every particle the volume of a cell."""
    frame_seconds: float = 4e-3
    """Simulated seconds from frame to frame."""
    fps: float = 25.0
    """Frames shown per second: 500 frames, 2 s of simulation, take 20 s."""
    cells: int = 64
    """Cells of the grid per axis. Every substep clears and visits all of them."""
    step: float = 2e-2
    """Longest substep in seconds per box of cell width. The default makes 0.31 ms, 13 substeps in a frame."""
    courant: float = 0.5
    """Cells that sound and the fastest particle together may travel in a substep, which is shortened accordingly. The published
    step has 0.25 for snow that has not hardened."""
    max_substeps: int = 400
    """Most substeps of a frame; a frame that needs more is refused."""
    plastic_range: Range = (0.4, 20.0)
    """Bounds of the plastic volume ratio of snow and of the volume ratio of water. The upper bound also limits the logarithm of
    the volume that sand gained; the lower bound limits hardening, exp(10 (1 - Jp)), to 403. The paper has no bounds."""
    surface: SurfaceResponse = field(default_factory=SurfaceResponse)
    """Poses of landed particles. Slopes do not matter here, since all particles stay."""
    precision: Literal["f32", "f64"] = "f32"
    """Single precision as in the paper; double precision is for tests."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the solver."""
    threads: int = 0
    """Threads on the CPU; 0: all. Sums on the grid are atomic, so only a single thread gives the same bits twice."""

    def __post_init__(self) -> None:
        owner = f"paper {self.effect}"
        if self.material not in ("snow", "water", "sand"):
            raise ValueError(f"{owner}: the material must be snow, water or sand, got {self.material!r}")
        if self.stationary not in ("mass", "particles"):
            raise ValueError(f"{owner}: stationary must be mass or particles, got {self.stationary!r}")
        lame(owner, PASCAL * self.young, self.poisson)
        positive = ("threshold", "diameter", "frame_seconds", "fps", "step", "max_substeps")
        for name in positive:
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{owner}: {name} must be positive and finite, got {getattr(self, name):g}")
        if self.emit < 1 or self.emit_every < 0:
            raise ValueError(
                f"{owner}: an emission needs at least one particle and an interval of at least 0 frames, got {self.emit} and "
                f"{self.emit_every}"
            )
        if self.cells < SMALLEST_GRID:
            raise ValueError(f"{owner}: the grid needs at least {SMALLEST_GRID} cells per axis, got {self.cells}")
        if not 0 < self.courant <= 1:
            raise ValueError(f"{owner}: the Courant number must lie in 0-1, got {self.courant:g}")
        if not 0 < self.plastic_range[0] <= 1 <= self.plastic_range[1] < math.inf:
            raise ValueError(f"{owner}: the plastic range must satisfy 0 < low <= 1 <= high, got {self.plastic_range}")
        if not (math.isfinite(self.near) and self.near >= 0):
            raise ValueError(f"{owner}: near must be a finite number of cells >= 0, got {self.near:g}")
        if not all(map(math.isfinite, self.gravity)):
            raise ValueError(f"{owner}: gravity must be finite, got {self.gravity} boxes/s^2")
        if not all(math.isfinite(low) and low <= high < math.inf for low, high in self.velocity):
            raise ValueError(f"{owner}: each range of velocities must be finite and ascend, got {self.velocity} boxes/s")

    @property
    def dx(self) -> float:
        """Width of a cell in boxes."""
        return 1.0 / self.cells

    @property
    def particle_volume(self) -> float:
        """Volume of each particle, boxes^3: a whole cell, even where particles share a cell."""
        return self.dx**3

    @property
    def moduli(self) -> tuple[float, float]:
        """Shear modulus (0 for water) and first Lamé constant in Pa."""
        mu, lam = lame(f"paper {self.effect}", PASCAL * self.young, self.poisson)
        return (0.0 if self.material == "water" else mu), lam

    @property
    def sound_speed(self) -> float:
        """Speed of sound in matter that is neither strained nor hardened, boxes/s."""
        mu, lam = self.moduli
        return math.sqrt((lam + 2 * mu) / DENSITY)

    def perturbed(
        self, *, emission: float = 1.0, velocity: float = 1.0, stiffness: float = 1.0, threshold: float = 1.0
    ) -> PaperConfig:
        """The same config with four parameters scaled, as in the paper's test of robustness (0.5 and 1.5).

        Args:
            emission: factor on the particles per emission.
            velocity: factor on the initial velocities.
            stiffness: factor on Young's modulus.
            threshold: factor on the movement threshold.
        """
        x, y, z = (_scaled(bounds, velocity) for bounds in self.velocity)
        return replace(
            self,
            emit=round(emission * self.emit),
            velocity=(x, y, z),
            young=stiffness * self.young,
            threshold=threshold * self.threshold,
        )


def _scaled(bounds: Range, factor: float) -> Range:
    low, high = sorted(factor * bound for bound in bounds)
    return low, high


_SWAY = (-0.1, 0.1)
PAPER_EFFECTS: dict[str, PaperConfig] = {
    config.effect: config
    for config in (
        PaperConfig(
            effect="snowfall",
            material="snow",
            young=0.14,
            poisson=0.2,
            velocity=(_SWAY, _SWAY, (-0.5, -0.5)),
            diameter=0.004,
        ),
        PaperConfig(
            effect="rainfall",
            material="water",
            young=0.08,
            poisson=0.45,
            velocity=(_SWAY, _SWAY, (-0.5, -0.5)),
            diameter=0.002,
        ),
        PaperConfig(
            effect="sandstorm",
            material="sand",
            young=0.08,
            poisson=0.3,
            region="side",
            velocity=((0.8, 1.2), (-0.2, 0.2), (-0.2, 0.2)),
            diameter=0.001,
        ),
        PaperConfig(
            effect="fog",
            material="water",
            young=0.08,
            poisson=0.3,
            emit=5000,
            emit_every=0,
            region="volume",
            velocity=((0.4, 0.6), _SWAY, _SWAY),
            gravity=(0.5, 0.0, -0.1),
            diameter=0.02,
        ),
    )
}
"""The four effects of the paper by name."""


def paper_config(effect_name: str) -> PaperConfig:
    """The published numbers of an effect.

    Raises:
        ValueError: the paper has no effect of that name; the message names its effects.
    """
    if effect_name not in PAPER_EFFECTS:
        raise ValueError(f"the paper simulates {', '.join(sorted(PAPER_EFFECTS))}, not {effect_name!r}")
    return PAPER_EFFECTS[effect_name]
