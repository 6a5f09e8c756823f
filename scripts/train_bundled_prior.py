"""Train the bundled video prior: a CogVideoX of a few million parameters that knows only clips this project renders itself.

    python scripts/train_bundled_prior.py            about 85 minutes on two cores
    python scripts/train_bundled_prior.py --quick    a toy in a minute or two, for tests (give --output another folder)

Stages: clips (courtyard and collages, rendered), encoder (closed form), latents, denoiser (transformer and text encoder),
decoder, export (with figures and a model card), descent (the test that counts, added to the card). Each leaves its result
in the work folder; run the command again after an interruption and it goes on from there. `--stages` picks out some.
"""

from __future__ import annotations

import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
from bundled_prior import components, families, judge, nets
from bundled_prior.card import Facts, write_card
from bundled_prior.decoder import calm, train_decoder
from bundled_prior.denoiser import Denoiser, Latents, train_denoiser
from bundled_prior.looks import CURATED_CAPTION, DEMO_SCENE, WRONG_CAPTION, vocabulary
from diffusers import AutoencoderKLCogVideoX, CogVideoXPipeline, CogVideoXTransformer3DModel
from rich.console import Console
from safetensors.torch import save_file
from torch import distributed
from transformers import T5EncoderModel

Stage = Literal["clips", "encoder", "latents", "denoiser", "decoder", "export", "descent"]
STAGES: tuple[Stage, ...] = ("clips", "encoder", "latents", "denoiser", "decoder", "export", "descent")
MADE = {"encoder": "encoder.json", "latents": "latents.safetensors"}
"""Stages never repeated unasked, and what shows that they are finished; the others see by themselves how far they are."""
PARALLEL = ("clips", "denoiser")
HELD_OUT = 12  # families of either kind, whole camera paths, that no training sees
CHECKPOINT_SECONDS = 180
console = Console(highlight=False, soft_wrap=True)


@dataclass(frozen=True, kw_only=True)
class Training:
    """What to train, and for how long."""

    work: Path = Path("outputs/bundled_prior")
    """Where clips, checkpoints, pictures and the log go; about 1 GB."""
    output: Path = Path(__file__).parent.parent / "pgsd_nerfstudio" / "guidance" / "bundled"
    """Where the finished prior goes, as a diffusers folder."""
    courtyard: int = 600
    """Families of clips (one motion in four looks) of the built-in courtyard."""
    collages: int = 500
    """Families of clips in front of random collages."""
    denoiser_minutes: float = 50.0
    """Time for the transformer and the text encoder."""
    decoder_minutes: float = 20.0
    """Time for the decoder, which only pictures need."""
    seed: int = 0
    workers: int = min(2, os.cpu_count() or 1)
    """Processes of one thread each: on a CPU they waste less time waiting for each other than threads do."""
    stages: tuple[Stage, ...] = STAGES
    """Which stages to run. By default all, less what an interrupted run has finished."""
    quick: bool = False
    """A toy of everything: shows that the script works, is of no use as a prior."""
    rank: int = 0
    """Which of the workers this process is; 0 starts the others."""


class Log:
    """Lines for people, on the console and in work/log.txt."""

    def __init__(self, path: Path, quiet: bool) -> None:
        self._path, self._quiet, self._began = path, quiet, time.monotonic()

    def __call__(self, line: str) -> None:
        if self._quiet:
            return
        line = f"{(time.monotonic() - self._began) / 60:6.1f} min  {line}"
        console.print(line, markup=False)
        with self._path.open("a") as file:
            file.write(line + "\n")


def main(training: Training) -> None:
    if training.quick:
        training = replace(training, courtyard=0, collages=8, denoiser_minutes=0.3, decoder_minutes=0.2, workers=1)
    training.work.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1 if training.workers > 1 else max(1, os.cpu_count() or 1))
    torch.manual_seed(training.seed)
    log = Log(training.work / "log.txt", quiet=training.rank > 0)
    for stage in training.stages:
        if training.stages == STAGES and stage in MADE and (training.work / MADE[stage]).exists():
            log(f"{stage}: done before")
            continue
        if training.rank == 0 and training.workers > 1 and stage in PARALLEL:
            with_workers(training, stage, log)
        else:
            RUN[stage](training, log)


