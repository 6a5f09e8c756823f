"""What hangs in the air as far as one can see: droplets, flakes or dust too many and too small to be particles."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Haze:
    """A participating medium: takes light by its extinction (Beer-Lambert) and gives airlight instead (Koschmieder 1924)."""

    rgb: tuple[float, float, float] = (0.78, 0.81, 0.84)
    """Airlight, sRGB: the colour that everything far away takes on."""
    amount: float = 1.0
    """Factor on the extinction that the weather's intensity gives; 0: clear air between the particles."""
    patchiness: float = 0.0
    """Standard deviation of the logarithm of the extinction from place to place; its mean stays. 0: the same everywhere."""
    patch_size: float = 12.0
    """Wavelength in metres of the largest patches; smaller ones are weaker by the -5/3 power law of turbulence. They drift with
    the wind."""
    scale_height: float = math.inf
    """Height in metres over which it thins to a third, e^-1; it is as dense as the intensity says at the ground."""

    def __post_init__(self) -> None:
        if not (0 <= self.amount <= 20 and 0 <= self.patchiness <= 2):
            raise ValueError(f"a haze takes amount in 0-20 and patchiness in 0-2, got {self.amount:g} and {self.patchiness:g}")
        if not (self.patch_size > 0 and self.scale_height > 0):
            raise ValueError(
                f"patch_size and scale_height of a haze must be positive, got {self.patch_size:g} and {self.scale_height:g} m"
            )
