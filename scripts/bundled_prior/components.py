"""The VAE's encoder in closed form: principal components of 4x4x4 blocks, written into CogVideoX's own layers.

Score distillation sends its gradient through the encoder. A linear encoder sends it straight: no trained non-linearity
can turn "whiter" into a pattern. It also needs no training, so the denoiser can start at once. How the layers are used:

- conv_in splits a frame into brightness Y, two colour differences U and V, and the change D of Y over two frames;
- the strided convolutions take Haar coefficients (2x2, then 2x2 again), the time pooling averages four frames;
- residual branches end in zeros, so every block hands its input on;
- the last normalisation would rescale each clip: a constant of +-STEADY in each group outweighs the signal and keeps the
  scale; features pass the SiLU in pairs +u, -u, because silu(u) - silu(-u) = u.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from diffusers import AutoencoderKLCogVideoX
from jaxtyping import Float
from torch import Tensor, nn

HAAR = 0.5 * torch.tensor([[[1, 1], [1, 1]], [[1, -1], [1, -1]], [[1, 1], [-1, -1]], [[1, -1], [-1, 1]]], dtype=torch.float32)
"""Orthonormal 2x2 patterns: mean, left-right, top-bottom, diagonal."""
COLOR = torch.tensor([[1, 1, 1], [1, 0, -1], [-0.5, 1, -0.5]]) / torch.tensor([[3**0.5], [2**0.5], [1.5**0.5]])
"""Rows Y, U, V of an orthonormal colour space."""
CHANGE = 0.7
"""Weight of D among the features; it is half of their information about motion, and none about the look at rest."""
STEADY = 4.0
LOG_VARIANCE = -5.0
"""Of the posterior: the noise the decoder learns to live with."""
FEATURES = 31


def prepare(vae: AutoencoderKLCogVideoX) -> None:
    """Sets every layer of the encoder up to the 31 features at a quarter of the resolution."""
    encoder = vae.encoder
    with torch.no_grad():
        for module in encoder.modules():
            if isinstance(module, (nn.Conv3d, nn.Conv2d)):
                module.weight.zero_()
                module.bias.zero_()
        split = encoder.conv_in.conv.weight  # [16, 3, time, y, x]; the last tap in time is the present frame
        split[:3, :, 2, 1, 1] = COLOR
        split[3, :, 2, 1, 1], split[3, :, 0, 1, 1] = CHANGE * COLOR[0], -CHANGE * COLOR[0]
        first = encoder.down_blocks[0].downsamplers[0].conv.weight  # [16, 16, 3, 3]; the last row and column stay zero
        for k in range(4):
            first[k, 0, :2, :2] = HAAR[k]  # Y: 0-3
            first[6 + k, 3, :2, :2] = HAAR[k]  # D: 6-9
        first[4, 1, :2, :2], first[5, 2, :2, :2] = HAAR[0], HAAR[0]  # U, V
        wider = encoder.down_blocks[1].resnets[0].conv_shortcut.weight  # [32, 16, 1, 1, 1]
        wider[torch.arange(16), torch.arange(16)] = 1.0
        second = encoder.down_blocks[1].downsamplers[0].conv.weight  # [32, 32, 3, 3]
        row = 0
        for channel, patterns in [(c, 4) for c in range(7)] + [(c, 1) for c in range(7, 10)]:
            for k in range(patterns):
                second[row, channel, :2, :2] = HAAR[k]
                row += 1
        assert row == FEATURES


def features(vae: AutoencoderKLCogVideoX, clip: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b 31 t4 h4 w4"]:
    """What `prepare` has made the layers before the last block compute, without their idle branches."""
    encoder = vae.encoder
    first, second = encoder.down_blocks[0], encoder.down_blocks[1]
    hidden, _ = encoder.conv_in(2 * clip.transpose(1, 2) - 1)
    hidden = second.resnets[0].conv_shortcut(first.downsamplers[0](hidden))
    return second.downsamplers[0](hidden)[:, :FEATURES]


def latents(vae: AutoencoderKLCogVideoX, clip: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b c t4 h4 w4"]:
    """The same as the mean of `vae.encode`, several times faster, because the branches that end in zeros are left out."""
    encoder = vae.encoder
    hidden = nn.functional.pad(features(vae, clip), (0, 0, 0, 0, 0, 0, 0, 1))
    hidden = encoder.norm_out(encoder.down_blocks[2].resnets[0].conv_shortcut(hidden))
    weight = encoder.conv_out.conv.weight[: vae.config.latent_channels, :, -1, 1, 1]
    return torch.einsum("oc,bcthw->bothw", weight, nn.functional.silu(hidden))


@torch.no_grad()
def fit(
    vae: AutoencoderKLCogVideoX, pairs: Iterable[tuple[Tensor, Tensor]], *, emphasis: float = 2.0, whiten: float = 0.7
) -> dict:
    """Chooses the latent channels from clips and their weatherless twins; sets the rest of the encoder.

    Args:
        pairs: clips [b, t, 3, h, w] in 0..1 with weather, and the same without.
        emphasis: weight of the difference that the weather makes, beside the clips themselves.
        whiten: 1 gives every channel unit deviation, 0 leaves them in proportion to their standard deviations.

    Returns:
        Share of the (weighted) variance kept and the deviations of the latent channels.
    """
    prepare(vae)
    total, mean, count = torch.zeros(FEATURES, FEATURES, dtype=torch.float64), torch.zeros(FEATURES, dtype=torch.float64), 0
    plain = torch.zeros_like(total)
    for clip, still in pairs:
        seen = features(vae, clip).transpose(0, 1).flatten(1).double()
        weather = seen - features(vae, still).transpose(0, 1).flatten(1).double()
        plain += seen @ seen.T
        total += emphasis * weather @ weather.T
        mean += seen.sum(dim=1)
        count += seen.shape[1]
    mean /= count
    plain = plain / count - torch.outer(mean, mean)
    values, vectors = torch.linalg.eigh(plain + total / count)
    channels = vae.config.latent_channels
    basis = vectors[:, -channels:].flip(1).T  # [channels, features], strongest first
    deviation = (basis @ plain @ basis.T).diagonal().sqrt()
    gain = deviation**-whiten
    gain = gain / (gain * deviation).square().mean().sqrt()
    rows = (gain[:, None] * basis).float()
    offset = -(rows @ mean.float())

    last = vae.encoder.down_blocks[2].resnets[0].conv_shortcut  # 32 -> 64: groups of eight hold (+c, -c) twice and two pairs
    out = vae.encoder.conv_out.conv
    spread = (0.5 * STEADY**2 + 0.5 * (gain * deviation).square().mean().float()) ** 0.5
    for channel in range(channels):
        group, slot = channel % 8, channel // 8
        plus = 8 * group + 4 + 2 * slot
        for sign, index in ((1.0, plus), (-1.0, plus + 1)):
            last.weight[index, :FEATURES, 0, 0, 0] = sign * rows[channel]
            last.bias[index] = sign * offset[channel]
            last.bias[8 * group + 2 * slot + (sign < 0)] = sign * STEADY
            out.weight[channel, index, 2, 1, 1] = sign * spread
    out.bias[channels:] = LOG_VARIANCE
    kept = float(values[-channels:].sum() / values.sum())
    return {"kept": kept, "deviations": [round(float(x), 3) for x in gain * deviation]}
