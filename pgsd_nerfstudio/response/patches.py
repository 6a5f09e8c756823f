"""Patches of denser and thinner air that drift with the wind: a Gaussian random field with the spectrum of turbulence.

Scalars that turbulence mixes have the energy spectrum E(k) ~ k^(-5/3) (Obukhov 1949, Corrsin 1951), which in three dimensions
is a power of k^(-11/3) for each Fourier mode. The modes have random phases and exactly that power, so that every draw has the
same spectrum and a variance of 1. Both stay while each mode turns at its own rate, like the modes of `physics.air.wind`. The
logarithm of the density is this field times a deviation, and the mean of the density is 1. For each moment the modes are summed
once into a periodic texture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

NODES = 64  # along each side of the texture
PERIOD = 2  # length of the texture in largest wavelengths
OCTAVES = 4  # from the largest wavelength to a sixteenth of it, the shortest that the nodes hold


@dataclass(frozen=True, eq=False)
class Patches:
    """One draw of the field in the metric frame. Several threads may use it at once."""

    modes: Complex[Tensor, "n n n/2+1"]
    """Amplitudes and phases at second 0 over wave numbers along x, y, z; only the half that determines a real field."""
    rates: Float[Tensor, "n n n/2+1"]
    """Rate of turning of each mode in radians per second, without the drift."""
    period: float
    """Length in metres after which the field repeats itself along each axis."""
    deviation: float
    """Standard deviation of the logarithm of the density."""
    wind: tuple[float, float, float]
    """Velocity of the drift in m/s."""
    _made: list[tuple[float, Tensor]] = field(default_factory=list, init=False, repr=False)

    @staticmethod
    def draw(
        deviation: float, size: float, wind: tuple[float, float, float], *, turbulence: float = 0.0, seed: int = 0
    ) -> Patches:
        """Draw patches.

        Args:
            deviation: standard deviation of the logarithm of the density.
            size: wavelength in metres of the largest patches.
            wind: velocity of the drift in m/s.
            turbulence: root mean square of each component of the air's velocity in m/s. It changes the patches, the largest
                within about size / (pi turbulence) seconds. 0: the patches only drift.
            seed: of the phases and rates.
        """
        generator = torch.Generator().manual_seed(seed)
        turns = torch.fft.fftfreq(NODES, 1.0 / NODES, dtype=torch.float64)  # per period
        square = turns[:, None, None] ** 2 + turns[:, None] ** 2 + turns**2
        kept = (square >= PERIOD**2) & (square <= (PERIOD * 2**OCTAVES) ** 2)
        power = torch.where(kept, square.clamp_min(1.0) ** (-11 / 6), 0.0)
        # Linear interpolation between nodes leaves (2 + cos(2 pi k / n)) / 3 of the power of a wave along each axis.
        flat = (2 + torch.cos(2 * math.pi * turns / NODES)) / 3
        power /= (power * flat[:, None, None] * flat[:, None] * flat).sum()
        noise = torch.fft.fftn(torch.randn(NODES, NODES, NODES, generator=generator, dtype=torch.float64))
        jitter = torch.randn(NODES, NODES, NODES, generator=generator, dtype=torch.float64)
        # The field stays real if opposite waves turn in opposite senses.
        jitter = (jitter - jitter.flip(0, 1, 2).roll((1, 1, 1), (0, 1, 2))) / math.sqrt(2)
        rates = math.pi * turbulence / (PERIOD * size) * square.sqrt() * jitter
        half = NODES // 2 + 1
        modes = (noise / noise.abs() * power.sqrt())[..., :half].to(torch.complex64)
        return Patches(modes, rates[..., :half], PERIOD * size, deviation, wind)

    def density(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """Density relative to its mean, on the device and in the dtype of the points.

        Args:
            points: places in metres.
            seconds: the moment.
        """
        # The drift is computed in float64, so that late seconds are as exact as the first.
        gone = torch.remainder(torch.tensor(self.wind, dtype=torch.float64) * seconds, self.period)
        at = torch.remainder((points - gone.to(points)) / self.period, 1.0)
        along = (2.0 * at.flip(1) - 1.0)[None, :, None, None, :]  # the last axis of the texture comes first
        read = grid_sample(self._texture(seconds, points)[None, None], along, "bilinear", "border", align_corners=True)
        return read[0, 0, :, 0, 0]

    def field(self, seconds: float, device: torch.device | None = None) -> Float[Tensor, "n n n"]:
        """The Gaussian field at its nodes over x, y, z without drift.

        Its mean is 0 and its variance is 1, as interpolation between the nodes gives it.

        Args:
            seconds: the moment.
            device: device of the result.
        """
        modes, rates = self.modes.to(device), self.rates.to(device)
        turned = modes * torch.polar(torch.ones_like(rates), rates * seconds).to(modes)
        return torch.fft.irfftn(turned, s=(NODES,) * 3, norm="forward")

    def _texture(self, seconds: float, like: Tensor) -> Float[Tensor, "m m m"]:
        """Density at the nodes, with the first slice along each axis repeated at its end. The texture of the last moment is
        cached."""
        made = self._made[-1] if self._made else None
        if made is None or made[0] != seconds or (made[1].dtype, made[1].device) != (like.dtype, like.device):
            density = torch.exp(self.deviation * self.field(seconds, like.device))
            around = pad((density / density.mean())[None, None], (0, 1, 0, 1, 0, 1), mode="circular")[0, 0]
            made = seconds, around.to(like)
            self._made[:] = [made]
        return made[1]
