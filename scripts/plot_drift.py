"""Draws docs/images/drift.png: drift by weight of the position loss, from what the bench wrote, and what training with and
without the appearance loss comes to in pictures (two trainings, a few minutes each, kept in outputs/drift).

pgsd bench dynamics --json docs/figures/drift.json
python scripts/plot_drift.py            --again trains anew
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from matplotlib.figure import Figure
from torch import Tensor

from pgsd_nerfstudio.laboratory.records import Record, read_records
from pgsd_nerfstudio.laboratory.rows.drift import PAPER, PAPER_ADAPTIVE, learned
from pgsd_nerfstudio.storage import load_tensors, save_tensors

ROOT = Path(__file__).resolve().parent.parent
DOCS, KEPT = ROOT / "docs", ROOT / "outputs" / "drift"


def draw(rows: list[Record], shown: dict[str, list[Tensor]]) -> Figure:
    """Left: drift against weight beside the paper's. Right: the end of the weather from three views, one row per training."""
    figure = plt.figure(figsize=(13, 6), constrained_layout=True)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.3))[0]
    axes, named = left.subplots(), {row.name: row.value for row in rows if row.value is not None}
    ours = [1000 * named[f"drift, constant weight {weight:g}"] for weight in PAPER]
    theirs = [1000 * drift for drift in PAPER.values()]
    axes.plot(list(PAPER), ours, "o-", color="tab:blue", label="demo, bundled prior, mm")
    axes.axhline(1000 * named["drift, adaptive weights"], color="tab:blue", linestyle=":", label="the same, adaptive weights")
    axes.plot(list(PAPER), theirs, "s-", color="tab:orange", label="the paper, thousandths of its scene units")
    axes.axhline(1000 * PAPER_ADAPTIVE, color="tab:orange", linestyle=":", label="the same, adaptive weights")
    axes.set(xscale="log", yscale="log", xlabel="constant weight of the position loss, as in the paper", ylabel="average drift")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
    for line, (name, frames) in zip(right.subplots(len(shown), 3, squeeze=False), shown.items(), strict=True):
        for cell, frame in zip(line, frames, strict=True):
            cell.imshow(frame.permute(1, 2, 0).clamp(0, 1).numpy())
            cell.set(xticks=[], yticks=[])
        line[0].set_ylabel(name, fontsize=8)
    return figure


def pictures(again: bool) -> dict[str, list[Tensor]]:
    """The end of the weather, by what it is."""
    file = KEPT / "pictures.safetensors"
    stored = None if again else load_tensors(file)
    if stored is None:
        with_loss, without = learned(KEPT / "with"), learned(KEPT / "without", without=("app",))
        found = {
            "curated look": with_loss.aim,
            "wrong look, untrained": with_loss.start,
            "trained": with_loss.end,
            "trained without L_app": without.end,
        }
        save_tensors(file, {name: torch.stack(frames) for name, frames in found.items()}, {"order": list(found)})
        return found
    return {name: list(stored[0][name]) for name in stored[1]["order"]}


def main(again: bool = False) -> None:
    """Draw the picture.

    Args:
        again: train anew instead of taking the pictures of the last time.
    """
    out = DOCS / "images" / "drift.png"
    draw(read_records(DOCS / "figures" / "drift.json"), pictures(again)).savefig(out, dpi=90)
    print(out)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
