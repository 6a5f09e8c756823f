"""Figures of the dense regime: published experiments and analytic solutions, each with the value that was measured."""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.laboratory.experiments.sand import heap_slope, run_out
from pgsd_nerfstudio.laboratory.experiments.solids import (
    colliding_balls,
    elastic_bar,
    free_cloud,
    hydrostatic_column,
    sliding_block,
)
from pgsd_nerfstudio.laboratory.experiments.water import MARTIN_MOYCE, dam_break, dam_break_in_theory, passage
from pgsd_nerfstudio.laboratory.records import Record

_WALL = "; MPM is a first-order method at walls, whose last half cell is soft"


def cases(quick: bool) -> list[Record]:
    """Published experiments and analytic solutions; coarser and fewer with `quick`."""
    fine = not quick
    rows = [*_conservation(), *_elasticity(fine), *_friction(fine), *_dam(16 if fine else 8)]
    for aspect, cells in ((1.0, 16 if fine else 8), (2.0, 12 if fine else 6)):
        found, known = run_out(aspect, cells)
        off = 100 * abs(found / known - 1)
        rows.append(
            Record.judged(
                f"sand column, a = {aspect:g}: run-out {found:.2f} against {known:.2f}, {cells} cells a radius",
                off,
                "%",
                "<= 15",
                source="Lube et al. 2004; the foot of the deposit is thinner than a cell and stops: finer grids run farther",
            )
        )
    return rows


def _conservation() -> list[Record]:
    linear, angular, lost = free_cloud("f32")
    _, double, _ = free_cloud("f64")
    returned, drift, _ = colliding_balls("f32", 6)
    return [
        Record.judged("free cloud of four materials: momentum, f32", linear, "", "<= 1e-6", source="no force from outside"),
        Record.judged("free cloud: mass lost", lost, "", "<= 0", source="nothing left the domain"),
        Record.judged("free cloud: angular momentum, f32", angular, "", "<= 1e-5", source="APIC, Jiang et al. 2015"),
        Record.judged("free cloud: angular momentum, f64", double, "", "<= 1e-12", source="APIC, Jiang et al. 2015"),
        Record.judged("two balls collide: momentum, f32", drift, "", "<= 1e-5", source="Sulsky, Chen & Schreyer 1994"),
        Record(
            "two balls collide: kinetic energy returned", 100 * returned, "%", source="Sulsky et al. 1994; the rest vibrates"
        ),
    ]


def _elasticity(fine: bool) -> list[Record]:
    hertz, known = elastic_bar(20)
    down, analytic = hydrostatic_column(40 if fine else 32)
    return [
        Record.judged(
            "clamped elastic bar: frequency", 100 * abs(hertz / known - 1), "%", "<= 3", source="f = sqrt(E / rho) / 4 L"
        ),
        Record.judged(
            "column under its weight: settlement",
            100 * abs(down / analytic - 1),
            "%",
            "<= 2",
            source="rho g h^2 / (2 (lambda + 2 mu))" + _WALL,
        ),
    ]


def _dam(cells: int) -> list[Record]:
    six = [late for late, _ in MARTIN_MOYCE]
    late = sorted({*six, *np.linspace(0.6, 4.0, 18).round(3).tolist()})
    fronts, (known, tips) = dam_break(late, cells, 4), dam_break_in_theory(late)
    worst = max(abs(front / far - 1) for front, far in zip(fronts, known, strict=True))
    bound = max(front / (1 + 2 * now) for now, front in zip(late, fronts, strict=True))
    ahead, ideal = (max(float(np.interp(t, late, z)) / far - 1 for t, far in MARTIN_MOYCE) for z in (fronts, tips))
    (start, begin), (end, goal) = MARTIN_MOYCE[1], MARTIN_MOYCE[4]
    took = passage(late, fronts, begin, goal)
    lags = [now - float(np.interp(far, tips, late)) for now, far in MARTIN_MOYCE[:5]]
    return [
        Record.judged(
            f"dam break: front against potential flow, worst of {len(late)} times, {cells} cells a width",
            100 * worst,
            "%",
            "<= 5",
            source="the exact answer without friction and gate (boundary elements); 0.2 % of the water is left out in both",
        ),
        Record.judged(
            f"dam break: time of the front from Z = {begin:g} to {goal:g} against Martin-Moyce",
            100 * abs(took / (end - start) - 1),
            "%",
            "<= 10",
            source="Martin & Moyce 1952, n^2 = 2; does not depend on when their dam, a membrane that melts, began to open",
        ),
        Record(
            "dam break: front ahead of Martin-Moyce at the same times, worst of six",
            100 * ahead,
            "%",
            source=f"not a target: potential flow is up to {100 * ideal:.0f} % ahead, since the experiment starts "
            f"{min(lags):.2f} to {max(lags):.2f} later (T), and its thin tip feels the floor at last",
        ),
        Record.judged("dam break: front over Ritter's bound, largest", bound, "", "< 1", source="Z < 1 + 2 T"),
    ]


def _friction(fine: bool) -> list[Record]:
    slides, known = sliding_block(30.0, 0.3, 8 if fine else 4)
    slope = heap_slope(30.0, 16)
    return [
        Record.judged(
            "block on an incline: acceleration", 100 * abs(slides / known - 1), "%", "<= 3", source="g (sin - mu cos), Coulomb"
        ),
        Record.judged(
            "heap of sand piled at 40 degrees, 16 cells high: off the angle of repose",
            abs(slope - 30),
            "degrees",
            "<= 3",
            source="30 degrees",
        ),
    ]