def with_workers(training: Training, stage: Stage, log: Log) -> None:
    """Runs a stage in this process as rank 0 and in child processes as the others."""
    if stage == "denoiser":
        (training.work / "rendezvous").unlink(missing_ok=True)
    words = [sys.executable, __file__, *sys.argv[1:], "--stages", stage, "--rank"]
    children = [subprocess.Popen([*words, str(rank)]) for rank in range(1, training.workers)]
    try:
        RUN[stage](training, log)
        for child in children:
            if child.wait():
                raise RuntimeError(f"a worker of the stage {stage} ended with status {child.returncode}; its message is above")
    finally:
        for child in children:
            child.terminate()


def make_clips(training: Training, log: Log) -> None:
    log(f"clips: {training.collages} families of collages, {training.courtyard} of the courtyard")
    folder, share = training.work / "clips", (training.rank, training.workers)
    families.make_families(folder, "collage", training.collages, families.collage_family, training.seed, share)
    if training.courtyard and not all(p.exists() for p in shards(training, "courtyard")[training.rank :: training.workers]):
        from bundled_prior.courtyard import Courtyard

        families.make_families(folder, "courtyard", training.courtyard, Courtyard(), training.seed, share)


def shards(training: Training, name: str) -> list[Path]:
    return families.shard_paths(training.work / "clips", name, getattr(training, {"collage": "collages"}.get(name, name)))


def all_shards(training: Training) -> list[Path]:
    return shards(training, "courtyard") + shards(training, "collage")


def fit_encoder(training: Training, log: Log) -> None:
    """The VAE with its encoder set and its decoder at the start."""
    rng = random.Random(training.seed)
    pairs = []
    for path in all_shards(training):
        clips = families.load_families(path)[1]
        for family in rng.sample(range(len(clips)), min(len(clips), 12)):
            shown = clips[family].float() / 255
            pairs.append((shown[1:3], shown[[0, 0]]))
    vae = nets.make_vae()
    calm(vae)
    figures = components.fit(vae, pairs)
    log(f"encoder: {figures['kept']:.1%} of the variance of 4x4x4 blocks kept, deviations {figures['deviations']}")
    store(vae, training.work / "vae")
    write_json(training.work / "encoder.json", figures)


@torch.no_grad()
def encode_clips(training: Training, log: Log) -> None:
    """Latents of all clips and of their mirror images."""
    vae = AutoencoderKLCogVideoX.from_pretrained(training.work / "vae")
    values, described = [], []
    for path in all_shards(training):
        known, clips = families.load_families(path)
        described += [asdict(family) for family in known]
        for clip in clips:
            both = torch.stack([clip, clip.flip(-1)]).flatten(0, 1).float() / 255
            code = torch.cat([components.latents(vae, part) for part in both.split(2)])
            values.append(code.transpose(1, 2).unflatten(0, (2, -1)).half())
    stacked = torch.stack(values) * vae.config.scaling_factor
    save_file({"latents": stacked.contiguous()}, training.work / "latents.part", metadata={"families": json.dumps(described)})
    (training.work / "latents.part").rename(training.work / "latents.safetensors")
    log(f"latents: {len(values)} families, mean {stacked.float().mean():+.3f}, deviation {stacked.float().std():.3f}")


