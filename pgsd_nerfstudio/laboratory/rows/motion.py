"""Figures of what can be chosen in the room dynamics: what the field may change, how far the gradient runs, where clips begin,
and which motion a drifted particle follows."""

from __future__ import annotations

from dataclasses import replace

import torch

from pgsd_nerfstudio.dynamics import (
    Deformation,
    DeformedCloud,
    DynamicsField,
    FieldConfig,
    LearnedLook,
    Motion,
    Rollout,
    VelocityField,
    gaps,
    scattered,
)
from pgsd_nerfstudio.dynamics.state import LANDING_FRAMES, advance, simulated
from pgsd_nerfstudio.effects import SNOWFALL
from pgsd_nerfstudio.effects.appearance import initial_look
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics import Domain, ParticleHistory

DOMAIN = Domain((-3.0, -3.0, -0.2), (3.0, 3.0, 4.0))
FIELDS = ("means", "quats", "scales", "opacities", "colors")
CLIP = 9
OPTIONS: tuple[tuple[Motion, FieldConfig], ...] = (
    ("field", FieldConfig()),
    ("particle", FieldConfig(rotation=False)),
    ("particle", FieldConfig(appearance="shared")),
    ("particle", FieldConfig(appearance="fixed")),
    ("field", FieldConfig(rotation=False, appearance="shared")),
)


def rows(history: ParticleHistory) -> list[Record]:
    """Laws with known answers, of particles that fall and land."""
    return [*_options(history), *_flow(history)]


def _options(history: ParticleHistory) -> list[Record]:
    """Laws of what can be chosen: what the field changes, how far the gradient runs, where clips begin, motion without it."""
    different = sum(changed(rollout(history, weights=0.0, motion=motion, config=config), CLIP) for motion, config in OPTIONS)
    trained = rollout(history, weights=0.1)
    clips = [(start, CLIP) for start in range(0, history.frames - CLIP, 2 * CLIP)]
    found = gaps(trained, clips)
    paper, ours = found["simulation"], found["rollout"]
    return [
        Record.judged("values an untrained field changes, by option", different, "", "<= 0", source=f"{len(OPTIONS)} options"),
        Record.judged(
            "values that deformation without simulation changes, untrained",
            _changed_by_deformation(history),
            "",
            "<= 0",
            source="places and look as spread over the box, bit for bit",
        ),
        Record.judged(
            "gradient cut every 1, 3 or no frames",
            _cut_error(history),
            "",
            "<= 1e-5",
            source="relative; d x / d bias of a still field is the bound times the steps since the cut",
        ),
        Record.judged(
            "drift that clips from the roll-out do not see",
            abs(ours.difference),
            "m",
            "<= 1e-6",
            source="what flies is rolled from its birth with the present weights",
        ),
        Record(
            "drift that clips from the simulation do not see",
            paper.difference,
            "m",
            source=f"random weights; clips {paper.clips:.3g} m, roll-out {paper.rollout:.3g} m at the same frames",
        ),
    ]


def _flow(history: ParticleHistory) -> list[Record]:
    """Motion that is read where the particle is: against an analytic shear flow, and its size beside its error."""
    flow = VelocityField.of(history)
    by_field, by_particle = (_left_behind(history, motion) for motion in ("field", "particle"))
    return [
        Record.judged(
            "0.3 m aside in a shear flow, left behind by field",
            by_field,
            "",
            "<= 0.1",
            source=f"share of the analytic way; {by_particle:.3g} by particle, the paper's motion",
        ),
        Record.judged(
            "memory of the velocity field",
            flow.nbytes / 1e6,
            "MB",
            "<= 50",
            error=flow.error(history),
            error_unit="m per frame, mean, grid against the particles' own steps",
            source=f"cells of {flow.cell:.2f} m, {history.frames} frames",
        ),
    ]


