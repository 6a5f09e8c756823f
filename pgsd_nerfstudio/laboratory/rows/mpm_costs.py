"""What the dense regime costs, each saving beside the error that it makes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch

from pgsd_nerfstudio.laboratory.experiments.sand import run_out
from pgsd_nerfstudio.laboratory.experiments.solids import (
    dense_snow,
    elastic_bar,
    hydrostatic_column,
    snow_layer,
    throw_snowball,
)
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.physics.mpm import Mpm, Sleep

_CPU = "time of all threads together, the least of several"


def costs(quick: bool) -> list[Record]:
    """Time against error; nothing with `quick`, where compiling the kernels alone would take the time of all."""
    if quick:
        return []
    ratio, error = _precision()
    return [*_speed(error), ratio, *_grids(), *_particles(), *_domains(), *_sleeping()]


def _substep(mpm: Mpm, seconds: float, tries: int = 8) -> tuple[float, float]:
    """Milliseconds of CPU time and of the clock for a substep: the least of several steps."""
    cpu, wall = [], []
    for _ in range(tries):
        used, began = time.process_time(), time.perf_counter()
        count = mpm.step(seconds)
        cpu.append(1e3 * (time.process_time() - used) / count)
        wall.append(1e3 * (time.perf_counter() - began) / count)
    return min(cpu), min(wall)


def _precision() -> tuple[Record, float]:
    """Single precision, which everything else here uses: its time and, in m, its error."""
    spent, ends = {}, {}
    for precision in ("f64", "f32"):
        mpm = dense_snow(4_000, precision, thrown=1.0)
        mpm.step(2e-4)
        began = time.process_time()
        for _ in range(100):
            mpm.step(2e-4)
        spent[precision] = time.process_time() - began
        ends[precision] = mpm.positions.double()
    error = float((ends["f32"] - ends["f64"]).norm(dim=1).mean())
    name, source = (
        "MPM, single precision: CPU time",
        "4,000 particles of breaking snow, 100 steps; error: mean distance at the end",
    )
    return Record(name, spent["f32"] / spent["f64"], "of that of double", error, "m", source=source), error


def _speed(error: float) -> list[Record]:
    rows = []
    for name, thrown in (("lie", 0.0), ("are thrown at 3 m/s and break", 3.0)):
        mpm = dense_snow(20_000, thrown=thrown)
        mpm.step(0.04)
        # Many short tries: on a machine that others use too, one of them meets a quiet moment.
        cpu, wall = _substep(mpm, 0.003 if thrown == 0 else 0.0015, 25)
        rows.append(
            Record.judged(
                f"MPM, 20,000 dense snow particles that {name}",
                1e3 / wall,
                "substeps/s",
                ">= 100",
                error=error,
                error_unit="m",
                source=f"fastest of 25 short steps, {cpu:.1f} ms of CPU time a substep; error: f32 against f64 after 100 steps",
            )
        )
    return rows


def _grids() -> list[Record]:
    """Finer grids against what is known."""
    settling = "rho g h^2 / (2 (lambda + 2 mu)), top of a column under its own weight, mean over a period"
    swinging = "f = sqrt(E / rho) / 4 L of a clamped bar"
    lube = "run-out of a column of sand as high as its radius, Lube et al. 2004"
    rows = []
    for what, case, sizes, source in (
        ("settling column", hydrostatic_column, (32, 64, 128), settling),
        ("swinging bar", elastic_bar, (32, 64, 128), swinging),
        ("collapsing sand", lambda cells: run_out(1.0, cells), (6, 12), lube),
    ):
        errors = []
        for cells in sizes:
            seconds, (found, known) = _timed(lambda case=case, cells=cells: case(cells))
            errors.append(100 * abs(found / known - 1))
            rows.append(Record(f"MPM, {what}, {cells} cells", seconds, "s", errors[-1], "%", source=f"{source}; CPU time"))
        order = math.log(errors[0] / errors[-1]) / math.log(sizes[-1] / sizes[0])
        rows.append(Record(f"MPM, {what}: order of the error in the cell size", order, "", source=source))
    return rows


def _timed(case: Callable[[], tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    began = time.process_time()
    result = case()
    return time.process_time() - began, result


def _particles() -> list[Record]:
    counts, spent = (5_000, 20_000, 80_000), []
    for count in counts:
        mpm = dense_snow(count)
        mpm.step(0.002)
        spent.append(_substep(mpm, 0.005)[0])
    slope = _exponent(counts, spent)
    told = ", ".join(f"{count:,}: {ms:.2f} ms" for count, ms in zip(counts, spent, strict=True))
    return [
        Record(
            "MPM, CPU time of a substep as snow grows from 5,000 to 80,000 particles: exponent",
            slope,
            "",
            source=f"slope of the logarithms; {told}; below 1 while launching the kernels counts",
        ),
        Record("MPM, CPU time of a particle's substep, 80,000 particles", 1e6 * spent[-1] / counts[-1], "ns", source=_CPU),
    ]


def _domains() -> list[Record]:
    """The same snow in ever larger domains: only blocks with particles are touched."""
    sides, spent, ends = (0.5, 1.0, 2.0), [], []
    for side in sides:
        mpm = dense_snow(10_000, side=side)
        mpm.step(0.002)
        spent.append(_substep(mpm, 0.005)[0])
        ends.append(mpm.positions.double())
    volumes = [side**2 for side in sides]
    told = ", ".join(f"{v / volumes[0]:.0f} times: {ms:.2f} ms" for v, ms in zip(volumes, spent, strict=True))
    return [
        Record(
            "MPM, CPU time of a substep as the domain grows 16-fold around 10,000 particles: exponent",
            _exponent(volumes, spent),
            "",
            float((ends[-1] - ends[0]).norm(dim=1).max()),
            "m",
            source=f"slope of the logarithms, 0 where empty grid is free; {told}; error: largest difference of the positions",
        )
    ]


def _exponent(sizes: tuple[int, ...] | list[float], spent: list[float]) -> float:
    """Slope of a line through the logarithms."""
    x = torch.tensor([[math.log(size), 1.0] for size in sizes], dtype=torch.float64)
    y = torch.tensor([[math.log(ms)] for ms in spent], dtype=torch.float64)
    return float(torch.linalg.lstsq(x, y).solution[0, 0])


def _sleeping() -> list[Record]:
    """The same layer of snow and the same snowball, with and without sleep."""
    spent, ends = [], []
    for sleep in (None, Sleep(speed=0.05, frames=2)):
        mpm = snow_layer(sleep)
        throw_snowball(mpm)
        began = time.process_time()
        for _ in range(25):
            mpm.step(0.04)
        spent.append(time.process_time() - began)
        ends.append(mpm.positions.double())
    apart = (ends[0] - ends[1]).norm(dim=1)
    return [
        Record(
            "MPM, snowball on a layer of snow at rest: CPU time with sleep",
            spent[1] / spent[0],
            "of that without",
            float(apart.mean()),
            "m",
            source=f"{len(apart):,} particles, cells of 0.05 m, 1 s after the impact at 5 m/s; {spent[1]:.1f} s against "
            f"{spent[0]:.1f} s; error: mean distance, at most {float(apart.max()):.3f} m",
        )
    ]
