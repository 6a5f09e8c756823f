"""What a guidance step with CogVideoX-2B holds in memory and computes: counted from its architecture, and measured on CUDA.

Neither needs the model's weights: only shapes and number formats decide, and diffusers' defaults are the 2B's configuration
(Yang et al., "CogVideoX", 2024; its number of parameters is checked). The count leaves out the workspace of kernels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from pgsd_nerfstudio.guidance import CogVideoXPrior, VideoPrior
from pgsd_nerfstudio.guidance.cogvideox import recompute_resnets
from pgsd_nerfstudio.guidance.memory import MemoryMeter, weights
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b

FRAMES, HEIGHT, WIDTH = 9, 480, 720
TEXT = (2, 226, 4096)
GB = 1e9
TARGET = "<= 20"
STEP = f"CogVideoX-2B in fp16, {FRAMES} frames of {WIDTH}x{HEIGHT}"
COUNTED = "counted on fake tensors, encoder forward, guidance pair, encoder backward; without kernels' workspace"


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """How the gradient of one guidance step is carried back to the clip."""

    recomputed: Literal["resnets", "stages too", "nothing"] = "resnets"
    """What the encoder's backward pass makes again instead of finding it kept; `stages too` is diffusers' own switch."""
    twice: bool = False
    """Encode without a graph, evaluate the guidance pair, then encode again for the gradient."""
    tiny: bool = False
    """Let the gradient pass the tiny encoder taecvx; the VAE's weights stay loaded."""


USED = Arrangement()
OTHERS = {
    "encoder run twice around the pair": Arrangement(twice=True),
    "whole stages recomputed too": Arrangement(recomputed="stages too"),
    "nothing recomputed": Arrangement(recomputed="nothing"),
    "nothing recomputed, encoder twice": Arrangement(recomputed="nothing", twice=True),
    "through taecvx": Arrangement(tiny=True),
}


class Count(NamedTuple):
    """Bytes of one guidance step."""

    parameters: int
    """Of the transformer; a number, not bytes."""
    weights: int
    """Of transformer and VAE (and tiny encoder)."""
    peak: int
    phases: dict[str, int]
    """Peak of each: look, encode, pair, backward."""


def rows(quick: bool) -> Iterable[Record]:
    """Memory and arithmetic of one guidance step; `quick` leaves out the arithmetic and arrangements that are not in use."""
    used = counted(USED)
    billions = round(used.parameters / 1e9, 3)
    yield Record.judged("parameters of the counted transformer", billions, "billion", "== 1.694", source=STEP)
    yield Record.judged(f"peak of a guidance step, {STEP}", used.peak / GB, "GB", TARGET, source=COUNTED)
    yield Record("of that, weights of transformer and VAE", used.weights / GB, "GB", source=COUNTED)
    yield Record("of that, activations of the VAE's backward pass", (used.peak - used.weights) / GB, "GB", source=COUNTED)
    yield Record("held while the guidance pair is evaluated", used.phases["pair"] / GB, "GB", source=COUNTED)
    yield measured(used)
    if quick:
        return
    yield Record("arithmetic of a guidance step", arithmetic(USED) / 1e12, "TFLOP", source=COUNTED)
    for how, arrangement in OTHERS.items():
        yield Record(f"the same peak, {how}", counted(arrangement).peak / GB, "GB", source=COUNTED)
        yield Record(f"the same arithmetic, {how}", arithmetic(arrangement) / 1e12, "TFLOP", source=COUNTED)


def random_2b(device: str, arrangement: Arrangement = USED) -> CogVideoXPrior:
    """CogVideoX-2B with random weights in float16; under FakeTensorMode it needs no memory."""
    from diffusers.models.autoencoders.autoencoder_kl_cogvideox import AutoencoderKLCogVideoX
    from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXTransformer3DModel

    with torch.device(device), _default_dtype(torch.float16):
        transformer = CogVideoXTransformer3DModel(sample_frames=FRAMES).eval().requires_grad_(False)
        vae = AutoencoderKLCogVideoX().eval().requires_grad_(False)
    if arrangement.recomputed == "resnets":
        recompute_resnets(vae)
    elif arrangement.recomputed == "stages too":
        vae.enable_gradient_checkpointing()
    return CogVideoXPrior(Path("CogVideoX-2B with random weights"), transformer, vae, scheduler_2b())


def counted(arrangement: Arrangement = USED) -> Count:
    """Bytes of a guidance step of CogVideoX-2B."""
    with FakeTensorMode():
        prior, models = _arranged(arrangement)
        with MemoryMeter() as meter:
            held = meter.hold(weights(*models))
            guidance_step(prior, meter, twice=arrangement.twice)
    parameters = sum(p.numel() for p in prior.transformer.parameters())
    return Count(parameters, held, meter.peak, meter.phases)


def arithmetic(arrangement: Arrangement = USED) -> int:
    """Operations of a guidance step in matrix products and convolutions, two for a multiplication with its addition.

    Not counted beside the bytes: PyTorch's counter of operations ties graphs into reference cycles and so holds tensors that
    a run would have freed.
    """
    with FakeTensorMode(), FlopCounterMode(display=False) as flop:
        prior, _ = _arranged(arrangement)
        guidance_step(prior, MemoryMeter(), twice=arrangement.twice)
    return flop.get_total_flops()


def _arranged(arrangement: Arrangement) -> tuple[VideoPrior, list[torch.nn.Module]]:
    prior = random_2b("cpu", arrangement)
    models = [prior.transformer, prior.vae]
    if not arrangement.tiny:
        return prior, models
    with _default_dtype(prior.dtype):
        encoder = TinyEncoder()
    return prior.through(encoder), [*models, encoder]


def guidance_step(prior: VideoPrior, meter: MemoryMeter, *, twice: bool = False) -> None:
    """What `distill_clip` holds, without the arithmetic on latents, which needs values and no memory to speak of."""
    pixels = torch.rand(FRAMES, 3, HEIGHT, WIDTH, device=prior.device).requires_grad_()
    text = torch.zeros(TEXT, dtype=prior.dtype, device=prior.device)
    with meter.phase("look" if twice else "encode"), torch.set_grad_enabled(not twice):
        latents = prior.encode(pixels)
    with meter.phase("pair"):
        v_negative, v_text = prior.predict_v(latents.detach(), 500, text).split(1)
        gradient = v_negative + 100.0 * (v_text - v_negative)
    if twice:
        with meter.phase("encode"):
            latents = prior.encode(pixels)
    with meter.phase("backward"):
        torch.autograd.grad(latents, pixels, gradient)


def measured(count: Count) -> Record:
    """The peak of PyTorch's allocator in such a step with random weights, beside the count."""
    name = "the same peak, measured on CUDA"
    if not torch.cuda.is_available():
        return Record(name, None, "GB", target=TARGET, source="no CUDA device here; the counted peak stands above")
    before = torch.cuda.memory_allocated()
    try:
        prior = random_2b("cuda")
        torch.cuda.reset_peak_memory_stats()
        guidance_step(prior, MemoryMeter())
    except torch.cuda.OutOfMemoryError as error:
        return Record(name, None, "GB", target=TARGET, holds=False, source=f"out of memory: {str(error).splitlines()[0]}")
    peak = torch.cuda.max_memory_allocated() - before
    source = "torch.cuda.max_memory_allocated, random weights; the error is the count's, relative to it"
    return Record.judged(name, peak / GB, "GB", TARGET, error=abs(count.peak / peak - 1), error_unit="", source=source)


@contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    usual = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(usual)
