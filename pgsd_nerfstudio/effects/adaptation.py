"""What of a weather follows the scene if nobody asked for a number: visibility, direction of the wind, and legibility."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """Values that the scene decides."""

    visibility: float | None = None
    """Fog and sand: the visibility is this many times the distance of what the scene's cameras have in the background.
    None: it is the number of the emission."""
    wind_across: bool = False
    """Whether the wind blows across the view from left to right, where it is seen; else in the direction of the wind."""
    air: float | None = None
    """Snow, rain and sand: metres of air before what cameras see for which the legibility was chosen, on average over pixels.
    Where a scene has less, fewer particles are seen, and each is drawn with so many times more of its area. None: the
    legibility is that of the appearance."""

    def __post_init__(self) -> None:
        if self.visibility is not None and not 0.2 <= self.visibility <= 100:
            raise ValueError(f"a visibility must be 0.2-100 times the distance of the background, got {self.visibility:g}")
        if self.air is not None and not self.air > 0:
            raise ValueError(f"the air before the background must be some metres, got {self.air:g}")
