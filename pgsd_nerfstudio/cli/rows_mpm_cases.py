"""Figures of the dense regime: published experiments and analytic solutions, each with the value that was measured."""

from __future__ import annotations

import time

from pgsd_nerfstudio.cli.records import Record
from pgsd_nerfstudio.physics.mpm.experiments import (
    colliding_balls,
    dam_break,
    dense_snow,
    elastic_bar,
    free_cloud,
    hydrostatic_column,
    sliding_block,
)
from pgsd_nerfstudio.physics.mpm.experiments_sand import heap_slope, run_out

_WALL = "; MPM is a first-order method at walls, whose last half cell is soft"


def cases(quick: bool) -> list[Record]:
    """Published experiments and analytic solutions; coarser and fewer with `quick`."""
    fine = not quick
    rows = [*_conservation(), *_elasticity(fine), *_friction(fine)]
    fronts = dam_break(16 if fine else 8)
    worst = max(abs(front / far - 1) for _, front, far in fronts)
    bound = max(front / (1 + 2 * late) for late, front, _ in fronts)
    moyce = "Martin & Moyce 1952, n^2 = 2, six times; no friction at the walls here, water that is not wet, and no gate"
    rows += [
        Record.judged("dam break: front against Martin-Moyce, worst", 100 * worst, "%", "<= 10", source=moyce),
        Record.judged("dam break: front over Ritter's bound, largest", bound, "", "< 1", source="Z < 1 + 2 T"),
    ]
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


def costs(quick: bool) -> list[Record]:
    """Speed of dense snow beside the error of single precision."""
    del quick
    ends = {}
    for precision in ("f32", "f64"):
        mpm = dense_snow(4000, precision)
        dt = 2e-4
        for _ in range(100):
            mpm.step(dt)
        ends[precision] = mpm.positions.double()
    error = float((ends["f32"] - ends["f64"]).norm(dim=1).mean())
    mpm = dense_snow(20_000)
    mpm.step(1e-3)
    speeds = []
    for _ in range(3):
        began = time.perf_counter()
        count = mpm.step(0.01)
        speeds.append(count / (time.perf_counter() - began))
    return [
        Record(
            "MPM, 20,000 dense snow particles",
            max(speeds),
            "substeps/s",
            error,
            "m",
            source="best of three; error: f32 against f64 after 100 steps, mean of 4,000 particles",
        ),
    ]
