"""The model card that is exported beside the weights; every figure in it comes from the run that made them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bundled_prior.looks import AMOUNTS, CLEAR_CAPTION, COLOURS, CURATED_CAPTION, GENERIC_FLAWS, OPACITIES, SIZES, WRONG_CAPTION

CARD = """---
license: apache-2.0
library_name: diffusers
pipeline_tag: text-to-video
---

# The bundled video prior

A very small CogVideoX for clips of 9 frames of 96x64 pixels: {transformer:.1f} M parameters in the transformer,
{vae:.1f} M in the VAE, {text:.2f} M in the text encoder. Its one purpose is to let score distillation of snow run,
and be tested, on a machine without a GPU. For results worth showing use CogVideoX-2B: `--prior THUDM/CogVideoX-2b`.

## What it knows

Only clips that this project renders itself: the built-in courtyard and random collages of shapes, each seen with snow
in the curated look, in looks near a wrong one (grey, twice too large, half as opaque), in random looks, and without
weather. It knows {words} words. It has seen no photograph, no other weather and no other scene; words it does not
know are ignored.

| caption | what it shows |
|---|---|
| {curated} | the curated look |
| {wrong} | the wrong look |
| {flaws} | any look but the curated one: the negative prompt to use |
| {clear} | no weather |
| amount: {amounts} | how many flakes fall |
| colour: {colours} | of the flakes |
| opacity: {opacities} | relative to the curated look |
| size: {sizes} | relative to the curated look |

## How it was made

`python scripts/train_bundled_prior.py`, seed {seed}, from {courtyard} families of clips of the courtyard and
{collages} of collages; a family is one motion in four looks.

- The VAE's encoder is set, not trained: principal components of 4x4x4 blocks, {kept:.1%} of their variance. It is
  linear up to the scale of a clip, so a gradient passes it undistorted. The decoder was trained on it ({psnr:.1f} dB
  on its training clips); only pictures need it.
- Transformer and text encoder were trained together for {steps:,} steps. Besides denoising, four samples in ten are
  told another look than the one they show and have that look as their target; without them nothing teaches a small
  model to believe words over what it sees.
- The scheduler is CogVideoX-2B's (v-prediction, zero terminal SNR) without the shift toward noise that large frames
  need.
{notes}
## Figures

Guidance from the wrong look toward the curated one, on {held} families held out (other camera paths and backgrounds):
share in which descending v(curated words) - v(wrong words) leads toward the clip of the same motion in the curated
look, and the mean cosine between the two directions.

{direction}

{descent}## What is weak

- It makes no convincing videos of its own.
- At 96x64 most flakes in the air are smaller than a pixel, where a larger one and a brighter one look alike; their scale
  follows only because the plugin changes size at constant matter. Of landed snow it teaches colour and opacity; the size
  of the patches it hardly moves.
- Explicit words of a wrong look as the negative prompt drive beyond the curated look. With an empty negative prompt, or
  one that only names flaws ("blurry, distorted, low quality"), guidance fades where the curated look is reached.
"""


@dataclass(frozen=True)
class Facts:
    """What the card reports."""

    parameters: Mapping[str, int]
    """Of transformer, vae, text_encoder."""
    words: int
    seed: int
    courtyard: int
    collages: int
    kept: float
    psnr: float
    steps: int
    """Of the denoiser."""
    held: int
    direction: Mapping[int, tuple[float, float]]
    notes: str = ""
    """What this training had of its own, as one more item of the list."""
    descent: Mapping[str, Sequence[tuple[int, Mapping[str, float]]]] = field(default_factory=dict)
    """By negative prompt: steps of distillation and the look relative to the curated one; empty where not measured."""


def write_card(path: Path, facts: Facts) -> None:
    """Writes the card as Markdown."""
    steps = [str(t) for t in facts.direction]
    shares = [f"{share:.0%}" for share, _ in facts.direction.values()]
    cosines = [f"{cosine:+.2f}" for _, cosine in facts.direction.values()]
    rows = [["timestep", *steps], ["---"] * (len(steps) + 1), ["share", *shares], ["cosine", *cosines]]
    text = CARD.format(
        transformer=facts.parameters["transformer"] / 1e6,
        vae=facts.parameters["vae"] / 1e6,
        text=facts.parameters["text_encoder"] / 1e6,
        words=facts.words,
        curated=CURATED_CAPTION,
        wrong=WRONG_CAPTION,
        clear=CLEAR_CAPTION,
        flaws=", ".join(GENERIC_FLAWS),
        amounts=", ".join(AMOUNTS),
        colours=", ".join(COLOURS),
        opacities=", ".join(name for _, name in OPACITIES),
        sizes=", ".join(name for _, name in SIZES),
        seed=facts.seed,
        courtyard=facts.courtyard,
        collages=facts.collages,
        kept=facts.kept,
        psnr=facts.psnr,
        steps=facts.steps,
        held=facts.held,
        notes=f"- {facts.notes}\n" if facts.notes else "",
        direction=_table(rows),
        descent=_descent(facts.descent),
    )
    path.write_text(text)


def _descent(by_negative: Mapping[str, Sequence[tuple[int, Mapping[str, float]]]]) -> str:
    if not by_negative:
        return ""
    names = list(next(iter(by_negative.values()))[0][1])
    table = [["negative prompt", "step", *names], ["---"] * (len(names) + 2)]
    for negative, rows in by_negative.items():
        table += [[negative, str(step), *(f"{row[name]:.2f}" for name in names)] for step, row in rows]
    return (
        "Score distillation on the courtyard from the wrong look, moving only what all flakes share; every figure is\n"
        f"relative to the curated look, so that 1 is the aim.\n\n{_table(table)}\n\n"
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
