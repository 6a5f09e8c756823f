"""Times the CPU rasterizer on a scene of your own, beside another numba rasterizer if one is given, all in one process.

python scripts/compare_rasterizers.py --load-scene garden.ply --data data/garden
python scripts/compare_rasterizers.py --load-scene garden.ply --data data/garden --peer other.py

The peer is a Python file with the functions project_np, bin_tiles, forward, backward and _merge, arrays in, arrays out.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console

from pgsd_nerfstudio.laboratory.records import Record, print_records, write_records
from pgsd_nerfstudio.laboratory.rows.rasterizer import Case, against_torch, costs, leaves, psnr, weights_for
from pgsd_nerfstudio.laboratory.timing import least
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors
from pgsd_nerfstudio.weather.loading import load_scene


@dataclass(frozen=True)
class Compare:
    """What frames of this scene cost, with flakes before one of its cameras."""

    load_scene: Path
    """A 3DGS .ply (with --data) or another scene that needs no nerfstudio."""
    data: Path | None = None
    """Folder of transforms.json."""
    peer: Path | None = None
    """Python file of another rasterizer."""
    view: int = 40
    """Training view that is rendered."""
    dynamic: int = 50_000
    """Flakes, all of them in view, evenly spread over its frustum."""
    tries: int = 7
    """Of which the least counts."""
    json: Path | None = None
    """Also write the rows here."""

    def run(self) -> list[Record]:
        scene = load_scene(self.load_scene, self.data)
        rows: list[Record] = []
        for width, height in ((96, 64), (648, 420)):
            cameras = scene.cameras[self.view].resized(width, height)
            case = Case(cameras, scene.gaussians, flakes_before(scene, cameras, self.dynamic))
            rows += costs(case, tries=self.tries, window=32, threads=2)
            rows.append(everything(case, self.tries))
            if self.peer is not None:
                rows += beside(case, _module(self.peer), self.tries)
            rows.append(against_torch(case))
        return rows


def flakes_before(scene: Scene, cameras: Cameras, n: int) -> Gaussians:
    """Flakes of 2-12 mm between 0.25 and 4 m before the camera, as many in each part of its frustum."""
    generator = torch.Generator().manual_seed(0)
    c2w, K, unit = torch.linalg.inv(cameras.viewmats[0]), cameras.Ks[0], scene.frame.metres_per_unit
    depth = (0.25**3 + (4.0**3 - 0.25**3) * torch.rand(n, generator=generator)) ** (1 / 3) / unit
    pixels = torch.rand(n, 2, generator=generator) * torch.tensor([cameras.width, cameras.height])
    across = (pixels - K[:2, 2]) / K.diagonal()[:2] * depth[:, None]
    means = torch.cat([across, depth[:, None]], dim=1) @ c2w[:3, :3].T + c2w[:3, 3]
    diameters = 0.002 + 0.01 * torch.rand(n, 1, generator=generator) ** 3
    scales = 0.3 * diameters * torch.ones(1, 3) / unit
    quats = torch.randn(n, 4, generator=generator)
    return Gaussians(means, quats, scales, torch.full((n,), 0.8), torch.rand(n, 3, generator=generator))


def _all_dynamic(case: Case) -> Gaussians:
    """The frozen scene as dynamic Gaussians of plain colour."""
    colors = view_colors(case.frozen.colors, case.frozen.means, case.cameras.viewmats[0])
    return Gaussians(**{**case.frozen.tensors, "colors": colors})


def everything(case: Case, tries: int) -> Record:
    """Scene and flakes as one set, nothing frozen, gradients for all: what the frozen cache and the layers save."""
    empty, weights = CpuRasterizer(Gaussians.empty()), weights_for(case.cameras)
    leaf = leaves(concatenate([_all_dynamic(case), case.dynamic]))
    value = least(lambda: empty.render(case.cameras, leaf).rgb.backward(weights), tries)
    name = f"forward+backward, nothing frozen, {case.cameras.width}x{case.cameras.height}, {len(leaf) / 1e3:g}k"
    return Record(name, value, "ms CPU", source="gradients of all Gaussians")


def beside(case: Case, peer: ModuleType, tries: int) -> list[Record]:
    """The peer on the same input: all gradients, and the flakes merged with its prepared frozen part."""
    width, height = case.cameras.width, case.cameras.height
    weights = weights_for(case.cameras)
    none = np.zeros((height, width), np.float32)

    def arrays(gaussians: Gaussians) -> dict[str, Any]:
        names = {"means": "means", "quats": "quats", "scales": "scales", "opac": "opacities", "colors": "colors"}
        tensors = {short: np.ascontiguousarray(getattr(gaussians, name).numpy()) for short, name in names.items()}
        camera = {"V": case.cameras.viewmats[0].numpy(), "K": case.cameras.Ks[0].numpy(), "W": width, "H": height}
        return {**tensors, **camera}

    still, moving = arrays(_all_dynamic(case)), arrays(case.dynamic)

    def all_gradients() -> None:
        splats, boxes = peer.project_np(still)
        offsets, entries = peer.bin_tiles(splats, boxes, width, height)
        rgb, light = peer.forward(splats, boxes, offsets, entries, width, height)
        peer.backward(still, splats, boxes, offsets, entries, width, height, rgb, light, weights[0].numpy(), none)

    frozen, frozen_boxes = peer.project_np(still)
    frozen_offsets, frozen_entries = peer.bin_tiles(frozen, frozen_boxes, width, height)

    def merged() -> np.ndarray:
        splats, boxes = peer.project_np(moving)
        offsets, entries = peer.bin_tiles(splats, boxes, width, height)
        splats, boxes = np.concatenate([frozen, splats]), np.concatenate([frozen_boxes, boxes])
        joint = (frozen_offsets + offsets).astype(np.int32)
        order = np.empty(joint[-1], np.int32)
        peer._merge(splats, frozen_offsets, frozen_entries, offsets, entries, len(frozen), joint, order)
        rgb, light = peer.forward(splats, boxes, joint, order, width, height)
        peer.backward(moving, splats, boxes, joint, order, width, height, rgb, light, weights[0].numpy(), none, g0=len(frozen))
        return rgb

    exact, empty = CpuRasterizer(case.frozen), CpuRasterizer(Gaussians.empty())
    leaf, all_leaf = leaves(case.dynamic), leaves(_all_dynamic(case))
    rows = []
    for name, theirs, ours, target in (
        ("all gradients", all_gradients, lambda: empty.render(case.cameras, all_leaf).rgb.backward(weights), "<= 1"),
        (
            "flakes over the frozen cache, exact",
            merged,
            lambda: exact.render(case.cameras, leaf).rgb.backward(weights),
            "<= 0.75",
        ),
    ):
        # By turns, so that both meet the same machine.
        pairs = [(least(ours, 1), least(theirs, 1)) for _ in range(tries)]
        own, other = (min(times) for times in zip(*pairs, strict=True))
        error = psnr(exact.render(case.cameras, case.dynamic).rgb[0].detach(), torch.from_numpy(merged()))
        source = f"forward+backward {own:.1f} ms CPU against {other:.1f}; error: picture against the peer's"
        label = f"time over the peer's, {name}, {width}x{height}"
        rows.append(Record.judged(label, own / other, "", target, error=error, error_unit="dB", source=source))
    return rows


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("peer_rasterizer", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"--peer must be a Python file, found {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # numba's cache of compiled functions looks it up there
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    chosen = tyro.cli(Compare)
    found = chosen.run()
    print_records(str(chosen.load_scene), found, Console())
    if chosen.json is not None:
        write_records(chosen.json, found)
