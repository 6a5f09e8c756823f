"""A tiny encoder in place of the VAE's: it gives the gradient on a clip for a fiftieth of the arithmetic, and less exactly.

Boer Bohan, TAEHV (2025, https://github.com/madebyollin/taehv): an encoder of 3x3 convolutions, distilled to give the
scaled latents of a large video VAE. Its weights for CogVideoX are called taecvx; download them yourself. The names of its
tensors show the layout: three stages each merge neighbouring frames (2, 2, 1), halve the picture and pass three blocks that see
their own input of the frame before. It takes pixels in 0..1 and needs no scaling factor. The same shapes serve other video
models, so that shapes do not give a wrong file away: look at `gradient_cosine`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pgsd_nerfstudio.guidance.folder import PriorError

WIDTH, LATENT_CHANNELS = 64, 16
MERGED = (2, 2, 1)
"""Frames that each stage makes into one."""
SPACE, TIME = 8, 4
"""Pixels per latent along an edge, frames per latent."""
NAMES = ("taecvx.safetensors", "taecvx.pth")
Padding = Literal["front", "end"]


@runtime_checkable
class Encoder(Protocol):
    """Whatever makes scaled latents of a clip, differentiably: a `VideoPrior` or a `TinyEncoder`."""

    def encode(self, clip: Tensor) -> Tensor: ...


class _Merge(nn.Module):
    """Groups of `frames` frames become one by a matrix over their channels, the earliest frame's channels first."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self.frames = frames
        self.conv = nn.Conv2d(frames * WIDTH, WIDTH, 1, bias=False)

    def forward(self, x: Float[Tensor, "t c h w"]) -> Float[Tensor, "s c h w"]:
        return self.conv(x.reshape(-1, self.frames * WIDTH, *x.shape[2:]))


class _Remember(nn.Module):
    """A residual block whose convolutions also see its input of the frame before; before the first there is nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            _conv(2 * WIDTH, WIDTH), nn.ReLU(True), _conv(WIDTH, WIDTH), nn.ReLU(True), _conv(WIDTH, WIDTH)
        )

    def forward(self, x: Float[Tensor, "t c h w"]) -> Float[Tensor, "t c h w"]:
        before = torch.cat([torch.zeros_like(x[:1]), x[:-1]])
        return functional.relu(self.conv(torch.cat([x, before], dim=1)) + x)


class TinyEncoder(nn.Module):
    """Frozen encoder of `taecvx`. Example:

    >>> tiny = TinyEncoder.load("weights/", prior.device, prior.dtype)     # doctest: +SKIP
    >>> gradient_cosine(prior, tiny, clip)                                  # doctest: +SKIP
    >>> prior = prior.through(tiny)                                         # doctest: +SKIP
    """

    padding: Padding
    """Where frames are repeated to fill whole groups of 4. front repeats the first one, so that a clip of 4k + 1 frames is
    grouped as in CogVideoX (1, 4, 4, ...) and a latent's gradient reaches its own frames. end repeats the last one, as the
    published encoder does for any clip; its groups lie up to three frames later than CogVideoX'."""

    def __init__(self, padding: Padding = "front") -> None:
        super().__init__()
        if padding not in ("front", "end"):
            raise ValueError(f"the padding must be front or end, got {padding!r}")
        self.padding = padding
        layers: list[nn.Module] = [_conv(3, WIDTH), nn.ReLU(True)]
        for frames in MERGED:
            halve = nn.Conv2d(WIDTH, WIDTH, 3, stride=2, padding=1, bias=False)
            layers += [_Merge(frames), halve, _Remember(), _Remember(), _Remember()]
        self.encoder = nn.Sequential(*layers, _conv(WIDTH, LATENT_CHANNELS))
        self.eval().requires_grad_(False)

    @staticmethod
    def load(
        place: str | Path,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        *,
        padding: Padding = "front",
    ) -> TinyEncoder:
        """Load downloaded weights.

        Args:
            place: taecvx.safetensors or taecvx.pth, or a local folder that holds one of them.
            device: where it computes.
            dtype: number format; take the prior's.
            padding: see `TinyEncoder.padding`.

        Raises:
            PriorError: there are no such weights, or they are not those of this encoder.
        """
        path = _weights_file(Path(place).expanduser())
        tiny = TinyEncoder(padding)
        tiny.load_state_dict(_fitting(_read(path), tiny.state_dict(), path))
        return tiny.to(device, dtype)

    def encode(self, clip: Float[Tensor, "t 3 h w"]) -> Float[Tensor, "1 lt 16 lh lw"]:
        """Scaled latents (float32) of a clip in 0..1, differentiable.

        Raises:
            ValueError: height or width is no multiple of 8.
        """
        frames, _, height, width = clip.shape
        if height % SPACE or width % SPACE:
            raise ValueError(f"height and width of a clip must be multiples of {SPACE}, found {height}x{width}")
        weight = self.encoder[0].weight
        assert isinstance(weight, Tensor)
        clip, missing = clip.to(weight), -frames % TIME
        if missing and self.padding == "front":
            clip = torch.cat([clip[:1].expand(missing, -1, -1, -1), clip])
        elif missing:
            clip = torch.cat([clip, clip[-1:].expand(missing, -1, -1, -1)])
        return self.encoder(clip)[None].float()


