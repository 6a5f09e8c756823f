"""How far training drifts from the simulation: the paper's table of constant weights of the position loss, with the bundled
prior. All other weights stay adaptive, as there.

|L_SDS| is a sum over latents, so the weights that balance it grow with their number. The paper's four constants belong to clips
of 9 frames of 720x480 (16 channels, 3 latent frames of 60x90: 28,800 numbers a frame); the bundled prior's clips have fewer
numbers a frame, and the constants are scaled by that ratio.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from pgsd_nerfstudio.cli.records import Record

PAPER = {1.0: 4.32, 1e2: 2.37, 1e4: 1.46, 1e6: 0.03}
"""Average drift by constant weight, in the paper's scene units (its table "Trajectory Drift Ablations")."""
PAPER_NUMBERS = 16 * 3 * 60 * 90 / 9
STEPS = 60
TIMESTEPS = (200, 400, 600)
WINDOWS = 4


@dataclass(frozen=True)
class Lesson:
    """What one training came to."""

    drift: float
    """Of the full roll-out, m."""
    surprise: float
    """|L_SDS| over fixed windows, cameras, timesteps and noise, relative to before training."""
    look: float
    """Mean change of colour of landed and flying particles over the whole roll-out, 0..1."""


def rows(quick: bool) -> Iterator[Record]:
    """Six trainings of the demo scene; none when quick, since they take minutes."""
    if quick:
        yield Record(
            "drift by weight of the position loss", None, "m", source="six trainings: pgsd bench dynamics without --quick"
        )
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        numbers = _numbers_a_frame()
        ratio = numbers / PAPER_NUMBERS
        source = f"demo, bundled prior, {STEPS} steps; the paper's constant times {ratio:.3g}, "
        source += f"for {numbers:,.0f} instead of {PAPER_NUMBERS:,.0f} latents a frame"
        found = []
        for paper, theirs in PAPER.items():
            lesson = _learned(place / f"{paper:g}", paper * ratio)
            found.append(lesson.drift)
            yield _row(f"drift, constant weight {paper:g}", lesson, f"{source}; the paper's drift {theirs:g} scene units")
        falls = all(a > b for a, b in pairwise(found))
        yield Record.judged("drift falls with the constant weight", float(falls), "", "== 1", source=source)
        adaptive = _learned(place / "adaptive")
        yield _row("drift, adaptive weights", adaptive, f"demo, bundled prior, {STEPS} steps")
        yield Record.judged(
            "drift of adaptive weights over that of the third constant", adaptive.drift / max(found[2], 1e-12), "", "<= 0.2"
        )
        yield Record.judged(
            "what is left of the prior's surprise, adaptive weights", adaptive.surprise, "", "< 1",
            source=f"|L_SDS| at t = {', '.join(map(str, TIMESTEPS))} over {WINDOWS} windows with fixed noise, before = 1",
        )  # fmt: skip
        bare = _learned(place / "without", without=("app",))
        yield _row("drift, adaptive weights without L_app", bare, "the paper: severe error accumulation of the look")
        yield Record.judged(
            "change of colour over the roll-out without L_app over that with it",
            bare.look / max(adaptive.look, 1e-12),
            "",
            ">= 2",
        )


def _row(name: str, lesson: Lesson, source: str) -> Record:
    about = f"{source}; surprise {lesson.surprise:.3f} of that before, mean change of colour {lesson.look:.4f}"
    return Record(name, lesson.drift, "m", source=about)


def _numbers_a_frame() -> float:
    from pgsd_nerfstudio.guidance import VideoPrior

    prior = VideoPrior.load("bundled", "cpu")
    latents = prior.encode(torch.zeros(prior.clip_shape[0], 3, *prior.clip_shape[1:]))
    return latents.numel() / prior.clip_shape[0]


def _learned(place: Path, xyz: float | None = None, without: tuple[str, ...] = ()) -> Lesson:
    """Train the demo as ns-train does; `xyz` is a constant weight of the position loss in place of the adaptive one."""
    from pgsd_nerfstudio.dynamics import RegularizationWeights, drift
    from pgsd_nerfstudio.plugin.config import WeatherTrainerConfig

    held: Any = {} if xyz is None else {"xyz": xyz, "constant": ("xyz",)}
    regularization = RegularizationWeights(without=without, **held)
    config = WeatherTrainerConfig(
        load_scene=Path("demo"), steps=STEPS, regularization=regularization, output_dir=place, timestamp="bench"
    )
    config.set_timestamp()
    torch.manual_seed(config.machine.seed)
    with redirect_stdout(StringIO()):
        config.save_config()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        pipeline = trainer.pipeline
        before = _surprise(pipeline)
        trainer.train()
    model = pipeline.model
    model.rollout.refresh()
    after = _surprise(pipeline)
    return Lesson(drift(model.rollout.frames()), after / before, _recoloured(model))


@torch.no_grad()
def _surprise(pipeline: Any) -> float:
    """|L_SDS| of clips that training does not see, with fixed noise."""
    from pgsd_nerfstudio.guidance import distill
    from pgsd_nerfstudio.plugin.clip import render_clip
    from pgsd_nerfstudio.plugin.run_cameras import from_nerfstudio

    model, guide, total = pipeline.model, pipeline.guide, 0.0
    if model.rollout.refreshed is not None:
        model.rollout.refresh()
    for index in range(WINDOWS):
        cameras, batch = pipeline.datamanager.next_eval(index)
        views, start = from_nerfstudio(cameras), int(batch["start"])
        weather = [
            model.stage.scene.frame.gaussians_to_scene(one.gaussians) for one in model.rollout.frames(start, start + len(views))
        ]
        clip = render_clip(model.stage, views, weather, model.background_color, [None] * len(views))
        latents = guide.prior.encode(clip)
        for t in TIMESTEPS:
            draw = torch.Generator().manual_seed(1000 * index + t)
            how = {"config": guide.distillation, "generator": draw, "frames": len(clip), "progress": 0.0}
            total += distill(guide.prior, latents, guide.embeddings, None, t, **how).loss
    return total / (WINDOWS * len(TIMESTEPS))


@torch.no_grad()
def _recoloured(model: Any) -> float:
    """Mean change of colour that the recurrence has summed up in the last frame, against the shared look."""
    rolled = next(model.rollout.frames(len(model.rollout) - 1))
    look = model.look(model.rollout.look)
    resting = look.collided_at(model.history, rolled.frame, rolled.resting)
    plain = torch.cat([look.active.select(rolled.active).rgb, resting.rgb])
    return float((rolled.gaussians.colors - plain).abs().mean())