def rollout(
    history: ParticleHistory, *, weights: float, motion: Motion = "particle", config: FieldConfig | None = None
) -> Rollout:
    torch.manual_seed(0)
    field = DynamicsField.for_history(history, config=config)
    if weights:
        for head in field.heads():
            for parameter in head.parameters():
                torch.nn.init.normal_(parameter, 0.0, weights)
    return Rollout(history, initial_look(SNOWFALL, history), field, LearnedLook(), motion=motion)


def changed(roll: Rollout, frames: int | None = None) -> int:
    """In all frames, or as many in the middle; with gradient, so that the networks do run."""
    history, look, different = roll.history, roll.look, 0
    for instant in roll.window(0, len(roll)) if frames is None else roll.window(len(roll) // 2, frames):
        active, collided = look.active.select(instant.active), look.collided_at(history, instant.frame, instant.collided)
        g = instant.gaussians
        truth = [
            torch.cat([history.positions_at(instant.frame, instant.active), history.rest_positions[instant.collided]]),
            torch.cat([history.quats[instant.active], history.rest_quats[instant.collided]]),
            torch.cat([active.scales, collided.scales]),
            torch.cat([active.opacity, collided.opacity]),
            torch.cat([active.rgb, collided.rgb]),
        ]
        different += sum(int((getattr(g, name) != value).sum()) for name, value in zip(FIELDS, truth, strict=True))
    return different


def _changed_by_deformation(history: ParticleHistory) -> int:
    box = torch.tensor([DOMAIN.lower, DOMAIN.upper])
    still = scattered(box, history, 200)
    look, ids = initial_look(SNOWFALL, still), torch.arange(200)
    truth = (still.positions_at(0, ids), still.quats, look.active.scales, look.active.opacity, look.active.rgb)
    clip = DeformedCloud(still, look, Deformation(box, still.frames)).window(1, CLIP)
    different = [(getattr(r.gaussians, name) != value).sum() for r in clip for name, value in zip(FIELDS, truth, strict=True)]
    return int(torch.stack(different).sum())


def _cut_error(history: ParticleHistory) -> float:
    """Worst relative error of the gradient's number of steps, of a particle that is active in the whole clip."""
    start = history.frames // 2
    active = (history.births < start - 1) & (history.ends > start + CLIP + LANDING_FRAMES)
    chosen, worst = int(active.nonzero()[0, 0]), 0.0
    for cut, steps in ((None, CLIP), (1, 1), (3, (CLIP - 1) % 3 + 1)):
        roll = rollout(history, weights=0.0)
        last = roll.window(start, CLIP, gradient_frames=cut)[-1]
        height = last.gaussians.means[last.active.tolist().index(chosen), 2]
        (gradient,) = torch.autograd.grad(height, roll.field.active_net.heads["velocity"].bias)  # type: ignore[arg-type]
        worst = max(worst, abs(float(gradient[2]) / (steps * roll.field.bounds.velocity) - 1))
    return worst


def _left_behind(like: ParticleHistory, motion: Motion) -> float:
    """Share of its way that a particle 0.3 m above its simulated place does not go in a wind that grows with height."""
    box, shear, aside = torch.tensor([[0.0, 0, 0], [4, 4, 4]]), 0.02, 0.3
    start = scattered(box, like, 2000)
    first = start.positions_at(0, torch.arange(2000))
    way = torch.arange(start.frames)[:, None, None] * shear * first[:, 2:]
    paths = torch.cat([first[:, :1] + way, first[:, 1:].expand(start.frames, -1, -1)], dim=2)
    history = replace(start, positions=paths.transpose(0, 1).flatten(0, 1))
    roll, state = rollout(history, weights=0.0), simulated(history, 0)
    flow = VelocityField.of(history) if motion == "field" else None
    state = replace(state, offset=state.offset + torch.tensor([0.0, 0.0, aside]))
    with torch.no_grad():
        while state.frame < CLIP:
            state, _ = advance(state, history, roll.look, roll.field, None, flow)
    inside = (first[:, 2] > aside) & (first[:, 2] < 4 - 2 * aside)
    gone = state.offset[inside, 0] / (shear * aside * CLIP)
    return float((1 - gone).abs().mean())
