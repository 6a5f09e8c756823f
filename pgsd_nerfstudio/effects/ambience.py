"""The light of a weather: how sky, sun, exposure and colours of the whole scene change under it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Ambience:
    """Light of the full weather. While the weather arrives, the light is mixed with the scene's own by the timeline's share."""

    clouds: float = 0.0
    """Share of the direct sun that clouds take and spread over the sky, which softens shadows. 0 leaves the sun."""
    stops: float = 0.0
    """Change of exposure in stops; -1 halves the light."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour of the light, a factor on linear red, green and blue."""
    saturation: float = 1.0
    """Factor on the distance of colours from grey."""
    sky: tuple[float, float, float] = (0.75, 0.78, 0.82)
    """Colour of the sky, sRGB. The background shows it and wet surfaces mirror it."""

    def __post_init__(self) -> None:
        if not (0 <= self.clouds <= 1 and -5 <= self.stops <= 5 and 0 <= self.saturation <= 2):
            raise ValueError(
                f"an ambience takes clouds in 0-1, stops in -5-5 and saturation in 0-2, got {self.clouds:g}, {self.stops:g} "
                f"and {self.saturation:g}"
            )
