"""How long a substep may be, and why it may not be longer."""

from __future__ import annotations

import math

from pgsd_nerfstudio.physics.mpm.config import MpmConfig
from pgsd_nerfstudio.physics.mpm.layout import MATERIAL, J, V
from pgsd_nerfstudio.physics.mpm.particles import Particles


class Unstable(RuntimeError):
    """A step would need more substeps than allowed; the message names the cause."""


def longest_substep(particles: Particles, config: MpmConfig, seconds: float) -> float:
    """Seconds in which a sound wave and the fastest particle together travel `courant` cells.

    Raises:
        FloatingPointError: a quantity of a particle is not finite at this time of the simulation (`seconds`).
    """
    fastest = float(particles.signal[: particles.count].max())
    if not math.isfinite(fastest):
        particles.require_finite(seconds)
        raise FloatingPointError(f"the speed of sound is not finite at {seconds:.6g} s")
    reach = config.courant * config.dx
    longest = reach / max(fastest, 1e-30)
    pull = math.sqrt(sum(g * g for g in config.gravity))
    if pull > 0:  # for matter that starts from rest and has hardly any stiffness
        longest = min(longest, math.sqrt(reach / pull))
    return min(longest, config.max_dt or math.inf)


def refusal(particles: Particles, config: MpmConfig, seconds: float, needed: int, dt: float) -> Unstable:
    """The error to raise if a step of `seconds` needs too many substeps of dt."""
    p = particles
    worst = int(p.signal[: p.count].argmax())
    speed = float(p.state[worst, V : V + 3].norm())
    sound = max(float(p.signal[worst]) - speed, 0.0)
    matter = p.materials[int(p.tags[worst, MATERIAL])]
    if config.max_dt is not None and dt >= config.max_dt:
        cause, remedy = f"max_dt is {config.max_dt:g} s", "raise max_dt"
    elif speed > sound:
        cause, remedy = f"a particle of {matter.name} moves at {speed:.3g} m/s", "take shorter steps or a larger dx"
    else:
        cause, remedy = f"sound travels at {sound:.3g} m/s in {matter.name}", "use a softer material or a larger dx"
        if matter.name == "snow":
            cause += f" (plastic volume ratio {float(p.state[worst, J]):.2f})"
    return Unstable(
        f"a step of {seconds:g} s needs {needed} substeps of {dt:.2g} s at dx = {config.dx:g} m because {cause}; "
        f"allowed are {config.max_substeps}: {remedy}, or raise max_substeps"
    )
