"""Families of clips on disk: one motion, one camera path, one background, seen without weather and with three looks.

Within a family only the look differs, so the denoiser has nothing but the words to explain the difference by.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.progress import track
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from bundled_prior.collage import Collage
from bundled_prior.looks import AMOUNTS, DEMO_SCENE, SCENES, WRONG, Look, caption, draw_look

FRAMES, HEIGHT, WIDTH = 9, 64, 96
KINDS = ("clear", "curated", "wrong", "any")
SHARD = 50  # families per file, so that an interruption loses little


@dataclass(frozen=True)
class Family:
    """What the clips of one family show, in the order of KINDS."""

    looks: tuple[Look | None, ...]
    amount: str
    scene: str

    def caption(self, rng: random.Random, kind: int) -> str:
        return caption(rng, self.looks[kind], self.amount, self.scene)


Maker = Callable[[random.Random], tuple[Family, Tensor]]
"""Draws one family: its description and its clips [kinds, t, 3, h, w] in 0..1."""


def draw_looks(rng: random.Random) -> tuple[Look | None, ...]:
    return (None, draw_look(rng, "curated"), WRONG if rng.random() < 0.3 else draw_look(rng, "wrong"), draw_look(rng, "any"))


def collage_family(rng: random.Random) -> tuple[Family, Tensor]:
    """A family in front of a collage; its scene words are drawn at random, because a collage can be anything."""
    family = Family(draw_looks(rng), rng.choice(AMOUNTS), DEMO_SCENE if rng.random() < 0.1 else rng.choice(SCENES))
    collage = Collage(rng, FRAMES, WIDTH, HEIGHT, family.amount)
    return family, torch.stack([collage.clip(look) for look in family.looks])


def shard_paths(folder: Path, name: str, count: int) -> list[Path]:
    """The files that `count` families go into."""
    return [folder / f"{name}-{i:03d}.safetensors" for i in range(-(-count // SHARD))]


def make_families(folder: Path, name: str, count: int, make: Maker, seed: int, share: tuple[int, int] = (0, 1)) -> None:
    """Writes `count` families into shards name-000.safetensors, ...; shards that exist are kept.

    `share` (rank, of how many) is this worker's part of the shards.
    """
    folder.mkdir(parents=True, exist_ok=True)
    todo = [(i, path) for i, path in enumerate(shard_paths(folder, name, count)) if i % share[1] == share[0]]
    for number, path in track(todo, description=f"{name} clips", disable=share[0] > 0):
        if path.exists():
            continue
        rng = random.Random(f"{seed} {name} {number}")
        made = [make(rng) for _ in range(min(SHARD, count - number * SHARD))]
        clips = torch.stack([(255 * clips).round().to(torch.uint8) for _, clips in made])
        described = [asdict(family) for family, _ in made]
        beside = path.with_suffix(".part")
        save_file({"clips": clips}, beside, metadata={"families": json.dumps(described)})
        beside.rename(path)


def load_families(path: Path, tensor: str = "clips") -> tuple[list[Family], Tensor]:
    """The families of one shard and their clips (uint8) or whatever tensor the shard holds."""
    with safe_open(path, "pt") as file:
        described = json.loads(file.metadata()["families"])
        return [_family(**each) for each in described], file.get_tensor(tensor)


def _family(looks: list[dict | None], amount: str, scene: str) -> Family:
    read = (Look(look["size"], look["opacity"], tuple(look["tint"])) if look else None for look in looks)
    return Family(tuple(read), amount, scene)
