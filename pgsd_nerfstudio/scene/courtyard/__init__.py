"""The built-in courtyard: its parts, modelled in metres, and the light on them. `scene/demo.py` makes a scene of it."""

from __future__ import annotations

import numpy as np

from pgsd_nerfstudio.scene.courtyard.furniture import furniture
from pgsd_nerfstudio.scene.courtyard.masonry import masonry
from pgsd_nerfstudio.scene.courtyard.plants import plants
from pgsd_nerfstudio.scene.courtyard.surfels import Part


def courtyard(rng: np.random.Generator) -> list[Part]:
    """All parts of the courtyard; `baking.backdrop` adds the sky and the hills around it."""
    return [*masonry(rng), *plants(rng), *furniture(rng)]


__all__ = ["courtyard"]
