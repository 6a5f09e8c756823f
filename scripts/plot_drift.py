"""Draws docs/images/drift.png: drift by weight of the position loss, from what the bench wrote, and what training with and
without the appearance loss comes to in pictures (two trainings, a few minutes each).

pgsd bench dynamics --json docs/figures/drift.json
python scripts/plot_drift.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from torch import Tensor

from pgsd_nerfstudio.cli.records import Record, read_records
from pgsd_nerfstudio.cli.rows_drift import PAPER, PAPER_ADAPTIVE, learned

DOCS = Path(__file__).resolve().parent.parent / "docs"


def draw(rows: list[Record], pictures: dict[str, list[Tensor]]) -> Figure:
    """Left: drift against weight beside the paper's. Right: the end of the weather from three views, one row per training."""
    figure = plt.figure(figsize=(14, 6.2), constrained_layout=True)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.7))[0]
    axes, named = left.subplots(), {row.name: row.value for row in rows if row.value is not None}
    ours = [1000 * named[f"drift, constant weight {weight:g}"] for weight in PAPER]
    theirs = [1000 * drift for drift in PAPER.values()]
    axes.plot(list(PAPER), ours, "o-", color="tab:blue", label="demo, bundled prior, mm")
    axes.axhline(1000 * named["drift, adaptive weights"], color="tab:blue", linestyle=":", label="the same, adaptive weights")
    axes.plot(list(PAPER), theirs, "s-", color="tab:orange", label="the paper, thousandths of its scene units")
    axes.axhline(1000 * PAPER_ADAPTIVE, color="tab:orange", linestyle=":", label="the same, adaptive weights")
    axes.set(xscale="log", yscale="log", xlabel="constant weight of the position loss, as in the paper", ylabel="average drift")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    for line, (name, frames) in zip(right.subplots(len(pictures), 3, squeeze=False), pictures.items(), strict=True):
        for cell, frame in zip(line, frames, strict=True):
            cell.imshow(frame.permute(1, 2, 0).clamp(0, 1).numpy())
            cell.set(xticks=[], yticks=[])
        line[0].set_ylabel(name, fontsize=8)
    return figure


def main() -> None:
    rows = read_records(DOCS / "figures" / "drift.json")
    with TemporaryDirectory() as folder:
        place = Path(folder)
        with_loss = learned(place / "with")
        without = learned(place / "without", without=("app",))
    pictures = {
        "curated look": with_loss.aim,
        "wrong look, untrained": with_loss.start,
        "trained": with_loss.end,
        "trained without L_app": without.end,
    }
    out = DOCS / "images" / "drift.png"
    draw(rows, pictures).savefig(out, dpi=90)
    print(out)


if __name__ == "__main__":
    main()
