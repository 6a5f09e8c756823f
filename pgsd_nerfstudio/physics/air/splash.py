"""Splashes of drops: droplets leave an impact with a share of its energy and fly until their next contact."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from pgsd_nerfstudio.effects.surface_response import Splash
from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.emitters import Newcomers
from pgsd_nerfstudio.physics.bodies import ANY_DISTANCE, DRIPPED, SPLASHED, Bodies

LIFT = 0.004  # m above the surface at which droplets start
STEEP = (35.0, 65.0)  # degrees above the surface, between which droplets fly off


def droplets_of(
    splash: Splash, drops: Bodies, masses: Float[ndarray, " n"], speeds: Float[ndarray, " n"]
) -> Int[ndarray, " n"]:
    """How many droplets each drop makes. Droplets of a splash make none.

    Args:
        splash: the effect's splashes.
        drops: particles at their contacts.
        masses: kg of one real drop.
        speeds: at the impact, m/s.
    """
    energy = 0.5 * masses * speeds**2
    count = np.minimum(np.floor(energy / splash.joule_per_droplet), splash.most).astype(int)
    return np.where(drops.kinds & SPLASHED, 0, count)


def splashed(
    air: Air, splash: Splash, drops: Bodies, normals: Float[ndarray, "n 3"], rng: np.random.Generator
) -> tuple[Bodies, Float[ndarray, " n"]]:
    """Droplets of impacts.

    A droplet represents as many real droplets as its drop represents real drops. All droplets of an impact together have the
    share `Splash.energy` of its kinetic energy, but no droplet is faster than the impact.

    Args:
        air: the air that droplets enter.
        splash: the effect's splashes.
        drops: particles at their contacts.
        normals: of the surface at the contacts.
        rng: source of the draws.

    Returns:
        The droplets, without ids, and the share of each drop's mass that its droplets carry off, 0-1.
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
    # What is seen of a crown is seen of it as a whole: all droplets of an impact share the draw of its drop.
    reaches = np.minimum(splash.diameter * drops.reaches[parent].astype(np.float64), float(ANY_DISTANCE))
    reaches[drops.reaches[parent] >= ANY_DISTANCE] = ANY_DISTANCE
    new = air.newborn(Newcomers(drops.positions[parent] + LIFT * normal, diameters, reaches), velocity, rng)
    needed = air.sight.needed(new.positions, new.reaches)
    new.represents[:] = drops.represents[parent]
    new.kinds[:] = drops.kinds[parent] & DRIPPED
    new = new.select(needed)
    return new.marked(SPLASHED), share
