"""Figures of the room dynamics: an untrained field changes nothing, frames do not depend on how they are reached; cost."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pgsd_nerfstudio.dynamics import (
    DynamicsField,
    LearnedLook,
    RegularizationWeights,
    Rollout,
    regularization,
)
from pgsd_nerfstudio.dynamics.regularizers import rotation_angle
from pgsd_nerfstudio.effects import SNOWFALL
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.rows import drift as rows_drift
from pgsd_nerfstudio.laboratory.rows import motion as rows_motion
from pgsd_nerfstudio.laboratory.rows.motion import CLIP, DOMAIN, FIELDS, changed, rollout
from pgsd_nerfstudio.laboratory.timing import best
from pgsd_nerfstudio.physics import Clock, ParticleHistory, simulate_metric
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


def verify(quick: bool) -> list[Record]:
    """Laws with known answers."""
    roll = rollout(_snow(150 if quick else 600, 60 if quick else 250), weights=0.0)
    return [
        Record.judged(
            "values an untrained field changes", changed(roll), "", "<= 0", source="simulation and initial look, bit for bit"
        ),
        Record.judged(
            "frame by random access against window, float32",
            _access_error(rollout(roll.history, weights=0.1)),
            "",
            "<= 5e-6",
            source="largest difference of any value (metres, 0..1)",
        ),
        Record.judged(
            "values not finite, random weights x100",
            _not_finite(rollout(roll.history, weights=10.0)),
            "",
            "<= 0",
            source=f"all Gaussians of {roll.history.frames} frames",
        ),
        Record.judged(
            "landing beside the simulated contact",
            _landing_error(rollout(roll.history, weights=1.0)),
            "m",
            "<= 0",
            source="learned offsets fade before contact",
        ),
        Record.judged(
            "gradient through 9 frames, float64",
            _gradient_error(_in_float64(rollout(_snow(50, 30), weights=0.01))),
            "",
            "<= 1e-5",
            source="relative, against central differences",
        ),
        Record.judged(
            "rotation loss: largest gradient at equal orientations",
            _rotation_gradient(),
            "",
            "<= 2.1",
            source="the published 2 arccos|q.q0| gives infinity and NaN there",
        ),
        *rows_motion.rows(roll.history),
    ]


def bench(quick: bool) -> list[Record]:
    """Cost beside error: of a frame, and of a training clip."""
    history = _snow(2000 if quick else 20_000, 40 if quick else 150)
    roll = rollout(history, weights=0.1)
    roll.refresh()
    start = history.frames - CLIP
    count = len(history.active(start)) + len(history.resting(start))
    error = _float_error(roll)
    unit = {"error": error, "error_unit": "m, float32 against float64 over the sequence"}
    untrained = rollout(history, weights=0.0)
    frame = best(lambda: roll.window(start, 1, begin="simulation"), 4)
    clip = best(lambda: _train(roll, start), 4)
    shown = best(lambda: untrained.gaussians(start), 4)
    per_particle = 1e6 / count
    return [
        Record("particles in the benchmark's frames", count, "", source=f"{len(history):,} over {history.frames} frames"),
        Record("one frame of the roll-out, per particle", frame * per_particle, "µs", **unit),
        Record(f"clip of {CLIP} frames with gradient, per particle and frame", clip * per_particle / CLIP, "µs", **unit),
        Record("one frame of an untrained roll-out, per particle", shown * per_particle, "µs", 0.0, "m"),
        *rows_drift.rows(quick),
    ]


def _snow(most: int, frames: int) -> ParticleHistory:
    corners = torch.tensor([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
    ground = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    return simulate_metric(ground, SNOWFALL, Clock(frames=frames), DOMAIN, max_particles=most, progress=False)


def _in_float64(roll: Rollout) -> Rollout:
    def look(of: ParticleLook) -> ParticleLook:
        return ParticleLook(of.opacity.double(), of.scales.double(), of.rgb.double())

    names = ("positions", "rest_positions", "rest_quats", "quats")
    history = replace(roll.history, **{name: getattr(roll.history, name).double() for name in names})
    looks = InitialLook(look(roll.look.active), look(roll.look.collided), roll.look.settle_seconds)
    field = DynamicsField.for_history(history).double()
    field.load_state_dict(roll.field.state_dict())
    return Rollout(history, looks, field, LearnedLook().double())


def _access_error(roll: Rollout) -> float:
    """Frames in descending order, so that each is rolled from the kept state before it."""
    start, worst = len(roll) // 2 + 3, 0.0
    direct = {frame: roll.gaussians(frame) for frame in reversed(range(start, start + CLIP))}
    with torch.no_grad():
        for instant in roll.window(start, CLIP):
            pairs = [(getattr(direct[instant.frame], name), getattr(instant.gaussians, name)) for name in FIELDS]
            worst = max([worst, *(float((a - b).abs().max()) for a, b in pairs)])
    return worst


def _not_finite(roll: Rollout) -> int:
    return sum(int((~torch.isfinite(getattr(r.gaussians, name))).sum()) for r in roll.frames() for name in FIELDS)


def _landing_error(roll: Rollout) -> float:
    """Largest learned offset in the last active frame, of particles that land."""
    worst = 0.0
    for instant in roll.frames():
        landing = roll.history.collided[instant.active] & (roll.history.ends[instant.active] == instant.frame + 1)
        worst = max([worst, *instant.offset[landing].abs().flatten().tolist()])
    return worst


def _gradient_error(roll: Rollout) -> float:
    """Relative error of the derivative along one direction of all weights, for colours that stay clear of white: where a value
    saturates, its gradient is one-sided on purpose."""
    active, collided = (replace(state, rgb=0.8 * state.rgb) for state in (roll.look.active, roll.look.collided))
    roll = Rollout(roll.history, InitialLook(active, collided, roll.look.settle_seconds), roll.field)
    start = len(roll) - CLIP
    parameters = list(roll.field.parameters())
    rng = torch.Generator().manual_seed(0)
    direction = [torch.randn(p.shape, generator=rng, dtype=p.dtype) for p in parameters]

    def value() -> Tensor:
        clip = roll.window(start, CLIP, begin="simulation")
        return torch.stack([getattr(r.gaussians, name).sin().sum() for r in clip for name in FIELDS]).sum()

    gradients = torch.autograd.grad(value(), parameters)
    slope = float(sum((g * d).sum() for g, d in zip(gradients, direction, strict=True)))
    step, ends = 1e-7, []  # larger ones cross a kink of the ReLUs now and then
    with torch.no_grad():
        for sign in (1, -2):
            for p, d in zip(parameters, direction, strict=True):
                p += sign * step * d
            ends.append(float(value()))
    return abs((ends[0] - ends[1]) / (2 * step) - slope) / abs(slope)


def _rotation_gradient() -> float:
    quats = torch.nn.functional.normalize(torch.randn(100, 4, generator=torch.Generator().manual_seed(0)), dim=1)
    turned = quats.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(rotation_angle(turned, quats).sum(), turned)
    return float(gradient.norm(dim=1).max()) if bool(torch.isfinite(gradient).all()) else 1e9


def _float_error(roll: Rollout) -> float:
    frame = len(roll) - 1
    exact = _in_float64(roll).gaussians(frame).means
    return float((roll.gaussians(frame).means - exact).norm(dim=1).max())


def _train(roll: Rollout, start: int) -> None:
    clip = roll.window(start, CLIP, begin="simulation")
    loss = RegularizationWeights().total(regularization(clip, roll.learned_look))
    torch.stack([loss, *(getattr(r.gaussians, name).sum() for r in clip for name in FIELDS)]).sum().backward()
