"""Linear light of sRGB values and back (IEC 61966-2-1), exact; `rendering.display` approximates them for pictures."""

from __future__ import annotations

import numpy as np
from numpy import ndarray


def light_of(rgb: ndarray) -> ndarray:
    """Linear light of sRGB values in 0..1, of any shape."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def srgb_of(light: ndarray) -> ndarray:
    """sRGB values of linear light, of any shape; neither is clipped."""
    above = np.clip(light, 0.0031308, None)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * above ** (1 / 2.4) - 0.055)
