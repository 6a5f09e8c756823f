"""What a frame costs on the CPU and how wrong it is: image sizes, frozen and dynamic counts, exact and layered, threads."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.timing import least
from pgsd_nerfstudio.laboratory.yard import middle, view_into_yard, yard, yard_flakes
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.rasterizer import Rendering
from pgsd_nerfstudio.rendering.reference import render_reference
from pgsd_nerfstudio.rendering.trial import relative_error
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians

SIZES = ((96, 64), (512, 512), (648, 420))
FROZEN = (50_000, 150_000, 1_000_000)
DYNAMIC = (10_000, 50_000, 250_000)


def layers_for(width: int, height: int) -> int:
    """Layers that keep a picture above 48 dB: a small picture has large tiles, in which more happens one behind the other."""
    return 64 if width * height < 20_000 else 16


class Case(NamedTuple):
    """One picture to be timed."""

    cameras: Cameras
    frozen: Gaussians
    dynamic: Gaussians

    @property
    def label(self) -> str:
        size = f"{self.cameras.width}x{self.cameras.height}"
        return f"{size}, {len(self.frozen) / 1e3:g}k frozen, {len(self.dynamic) / 1e3:g}k dynamic"


def bench(quick: bool) -> list[Record]:
    """All combinations; --quick: one scene in two sizes."""
    rows = []
    for width, height in SIZES[:2] if quick else SIZES:
        cameras = view_into_yard(width, height)
        for n in (80_000,) if quick else FROZEN:
            frozen = yard(n)
            for m in (20_000,) if quick else DYNAMIC:
                case = Case(cameras, frozen, yard_flakes(m))
                more = {"threads": 2, "sweep": (4, 8, 16, 32, 64)} if (n, m) == (150_000, 50_000) else {}
                rows += costs(case, tries=3 if quick else 7, window=32, **more)
    whole = Case(view_into_yard(96, 64) if quick else view_into_yard(648, 420), yard(80_000), yard_flakes(20_000))
    return [*rows, out_of_sight(whole, 25_000 if quick else 250_000), against_torch(whole), *_compilation(quick)]


def costs(case: Case, *, tries: int, window: int, threads: int = 1, sweep: tuple[int, ...] = ()) -> list[Record]:
    """Rows of one case: exact against the float64 reference on the middle `window`, layers against exact on all pixels.

    `threads`: above 1 they are compared with one thread, and the case is held against its targets.
    `sweep`: further numbers of layers to be timed, for the curve of time against error.
    """
    exact = CpuRasterizer(case.frozen)
    truth = Case(middle(case.cameras, min(window, case.cameras.height)), case.frozen, case.dynamic)
    picture, gradient = _errors(truth, CpuRasterizer(case.frozen))
    source = f"one thread, least of {tries}; error: float64 reference on the middle {window}x{window} pixels"
    rows = [_first(case, tries, picture, source)]
    rows += _timed(case, exact, "exact", tries, threads, picture, gradient, source)
    before = next(row.value for row in rows if row.name.startswith("forward+backward, exact"))
    assert before is not None
    standard = layers_for(case.cameras.width, case.cameras.height)
    for count in (standard, *(n for n in sweep if n != standard)):
        rows += _layered(case, exact, count, tries, threads if count == standard else 1, before, compare=count == standard)
    return rows


def _layered(
    case: Case, exact: CpuRasterizer, count: int, tries: int, threads: int, before: float, *, compare: bool
) -> list[Record]:
    """Rows of one number of layers; `before`: milliseconds of the exact forward+backward, to `compare` with."""
    layered = CpuRasterizer(case.frozen, layers=count)
    found, expected = (_rendered_and_gradient(case, rasterizer) for rasterizer in (layered, exact))
    picture, gradient = psnr(found[0].rgb, expected[0].rgb), relative_error(found[1], expected[1].double())
    cosine = torch.nn.functional.cosine_similarity(found[1].double(), expected[1].double(), dim=0).item()
    source = f"one thread, least of {tries}; error: the exact picture, all pixels"
    rows = _timed(case, layered, f"layers {count}", tries, threads, picture, gradient, source)
    if not compare:
        return rows
    after = next(row.value for row in rows if row.name.startswith("forward+backward"))
    assert after is not None
    name, factor = f"layers {count} against exact, {case.label}", before / after
    paid = {"error": picture, "error_unit": "dB", "source": "forward+backward, one thread"}
    if threads == 1:
        return [*rows, Record(name, factor, "times faster", **paid)]
    return [
        *rows,
        Record.judged(name, factor, "times faster", ">= 3", **paid),
        Record.judged(
            f"picture of layers {count}, {case.label}", picture, "dB", ">= 48", source="the exact picture, all pixels"
        ),
        Record.judged(f"gradient cosine of layers {count}, {case.label}", cosine, "", ">= 0.997", source="all parameters"),
    ]


def _first(case: Case, tries: int, picture: float, source: str) -> Record:
    alone = least(lambda: CpuRasterizer(case.frozen).render(case.cameras, case.dynamic), min(tries, 3))
    return Record(f"first picture from a camera, {case.label}", alone, "ms CPU", picture, "dB", source=source)


def _timed(
    case: Case,
    rasterizer: CpuRasterizer,
    mode: str,
    tries: int,
    threads: int,
    picture: float,
    gradient: float,
    source: str,
) -> list[Record]:
    """Forward, forward+backward, both on several threads, and the memory of the prepared view."""
    leaf, weights = leaves(case.dynamic), weights_for(case.cameras)

    def forward() -> object:
        with torch.no_grad():
            return rasterizer.render(case.cameras, case.dynamic)

    def both() -> object:
        return rasterizer.render(case.cameras, leaf).rgb.backward(weights)

    rows = [
        Record(f"forward, {mode}, {case.label}", least(forward, tries), "ms CPU", picture, "dB", source=source),
        Record(f"forward+backward, {mode}, {case.label}", least(both, tries), "ms CPU", gradient, "relative L2", source=source),
        Record(f"prepared view, {mode}, {case.label}", rasterizer.views.nbytes / 1e6, "MB", source="kept for each camera"),
    ]
    if threads > 1:
        # By turns: on a shared machine the second core comes and goes.
        pairs = [[least(both, tries, threads=n, wall=True) for n in (1, threads)] for _ in range(3)]
        one, several = (min(times) for times in zip(*pairs, strict=True))
        name = f"{threads} threads against one, {mode}, {case.label}"
        why = "wall clock, forward+backward; needs a machine that does nothing else"
        rows.append(
            Record.judged(name, one / several, "times faster", ">= 1.6", error=gradient, error_unit="relative L2", source=why)
        )
    return rows


def out_of_sight(case: Case, n: int) -> Record:
    """What dynamic Gaussians cost that no pixel shows: all behind the camera."""
    flakes = yard_flakes(n)
    behind = replace(flakes, means=flakes.means + torch.tensor([0.0, -20.0, 0.0]))
    rasterizer, leaf, weights = CpuRasterizer(case.frozen), leaves(behind), weights_for(case.cameras)
    value = least(lambda: rasterizer.render(case.cameras, leaf).rgb.backward(weights), 7)
    alone, found = (rasterizer.render(case.cameras, moving).rgb for moving in (None, behind))
    size, error = f"{case.cameras.width}x{case.cameras.height}", (found - alone).abs().max().item()
    source = "forward+backward, one thread, least of 7; the picture is that of the frozen scene"
    return Record(
        f"{n / 1e3:g}k dynamic behind the camera, {size}", value, "ms CPU", error, "largest difference", source=source
    )


def against_torch(case: Case) -> Record:
    """A vectorised torch rasterizer of the same conventions, forward, beside ours in one run."""
    exact = CpuRasterizer(case.frozen)

    def peer() -> Rendering:
        with torch.no_grad():
            return render_reference(case.cameras, [case.frozen, case.dynamic], dtype=torch.float32)

    theirs, ours = least(peer, 1, warm=False), least(lambda: exact.render(case.cameras, case.dynamic), 5)
    error = psnr(exact.render(case.cameras, case.dynamic).rgb, peer().rgb)
    source = f"reference.py in float32, one thread, forward: {theirs:.0f} ms against {ours:.1f} ms"
    return Record.judged(
        f"against vectorised torch, {case.label}",
        theirs / ours,
        "times faster",
        ">= 30",
        error=error,
        error_unit="dB",
        source=source,
    )


_FIRST_CALL = """
import time
import torch
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.trial import random_cameras, random_gaussians
frozen, dynamic = random_gaussians(50), random_gaussians(20, 1)
dynamic.means.requires_grad_()
began = time.perf_counter()
for layers in (None, 4):
    CpuRasterizer(frozen, layers=layers).render(random_cameras(1, 32, 32), dynamic).rgb.sum().backward()
