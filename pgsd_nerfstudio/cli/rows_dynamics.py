"""Figures of the room dynamics: an untrained field changes nothing, frames do not depend on how they are reached; cost."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pgsd_nerfstudio.cli import rows_drift
from pgsd_nerfstudio.cli.records import Record
from pgsd_nerfstudio.cli.timing import best
from pgsd_nerfstudio.dynamics import (
    Deformation,
    DeformedCloud,
    DynamicsField,
    FieldConfig,
    LearnedLook,
    Motion,
    RegularizationWeights,
    Rollout,
    VelocityField,
    gaps,
    regularization,
    scattered,
)
from pgsd_nerfstudio.dynamics.regularizers import rotation_angle
from pgsd_nerfstudio.dynamics.state import LANDING_FRAMES, advance, simulated
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, simulate
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.weather import SNOWFALL
from pgsd_nerfstudio.weather.appearance import InitialLook, ParticleLook, initial_look

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


def verify(quick: bool) -> list[Record]:
    """Laws with known answers."""
    roll = _rollout(_snow(150 if quick else 600, 60 if quick else 250), weights=0.0)
    return [
        Record.judged(
            "values an untrained field changes", _changed(roll), "", "<= 0", source="simulation and initial look, bit for bit"
        ),
        Record.judged(
            "frame by random access against window, float32",
            _access_error(_rollout(roll.history, weights=0.1)),
            "",
            "<= 5e-6",
            source="largest difference of any value (metres, 0..1)",
        ),
        Record.judged(
            "values not finite, random weights x100",
            _not_finite(_rollout(roll.history, weights=10.0)),
            "",
            "<= 0",
            source=f"all Gaussians of {roll.history.frames} frames",
        ),
        Record.judged(
            "landing beside the simulated contact",
            _landing_error(_rollout(roll.history, weights=1.0)),
            "m",
            "<= 0",
            source="learned offsets fade before contact",
        ),
        Record.judged(
            "gradient through 9 frames, float64",
            _gradient_error(_in_float64(_rollout(_snow(50, 30), weights=0.01))),
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
        *_verify_options(roll.history),
        *_verify_flow(roll.history),
    ]


def _verify_options(history: ParticleHistory) -> list[Record]:
    """Laws of what can be chosen: what the field changes, how far the gradient runs, where clips begin, motion without it."""
    changed = sum(_changed(_rollout(history, weights=0.0, motion=motion, config=config), CLIP) for motion, config in OPTIONS)
    trained = _rollout(history, weights=0.1)
    clips = [(start, CLIP) for start in range(0, history.frames - CLIP, 2 * CLIP)]
    found = gaps(trained, clips)
    paper, ours = found["simulation"], found["rollout"]
    return [
        Record.judged("values an untrained field changes, by option", changed, "", "<= 0", source=f"{len(OPTIONS)} options"),
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


def _verify_flow(history: ParticleHistory) -> list[Record]:
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


def bench(quick: bool) -> list[Record]:
    """Cost beside error: of a frame, and of a training clip."""
    history = _snow(2000 if quick else 20_000, 40 if quick else 150)
    roll = _rollout(history, weights=0.1)
    roll.refresh()
    start = history.frames - CLIP
    count = len(history.active(start)) + len(history.resting(start))
    error = _float_error(roll)
    unit = {"error": error, "error_unit": "m, float32 against float64 over the sequence"}
    untrained = _rollout(history, weights=0.0)
    frame = best(lambda: roll.window(start, 1), 4)
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
    return simulate(ground, SNOWFALL, Clock(frames=frames), DOMAIN, max_particles=most, progress=False)


def _rollout(
    history: ParticleHistory, *, weights: float, motion: Motion = "particle", config: FieldConfig | None = None
) -> Rollout:
    torch.manual_seed(0)
    field = DynamicsField.for_history(history, config=config)
    if weights:
        for head in field.heads():
            for parameter in head.parameters():
                torch.nn.init.normal_(parameter, 0.0, weights)
    return Rollout(history, initial_look(SNOWFALL, history), field, LearnedLook(), motion=motion)


def _in_float64(roll: Rollout) -> Rollout:
    def look(of: ParticleLook) -> ParticleLook:
        return ParticleLook(of.opacity.double(), of.scales.double(), of.rgb.double())

    names = ("positions", "rest_positions", "rest_quats", "quats")
    history = replace(roll.history, **{name: getattr(roll.history, name).double() for name in names})
    looks = InitialLook(look(roll.look.active), look(roll.look.collided), roll.look.settle_seconds)
    field = DynamicsField.for_history(history).double()
    field.load_state_dict(roll.field.state_dict())
    return Rollout(history, looks, field, LearnedLook().double())


def _changed(roll: Rollout, frames: int | None = None) -> int:
    """In all frames, or as many in the middle; with gradient, so that the networks do run."""
    history, look, different = roll.history, roll.look, 0
    for rolled in roll.window(0, len(roll)) if frames is None else roll.window(len(roll) // 2, frames):
        flying, lying = look.active.select(rolled.active), look.collided_at(history, rolled.frame, rolled.resting)
        g = rolled.gaussians
        truth = [
            torch.cat([history.positions_at(rolled.frame, rolled.active), history.rest_positions[rolled.resting]]),
            torch.cat([history.quats[rolled.active], history.rest_quats[rolled.resting]]),
            torch.cat([flying.scales, lying.scales]),
            torch.cat([flying.opacity, lying.opacity]),
            torch.cat([flying.rgb, lying.rgb]),
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
    """Worst relative error of the gradient's number of steps, of a particle that flies through the clip."""
    start = history.frames // 2
    flying = (history.births < start - 1) & (history.ends > start + CLIP + LANDING_FRAMES)
    flyer, worst = int(flying.nonzero()[0, 0]), 0.0
    for cut, steps in ((None, CLIP), (1, 1), (3, (CLIP - 1) % 3 + 1)):
        roll = _rollout(history, weights=0.0)
        last = roll.window(start, CLIP, gradient_frames=cut)[-1]
        height = last.gaussians.means[last.active.tolist().index(flyer), 2]
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
    roll, state = _rollout(history, weights=0.0), simulated(history, 0)
    flow = VelocityField.of(history) if motion == "field" else None
    state = replace(state, offset=state.offset + torch.tensor([0.0, 0.0, aside]))
    with torch.no_grad():
        while state.frame < CLIP:
            state, _ = advance(state, history, roll.look, roll.field, None, flow)
    inside = (first[:, 2] > aside) & (first[:, 2] < 4 - 2 * aside)
    gone = state.offset[inside, 0] / (shear * aside * CLIP)
    return float((1 - gone).abs().mean())


def _access_error(roll: Rollout) -> float:
    """Frames in descending order, so that each is rolled from the kept state before it."""
    start, worst = len(roll) // 2 + 3, 0.0
    direct = {frame: roll.gaussians(frame) for frame in reversed(range(start, start + CLIP))}
    with torch.no_grad():
        for rolled in roll.window(start, CLIP):
            pairs = [(getattr(direct[rolled.frame], name), getattr(rolled.gaussians, name)) for name in FIELDS]
            worst = max([worst, *(float((a - b).abs().max()) for a, b in pairs)])
    return worst


def _not_finite(roll: Rollout) -> int:
    return sum(int((~torch.isfinite(getattr(r.gaussians, name))).sum()) for r in roll.frames() for name in FIELDS)


def _landing_error(roll: Rollout) -> float:
    """Largest learned offset in the last frame in the air, of those that land."""
    worst = 0.0
    for rolled in roll.frames():
        landing = roll.history.collided[rolled.active] & (roll.history.ends[rolled.active] == rolled.frame + 1)
        worst = max([worst, *rolled.offset[landing].abs().flatten().tolist()])
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
