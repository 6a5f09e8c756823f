"""Draws docs/images/rasterizer.png, time against error of the CPU rasterizer, from what the bench wrote.

pgsd bench rasterizer --json docs/figures/rasterizer.json
python scripts/plot_rasterizer.py
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pgsd_nerfstudio.laboratory.records import Record, read_records

DOCS = Path(__file__).resolve().parent.parent / "docs"
ROW = re.compile(r"(forward\+backward|forward), (exact|layers (\d+)), (\d+x\d+), ([\d.]+)k frozen, ([\d.]+)k dynamic")


def draw(rows: list[Record]) -> Figure:
    """Left: layers trade error for time. Right: what frozen and dynamic Gaussians cost, exact and in layers."""
    figure, (trade, growth) = plt.subplots(1, 2, figsize=(12, 4.6), constrained_layout=True)
    found = [(row, match) for row in rows if (match := ROW.fullmatch(row.name)) and match[1] == "forward+backward"]
    sizes = sorted({match[4] for _, match in found}, key=lambda size: int(size.split("x")[0]))
    for colour, size in zip(("tab:blue", "tab:orange", "tab:green"), sizes, strict=False):
        here = [(row, match) for row, match in found if match[4] == size and (match[5], match[6]) == ("150", "50")]
        curve = sorted((int(match[3]), row) for row, match in here if match[3])
        trade.plot(
            [row.value for _, row in curve], [row.error for _, row in curve], "o-", color=colour, label=f"{size}, layers"
        )
        for count, row in curve:
            trade.annotate(str(count), (row.value, row.error), textcoords="offset points", xytext=(5, 4), fontsize=8)
        for row in (row for row, match in here if not match[3]):
            trade.plot(row.value, row.error, "s", color=colour, label=f"{size}, exact")
        for style, mode in (("s-", "exact"), ("o--", "layers")):
            line = sorted(
                (float(m[6]), row.value)
                for row, m in found
                if m[4] == size
                and m[5] == "150"
                and m[2].split()[0] == mode
                and (mode == "exact" or m[3] == standard(found, size))
            )
            growth.plot([n for n, _ in line], [ms for _, ms in line], style, color=colour, label=f"{size}, {mode}")
    trade.set(
        xscale="log",
        yscale="log",
        xlabel="forward + backward, ms of CPU time, one thread",
        ylabel="relative L2 error of the gradient",
        title="150k frozen, 50k dynamic (numbers: layers)",
    )
    growth.set(
        xscale="log",
        yscale="log",
        xlabel="dynamic Gaussians, thousands",
        ylabel="forward + backward, ms of CPU time",
        title="150k frozen",
    )
    for axes in (trade, growth):
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def standard(found: list[tuple[Record, re.Match[str]]], size: str) -> str:
    """The number of layers that every case of this size was measured with."""
    return next(match[3] for _, match in found if match[4] == size and match[3] and (match[5], match[6]) != ("150", "50"))


if __name__ == "__main__":
    out = DOCS / "images" / "rasterizer.png"
    draw(read_records(DOCS / "figures" / "rasterizer.json")).savefig(out, dpi=110)
    print(out)
