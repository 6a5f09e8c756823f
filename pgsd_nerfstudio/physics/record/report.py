"""Report on a simulation, frame by frame: particles by state, their mass, momentum and energy."""

from __future__ import annotations

from typing import Any

import torch

from pgsd_nerfstudio.effects.effect import Material
from pgsd_nerfstudio.physics.bodies import GRAVITY, SPLASHED
from pgsd_nerfstudio.physics.record.history import ParticleHistory


def report(history: ParticleHistory, material: Material) -> dict[str, Any]:
    """Plain values for JSON. Mass, momentum and energy are those of the represented real particles.

    Args:
        history: the trajectories.
        material: gives the mass of a particle of each diameter.

    Returns:
        Totals, and under `per_frame` lists with one entry per frame: numbers of active particles (`in_air`) and of particles at
        rest (`resting`); `mass_in_air` and `mass_resting` in kg; `momentum` [3] in kg m/s and `kinetic_energy` in J of the
        active particles; `potential_energy` in J of all particles, relative to height 0.
    """
    masses = material.mass(history.diameters.double().cpu()) * history.represents.double().cpu()
    rows: dict[str, list[Any]] = {
        name: []
        for name in ("in_air", "resting", "mass_in_air", "mass_resting", "momentum", "kinetic_energy", "potential_energy")
    }
    for frame in range(history.frames):
        active, resting = history.active(frame), history.resting(frame)
        velocity = history.displacement_at(frame, active).double().cpu() * history.fps
        active_masses, resting_masses = masses[active.cpu()], masses[resting.cpu()]
        heights = history.positions_at(frame, active)[:, 2].double().cpu()
        resting_heights = history.rest_positions[resting][:, 2].double().cpu()
        rows["in_air"].append(len(active))
        rows["resting"].append(len(resting))
        rows["mass_in_air"].append(float(active_masses.sum()))
        rows["mass_resting"].append(float(resting_masses.sum()))
        rows["momentum"].append((active_masses[:, None] * velocity).sum(0).tolist())
        rows["kinetic_energy"].append(float((0.5 * active_masses * velocity.square().sum(1)).sum()))
        potential = (active_masses * heights).sum() + (resting_masses * resting_heights).sum()
        rows["potential_energy"].append(GRAVITY * float(potential))
    ended = history.ends.cpu() < history.frames
    # Splash droplets are part of drops that have ended, so their mass does not count as emitted, and only the rest of such a
    # drop is gone.
    droplets = (history.kinds.cpu() & SPLASHED) > 0
    emitted = float(masses[~droplets].sum())
    gone = float(masses[ended & ~history.collided.cpu()].sum()) - float(masses[droplets].sum())
    return {
        "about": dict(history.about),
        "frames": history.frames,
        "fps": history.fps,
        "particles": len(history),
        "particle_frames": int(history.positions.shape[0]),
        "bytes": sum(t.nbytes for t in vars(history).values() if isinstance(t, torch.Tensor)),
        "mass_emitted": emitted,
        "mass_gone": gone,
        "mass_lost": emitted - gone - rows["mass_in_air"][-1] - rows["mass_resting"][-1],
        "per_frame": rows,
    }
