"""Patches of denser and thinner air that drift with the wind: a Gaussian random field with the spectrum of turbulence.

Scalars that turbulence mixes have the energy spectrum E(k) ~ k^(-5/3) (Obukhov 1949, Corrsin 1951), in three dimensions a power
of k^(-11/3) for each Fourier mode. The modes get random phases and exactly that power, so every draw has the same spectrum and
a variance of 1, and keeps them while each mode turns at a rate of its own, as those of `physics.wind` do. The logarithm of the
density is this field times a deviation; its mean is 1. For each moment the modes are summed once into a periodic texture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

NODES = 64  # along each side of the texture
PERIOD = 4  # largest wavelengths after which it repeats itself
OCTAVES = 2  # from the largest wavelength down to a quarter of it: what is smaller, the eye sums up along its ray


@dataclass(frozen=True, eq=False)
class Patches:
    """One draw; metric. May be asked from several threads."""

    modes: Complex[Tensor, "n n n/2+1"]
    """Amplitudes and phases at second 0 over wave numbers along x, y, z; the half that determines a real field."""
    rates: Float[Tensor, "n n n/2+1"]
    """Radians per second by which each mode turns, apart from drifting."""
    period: float
    """Metres after which the field repeats itself, along each axis."""
    deviation: float
    """Standard deviation of the logarithm of the density."""
    wind: tuple[float, float, float]
    """Carries all of it, m/s."""
    _made: list[tuple[float, Tensor]] = field(default_factory=list, init=False, repr=False)

    @staticmethod
    def draw(
        deviation: float, size: float, wind: tuple[float, float, float], *, turbulence: float = 0.0, seed: int = 0
    ) -> Patches:
        """Patches of that seed.

        Args:
            deviation: of the logarithm of the density.
            size: wavelength of the largest in metres.
            wind: m/s, carries them.
            turbulence: root mean square of each component of the air's velocity in m/s; patches become others as it mixes them,
                large ones slowly (size over pi times it, about). 0: they only drift.
        """
        generator = torch.Generator().manual_seed(seed)
        turns = torch.fft.fftfreq(NODES, 1.0 / NODES, dtype=torch.float64)  # per period
        square = turns[:, None, None] ** 2 + turns[:, None] ** 2 + turns**2
        kept = (square >= PERIOD**2) & (square <= (PERIOD * 2**OCTAVES) ** 2)
        power = torch.where(kept, square.clamp_min(1.0) ** (-11 / 6), 0.0)
        # Between nodes a linear reading flattens waves, by (2 + cos(2 pi k / n)) / 3 of their power along each axis.
        flat = (2 + torch.cos(2 * math.pi * turns / NODES)) / 3
        power /= (power * flat[:, None, None] * flat[:, None] * flat).sum()
        noise = torch.fft.fftn(torch.randn(NODES, NODES, NODES, generator=generator, dtype=torch.float64))
        jitter = torch.randn(NODES, NODES, NODES, generator=generator, dtype=torch.float64)
        # A field stays real if opposite waves turn in opposite senses.
        jitter = (jitter - jitter.flip(0, 1, 2).roll((1, 1, 1), (0, 1, 2))) / math.sqrt(2)
        rates = math.pi * turbulence / (PERIOD * size) * square.sqrt() * jitter
        half = NODES // 2 + 1
        modes = (noise / noise.abs() * power.sqrt())[..., :half].to(torch.complex64)
        return Patches(modes, rates[..., :half], PERIOD * size, deviation, wind)

    def density(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """Relative to the mean, at metric points; on their device, in their dtype."""
        # In float64, so that late seconds stay as exact as the first.
        gone = torch.remainder(torch.tensor(self.wind, dtype=torch.float64) * seconds, self.period)
        at = torch.remainder((points - gone.to(points)) / self.period, 1.0)
        along = (2.0 * at.flip(1) - 1.0)[None, :, None, None, :]  # the last axis of the texture comes first
        read = grid_sample(self._texture(seconds, points)[None, None], along, "bilinear", "border", align_corners=True)
        return read[0, 0, :, 0, 0]

    def field(self, seconds: float, device: torch.device | None = None) -> Float[Tensor, "n n n"]:
        """The Gaussian field at its nodes over x, y, z, not drifted: mean 0, variance 1 as it is read between them."""
        modes, rates = self.modes.to(device), self.rates.to(device)
        turned = modes * torch.polar(torch.ones_like(rates), rates * seconds).to(modes)
        return torch.fft.irfftn(turned, s=(NODES,) * 3, norm="forward")

    def _texture(self, seconds: float, like: Tensor) -> Float[Tensor, "n+1 n+1 n+1"]:
        """Density at the nodes, the first layer along each axis once more as its last; that of the last moment is kept."""
        made = self._made[-1] if self._made else None
        if made is None or made[0] != seconds or (made[1].dtype, made[1].device) != (like.dtype, like.device):
            density = torch.exp(self.deviation * self.field(seconds, like.device))
            around = pad((density / density.mean())[None, None], (0, 1, 0, 1, 0, 1), mode="circular")[0, 0]
            made = seconds, around.to(like)
            self._made[:] = [made]
        return made[1]