print(time.perf_counter() - began)
"""


def _compilation(quick: bool) -> list[Record]:
    """Seconds of the first picture and gradient of a process, with an empty cache of kernels and with a full one."""
    if quick:
        return []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        seconds = []
        for _ in range(3):
            done = subprocess.run(
                [sys.executable, "-c", _FIRST_CALL], env=environment, capture_output=True, text=True, check=True
            )
            seconds.append(float(done.stdout))
    source = "exact and layers, forward and backward, in a process of its own"
    return [
        Record.judged("first call after installation", seconds[0], "s", "<= 25", source=source),
        Record.judged("first call of a later process", min(seconds[1:]), "s", "<= 1.5", source=source),
    ]


def leaves(gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Gaussians:
    """The same with gradients of their own."""
    return replace(gaussians, **{n: t.detach().clone().to(dtype).requires_grad_() for n, t in gaussians.tensors.items()})


def weights_for(cameras: Cameras) -> Tensor:
    """A fixed random gradient of the colours, as a loss on the picture would hand on."""
    shape = (len(cameras), cameras.height, cameras.width, 3)
    return torch.randn(shape, generator=torch.Generator().manual_seed(0))


def _rendered_and_gradient(case: Case, rasterizer: CpuRasterizer | None) -> tuple[Rendering, Tensor]:
    """Picture and gradient of all parameters as one vector; by the float64 reference where there is no rasterizer."""
    leaf = leaves(case.dynamic, torch.float32 if rasterizer else torch.float64)
    clip = rasterizer.render(case.cameras, leaf) if rasterizer else render_reference(case.cameras, [case.frozen, leaf])
    clip.rgb.backward(weights_for(case.cameras).to(clip.rgb))
    vector = torch.cat([tensor.grad.flatten() for tensor in leaf.tensors.values() if tensor.grad is not None])
    return Rendering(*(image.detach() for image in clip)), vector


def _errors(case: Case, rasterizer: CpuRasterizer) -> tuple[float, float]:
    """PSNR and relative error of the gradient against the reference."""
    found, expected = _rendered_and_gradient(case, rasterizer), _rendered_and_gradient(case, None)
    return psnr(found[0].rgb, expected[0].rgb), relative_error(found[1], expected[1])


def psnr(found: Tensor, expected: Tensor) -> float:
    return -10.0 * math.log10(max((found.double() - expected.double()).square().mean().item(), 1e-20))
