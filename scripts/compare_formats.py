"""Compares splats in other formats with the .ply that they were made from, and prints the table of docs/formats.md.

python scripts/compare_formats.py --original garden.ply --folder converted --data data/garden

Each file is read as scenes are, and brought back by a half turn about an axis where its converter turned it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from scipy.spatial import cKDTree

from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.scene.similarity import moved
from pgsd_nerfstudio.scene.splats.reading import read_splat

TURNS = {"": (1, 1, 1), "x": (1, -1, -1), "y": (-1, 1, -1), "z": (-1, -1, 1)}
"""Half turns, by their axis."""


@dataclass(frozen=True)
class Compare:
    """How far what is read of each format lies from the original."""

    original: Path
    """The .ply that the others were made from."""
    folder: Path
    """Holds the others."""
    data: Path
    """Cameras of the original: a transforms.json, its folder, or another capture."""
    view: int = 40
    """Training view that is rendered."""
    width: int = 512
    """Pixels; the height follows."""

    def run(self) -> None:
        original = read_splat(self.original).gaussians
        cameras = read_capture(self.data).cameras()[self.view]
        cameras = cameras.resized(self.width, round(self.width * cameras.height / cameras.width))
        shown = picture(original, cameras)
        extent = float((original.means.amax(dim=0) - original.means.amin(dim=0)).max())
        print(f"{len(original):,} Gaussians of degree {original.sh_degree} over {extent:.4g} units, view {self.view}")
        print("| file | kB | degree | half turn | centres, largest | centres, mean | PSNR, dB | read in |")
        print("|---|---|---|---|---|---|---|---|")
        for path in sorted(self.folder.iterdir(), key=lambda path: path.name.lower()):
            try:
                read = read_splat(path).gaussians
                took = min(seconds(path) for _ in range(5))
            except SceneError as error:
                print(f"| {path.name} | {error} |")
                continue
            turn, back = upright(read, original)
            apart = distances(back, original)
            alike = psnr(picture(back, cameras), shown)
            bytes_held = sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))
            print(
                f"| {path.name} | {bytes_held / 1e3:,.0f} | {read.sh_degree} | {turn or 'none'} | {apart.max() / extent:.1e} "
                f"| {apart.mean() / extent:.1e} | {f'{alike:.1f}' if alike < 100 else 'exact'} | {1e3 * took:.0f} ms |",
                flush=True,
            )


def seconds(path: Path) -> float:
    """How long reading takes once."""
    began = time.perf_counter()
    read_splat(path)
    return time.perf_counter() - began


def upright(read: Gaussians, original: Gaussians) -> tuple[str, Gaussians]:
    """The half turn that brings `read` nearest to the original, and what it makes of it."""
    few = read.select(torch.arange(0, len(read), max(1, len(read) // 2000)))
    turns = {name: torch.diag(torch.tensor([*signs, 1.0], dtype=torch.float64)) for name, signs in TURNS.items()}
    best = min(turns, key=lambda name: float(distances(moved(few, turns[name]), original).mean()))
    return best, moved(read, turns[best])


def distances(read: Gaussians, original: Gaussians) -> torch.Tensor:
    """From each centre to the nearest of the original; converters put Gaussians into another order."""
    return torch.from_numpy(cKDTree(original.means.numpy()).query(read.means.numpy())[0])


def picture(gaussians: Gaussians, cameras: Cameras) -> torch.Tensor:
    """[height, width, 3] in 0..1."""
    return CpuRasterizer(gaussians).render(cameras).rgb[0].clamp(0.0, 1.0)


def psnr(picture: torch.Tensor, truth: torch.Tensor) -> float:
    return float(-10.0 * torch.log10((picture - truth).square().mean().clamp_min(1e-15)))


if __name__ == "__main__":
    try:
        tyro.cli(Compare, description=__doc__).run()
    except SceneError as error:
        Console(stderr=True).print(f"[red]{error}[/red]", soft_wrap=True)
        raise SystemExit(1) from error