def read_latents(training: Training) -> tuple[Latents, Latents]:
    """Latents to train on and latents held out (courtyard first, then collages)."""
    known, values = families.load_families(training.work / "latents.safetensors", "latents")
    edges = [0, training.courtyard] if training.courtyard else [0]
    held = [i for edge in edges for i in range(edge, min(edge + HELD_OUT, edge + max(1, (len(known) - edge) // 4)))]
    kept = [i for i in range(len(known)) if i not in set(held)]
    return Latents([known[i] for i in kept], values[kept]), Latents([known[i] for i in held], values[held])


def fit_denoiser(training: Training, log: Log) -> None:
    checkpoint = training.work / "denoiser"
    tokenizer = nets.make_tokenizer(vocabulary())
    data, held = read_latents(training)
    alpha_bar = nets.make_scheduler().alphas_cumprod.float()
    progress = checkpoint / "progress.json"
    before = json.loads(progress.read_text()) if progress.exists() else {"done": 0.0, "steps": 0}
    start, steps = before["done"], before.get("steps", 0)
    if start:
        log(f"denoiser: going on from a checkpoint at {start:.0%}")
    model = load_denoiser(training) if start else make_denoiser(training, tokenizer)
    if training.workers > 1:
        store_file = distributed.FileStore(str(training.work / "rendezvous"), training.workers)
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
        distributed.init_process_group("gloo", store=store_file, rank=training.rank, world_size=training.workers)
    saved = time.monotonic()

    def report(step: int, done: float, figures: dict[str, float]) -> None:
        nonlocal saved, steps
        steps = before.get("steps", 0) + step
        log(f"denoiser {done:4.0%} step {step} " + " ".join(f"{k} {v:.4f}" for k, v in figures.items()))
        if training.rank == 0 and time.monotonic() - saved > CHECKPOINT_SECONDS:
            saved = time.monotonic()
            model.eval()
            store_denoiser(model, checkpoint, done, steps)
            log("  " + judge.as_table(judge.direction(model, held, alpha_bar, list(range(min(8, len(held.families)))))))
            model.train()

    steps = before.get("steps", 0) + train_denoiser(
        model, data, alpha_bar, minutes=training.denoiser_minutes, rate=2e-3, seed=training.seed, report=report, start=start,
        families_per_batch=2 if training.workers > 1 else 4,
    )  # fmt: skip
    if training.workers > 1:
        distributed.barrier()
        distributed.destroy_process_group()
    if training.rank == 0:
        store_denoiser(model, checkpoint, 1.0, steps)


def make_denoiser(training: Training, tokenizer) -> Denoiser:
    torch.manual_seed(training.seed)
    size = (64, 2) if training.quick else (160, 5)
    return Denoiser(nets.make_transformer(*size), nets.make_text_encoder(len(tokenizer)), tokenizer)


def load_denoiser(training: Training) -> Denoiser:
    folder = training.work / "denoiser"
    transformer = CogVideoXTransformer3DModel.from_pretrained(folder / "transformer")
    text_encoder = T5EncoderModel.from_pretrained(folder / "text_encoder")
    return Denoiser(transformer, text_encoder, nets.make_tokenizer(vocabulary())).eval()


def store_denoiser(model: Denoiser, folder: Path, done: float, steps: int) -> None:
    beside = folder.with_name("denoiser.part")
    shutil.rmtree(beside, ignore_errors=True)
    model.transformer.save_pretrained(beside / "transformer")
    model.text_encoder.save_pretrained(beside / "text_encoder")
    write_json(beside / "progress.json", {"done": done, "steps": steps})
    replace_folder(beside, folder)


def fit_decoder(training: Training, log: Log) -> None:
    vae = AutoencoderKLCogVideoX.from_pretrained(training.work / "vae")
    progress = training.work / "decoder.json"
    start = json.loads(progress.read_text())["done"] if progress.exists() else 0.0
    clips = [families.load_families(path)[1] for path in all_shards(training)]
    saved, psnr = time.monotonic(), math.nan

    def report(step: int, done: float, figures: dict[str, float]) -> None:
        nonlocal saved, psnr
        psnr = figures["psnr"]
        log(f"decoder {done:4.0%} step {step} loss {figures['loss']:.4f} psnr {psnr:.2f} dB")
        if time.monotonic() - saved > CHECKPOINT_SECONDS:
            saved = time.monotonic()
            store(vae, training.work / "vae")
            write_json(progress, {"done": done, "psnr": psnr})

    train_decoder(
        vae, clips, minutes=training.decoder_minutes, rate=2e-3, seed=training.seed, report=report, start=start
    )  # fmt: skip
    store(vae, training.work / "vae")
    write_json(progress, {"done": 1.0, "psnr": psnr})
    draw_restored(training, vae)


@torch.no_grad()
def draw_restored(training: Training, vae: AutoencoderKLCogVideoX) -> None:
    """Clips above what the VAE makes of them."""
    rows = []
    for path in all_shards(training)[:: max(1, len(all_shards(training)) // 3)]:
        for kind in (1, 2):
            clip = families.load_families(path)[1][0, kind].float() / 255
            code = vae.encode(2 * clip.transpose(0, 1)[None] - 1).latent_dist.mode().transpose(1, 2)
            rows += [clip, judge.decode(vae, code * vae.config.scaling_factor)[0]]
    judge.write_sheet(training.work / "restored.png", rows)


@torch.no_grad()
def export(training: Training, log: Log) -> None:
    """The diffusers folder, the figures, the pictures and the model card."""
    model, vae = load_denoiser(training), AutoencoderKLCogVideoX.from_pretrained(training.work / "vae")
    scheduler = nets.make_scheduler()
    _, held = read_latents(training)
    alpha_bar = scheduler.alphas_cumprod.float()
    found = judge.direction(model, held, alpha_bar, list(range(len(held.families))))
    log("direction of guidance, held-out clips: " + judge.as_table(found))
    captions = [c.format(scene=DEMO_SCENE) for c in (CURATED_CAPTION, "No weather, clear air in {scene}", WRONG_CAPTION)]
    codes = torch.cat([judge.sample(model, scheduler, captions, seed=seed) for seed in range(1 if training.quick else 3)])
    judge.write_sheet(training.work / "samples.png", list(judge.decode(vae, codes)))

    beside = training.output.with_name(training.output.name + ".part")
    shutil.rmtree(beside, ignore_errors=True)
    parts = {"transformer": model.transformer, "vae": vae, "text_encoder": model.text_encoder}
    parameters = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
    halves = {name: part.half() for name, part in parts.items()}
    CogVideoXPipeline(tokenizer=model.tokenizer, scheduler=scheduler, **halves).save_pretrained(beside, safe_serialization=True)
    for file in beside.rglob("*.json"):
        # The name that transformers before version 5 knows too, and no path of the machine that trained it.
        text = file.read_text().replace("TokenizersBackend", "PreTrainedTokenizerFast")
        file.write_text(re.sub(r'\n *"_name_or_path": "[^"]*",', "", text))
    facts = Facts(
        parameters=parameters,
        words=len(vocabulary()),
        seed=training.seed,
        courtyard=training.courtyard,
        collages=training.collages,
        kept=json.loads((training.work / "encoder.json").read_text())["kept"],
        psnr=json.loads((training.work / "decoder.json").read_text())["psnr"],
        steps=json.loads((training.work / "denoiser" / "progress.json").read_text())["steps"],
        held=len(held.families),
        direction=found,
    )
    write_card(beside / "README.md", facts)
    write_json(training.work / "figures.json", asdict(facts))
    for file in beside.rglob("*"):
        file.chmod(0o755 if file.is_dir() else 0o644)  # safetensors writes files that only their owner may read
    replace_folder(beside, training.output)
    megabytes = sum(p.stat().st_size for p in training.output.rglob("*") if p.is_file()) / 1e6
    log(f"exported {training.output}: {megabytes:.1f} MB; pictures in {training.work}")


def descend_from_wrong(training: Training, log: Log) -> None:
    """Distils a wrong look with the exported prior, against two negative prompts; into the card goes how far that led."""
    if training.quick:
        return
    from bundled_prior.descent import descend

    from pgsd_nerfstudio.effects import effect

    rows = {}
    for name, negative in (("the effect's", effect("snowfall").negative_prompt), ("empty", "")):
        descent = descend(training.output, negative=negative, seed=training.seed)
        judge.write_sheet(training.work / f"descent_{name.split()[0]}.png", descent.clips)
        rows[name] = [row for row in descent.rows if row[0] % 20 == 0]
        for line in descent.table():
            log(f"descent, {name} negative prompt: {line}")
    figures = json.loads((training.work / "figures.json").read_text())
    direction = {int(t): tuple(value) for t, value in figures.pop("direction").items()}
    figures.pop("descent")
    write_card(training.output / "README.md", Facts(**figures, direction=direction, descent=rows))


def store(vae: AutoencoderKLCogVideoX, folder: Path) -> None:
    beside = folder.with_name(folder.name + ".part")
    shutil.rmtree(beside, ignore_errors=True)
    vae.save_pretrained(beside)
    replace_folder(beside, folder)


def replace_folder(new: Path, old: Path) -> None:
    """Puts `new` in the place of `old`, which is complete at every moment but that of the exchange."""
    aside = old.with_name(old.name + ".old")
    shutil.rmtree(aside, ignore_errors=True)
    if old.exists():
        old.rename(aside)
    new.rename(old)
    shutil.rmtree(aside, ignore_errors=True)


def write_json(path: Path, content: dict) -> None:
    path.with_suffix(".part").write_text(json.dumps(content, indent=1))
    path.with_suffix(".part").rename(path)


RUN: dict[Stage, Callable[[Training, Log], None]] = {
    "clips": make_clips,
    "encoder": fit_encoder,
    "latents": encode_clips,
    "denoiser": fit_denoiser,
    "decoder": fit_decoder,
    "export": export,
    "descent": descend_from_wrong,
}

if __name__ == "__main__":
    main(tyro.cli(Training, description=__doc__))
