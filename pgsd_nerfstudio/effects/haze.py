"""Haze: the droplets, flakes or dust in the air that are too many or too small to be simulated as particles."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Haze:
    """A participating medium that removes light by its extinction (Beer-Lambert) and adds airlight (Koschmieder 1924)."""

    rgb: tuple[float, float, float] = (0.78, 0.81, 0.84)
    """Airlight, sRGB: the colour that distant surfaces fade to."""
    amount: float = 1.0
    """Factor on the extinction that follows from the weather's intensity; 0: the air between the particles is clear."""
    patchiness: float = 0.0
    """Standard deviation of the logarithm of the extinction from place to place, at the same mean. 0: no patches."""
    patch_size: float = 12.0
    """Wavelength in metres of the largest patches. Smaller ones are weaker by the -5/3 power law of turbulence, and all drift
    with the wind."""
    scale_height: float = math.inf
    """Height in metres over which the haze thins to 1 / e. At the ground it is as dense as the intensity says."""

    def __post_init__(self) -> None:
        if not (0 <= self.amount <= 20 and 0 <= self.patchiness <= 2):
            raise ValueError(f"a haze takes amount in 0-20 and patchiness in 0-2, got {self.amount:g} and {self.patchiness:g}")
        if not (self.patch_size > 0 and self.scale_height > 0):
            raise ValueError(
                f"patch_size and scale_height of a haze must be positive, got {self.patch_size:g} and {self.scale_height:g} m"
            )
