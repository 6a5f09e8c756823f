"""What a simulated weather holds, frame by frame: how many particles in which state, their mass, momentum and energy."""

from __future__ import annotations

from typing import Any

import torch

from pgsd_nerfstudio.effects.effect import Material
from pgsd_nerfstudio.physics.bodies import GRAVITY, SPLASHED
from pgsd_nerfstudio.physics.record.history import ParticleHistory


def report(history: ParticleHistory, material: Material) -> dict[str, Any]:
    """Plain values for JSON. Mass, momentum and energy are those of the real particles that the simulated ones stand for.

    Lists have one number for each frame: particles `in_air` (all on their way) and `resting`; `mass_in_air` and
    `mass_resting` in kg; `momentum`
    [3] in kg m/s and `kinetic_energy` in J of what is in the air; `potential_energy` in J of all, above height 0.
    """
    masses = material.mass(history.diameters.double().cpu()) * history.represents.double().cpu()
    rows: dict[str, list[Any]] = {
        name: []
        for name in ("in_air", "resting", "mass_in_air", "mass_resting", "momentum", "kinetic_energy", "potential_energy")
    }
    for frame in range(history.frames):
        flying, lying = history.active(frame), history.resting(frame)
        velocity = history.displacement_at(frame, flying).double().cpu() * history.fps
        heavy, heights = masses[flying.cpu()], history.positions_at(frame, flying)[:, 2].double().cpu()
        resting_heights = history.rest_positions[lying][:, 2].double().cpu()
        rows["in_air"].append(len(flying))
        rows["resting"].append(len(lying))
        rows["mass_in_air"].append(float(heavy.sum()))
        rows["mass_resting"].append(float(masses[lying.cpu()].sum()))
        rows["momentum"].append((heavy[:, None] * velocity).sum(0).tolist())
        rows["kinetic_energy"].append(float((0.5 * heavy * velocity.square().sum(1)).sum()))
        potential = (heavy * heights).sum() + (masses[lying.cpu()] * resting_heights).sum()
        rows["potential_energy"].append(GRAVITY * float(potential))
    ended = history.ends.cpu() < history.frames
    # Droplets of a splash are part of drops that have ended: what such a drop left behind is the rest of it.
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