def gradient_cosine(
    prior: Encoder,
    tiny: Encoder,
    clip: Float[Tensor, "t 3 h w"],
    on_latents: Float[Tensor, "1 lt c lh lw"] | None = None,
) -> float:
    """Cosine between the gradients on a clip that two encoders make of one gradient on latents: 1 is the same direction.

    Args:
        prior: the video prior with its own VAE.
        tiny: the encoder that would replace it.
        clip: frames in 0..1, such as the first rendered clip of a run.
        on_latents: the gradient to carry back, as distillation gives it; None means white noise, every direction alike.

    Raises:
        PriorError: their latents differ in shape, or a gradient is zero or not finite.
    """
    if on_latents is None:
        with torch.no_grad():
            shape = prior.encode(clip).shape
        on_latents = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    truth, found = (_carried_back(encoder, clip, on_latents) for encoder in (prior, tiny))
    norms = float(truth.norm() * found.norm())
    if not (norms > 0 and norms < float("inf")):
        raise PriorError(
            f"the gradients of both encoders must be finite and not zero, found lengths {truth.norm():g} and {found.norm():g}"
        )
    return float((truth * found).sum()) / norms


def _conv(channels: int, made: int) -> nn.Conv2d:
    return nn.Conv2d(channels, made, 3, padding=1)


def _carried_back(encoder: Encoder, clip: Tensor, on_latents: Tensor) -> Tensor:
    pixels = clip.detach().clone().requires_grad_()
    latents = encoder.encode(pixels)
    if latents.shape != on_latents.shape:
        raise PriorError(f"both encoders must make latents of one shape, found {[*latents.shape]} for {[*on_latents.shape]}")
    return torch.autograd.grad(latents, pixels, on_latents.to(latents))[0].double().cpu()


def _weights_file(place: Path) -> Path:
    if place.is_dir():
        for name in NAMES:
            if (place / name).is_file():
                return place / name
        raise PriorError(f"the folder {place} must hold {' or '.join(NAMES)}; download it from github.com/madebyollin/taehv")
    if not place.is_file() or place.suffix not in (".safetensors", ".pth"):
        raise PriorError(
            f"the tiny VAE is a file {' or '.join(NAMES)} or a folder with it, but {place} is "
            f"{'another kind of file' if place.is_file() else 'not there'}; download it from github.com/madebyollin/taehv"
        )
    return place


def _read(path: Path) -> Mapping[str, Tensor]:
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file, or one that wants to run code: whatever is said about it fits one sentence
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise PriorError(f"the tiny VAE in {path} could not be read: {reason}") from error
    if not isinstance(stored, dict) or not all(isinstance(tensor, Tensor) for tensor in stored.values()):
        raise PriorError(f"the tiny VAE in {path} must be a dictionary of tensors, found {type(stored).__name__}")
    return stored


def _fitting(stored: Mapping[str, Tensor], expected: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The encoder's tensors of a file; it also holds a decoder, which nothing here needs."""
    found = {name: tensor for name, tensor in stored.items() if not name.startswith("decoder.")}
    wrong = [f"lacks {name}" for name in expected if name not in found]
    wrong += [f"has an unknown {name}" for name in found if name not in expected]
    wrong += [
        f"has {name} of shape {[*found[name].shape]} where {[*tensor.shape]} belongs"
        for name, tensor in expected.items()
        if name in found and found[name].shape != tensor.shape
    ]
    if wrong:
        more = f", and {len(wrong) - 1} more such tensors" if len(wrong) > 1 else ""
        raise PriorError(f"{path} does not hold the weights of taecvx: it {wrong[0]}{more}")
    return found
