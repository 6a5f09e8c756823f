"""The crown of a drop: droplets that leave an impact with a share of its energy and live until they come down again."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.effects.surface_response import Splash
from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.bodies import SPLASHED, Bodies

LIFT = 0.004  # m above the surface at which droplets begin
STEEP = (35.0, 65.0)  # degrees above the surface, between which a crown throws its droplets


def droplets_of(
    splash: Splash, drops: Bodies, masses: Float[ndarray, " n"], speeds: Float[ndarray, " n"]
) -> Int[ndarray, " n"]:
    """How many droplets each drop makes; `masses` in kg of one real drop, `speeds` at impact in m/s. Droplets make none."""
    energy = 0.5 * masses * speeds**2
    count = np.minimum(np.floor(energy / splash.joule_per_droplet), splash.most).astype(int)
    return np.where(drops.kinds & SPLASHED, 0, count)


def splashed(
    air: Air, splash: Splash, drops: Bodies, normals: Float[ndarray, "n 3"], rng: np.random.Generator
) -> tuple[Bodies, Float[ndarray, " n"]]:
    """Droplets of impacts at the drops' positions, without ids, and the share of each drop that they carry off.

    Each stands for as many real ones as its drop does. Together they have `Splash.energy` of the impact's kinetic energy, but
    none is faster than the impact.
    """
    material = air.effect.material
    masses = material.mass(drops.diameters.astype(np.float64))
    speeds = np.linalg.norm(drops.velocities.astype(np.float64), axis=1)
    counts = droplets_of(splash, drops, masses, speeds)
    parent = np.repeat(np.arange(len(drops)), counts)
    share = counts * splash.diameter**3
    if len(parent) == 0:
        return Bodies.none(), share
    diameters = drops.diameters[parent].astype(np.float64) * splash.diameter
    energy = 0.5 * masses * speeds**2 * splash.energy
    fast = np.sqrt(2 * energy[parent] / (counts[parent] * material.mass(diameters)))
    fast = np.minimum(fast, speeds[parent]) * rng.uniform(0.6, 1.0, len(parent))
    normal = normals[parent].astype(np.float64)
    tangent = np.cross(normal, rng.normal(size=normal.shape))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True).clip(1e-9)
    steep = np.radians(rng.uniform(*STEEP, len(parent)))[:, None]
    velocity = fast[:, None] * (np.sin(steep) * normal + np.cos(steep) * tangent)
    new = air.newborn(drops.positions[parent] + LIFT * normal, diameters, velocity, rng)
    new.represents[:] = drops.represents[parent]
    return new.marked(SPLASHED), share
