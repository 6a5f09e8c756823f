"""The share of a weather's light that the particles shown take themselves, by their distance: the haze leaves it out.

Near a camera all particles are shown, farther away ever fewer (physics.air.reach). What a particle takes out of a view is the
light on its area A. The haze takes twice as much, since particles diffract as much light as they block (van de Hulst, "Light
Scattering by Small Particles", 1957); a particle of millimetres diffracts it by less than a pixel, so it is not drawn. The haze
of the air at a distance d is therefore 1 - s(d) / 2 of the full one, s the share of all areas that is shown, and thinning
changes no mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.air.reach import shown
from pgsd_nerfstudio.physics.laws.populations import integral

DISTANCES = np.concatenate([[0.0], np.geomspace(0.05, 200.0, 160)])  # m


@dataclass(frozen=True)
class ShownShare:
    """Lengths of hazy air before distances from a camera."""

    distances: Float[ndarray, " d"]
    """Metres: 0, then ascending by the same factor."""
    lengths: Float[ndarray, " d"]
    """Metres of full haze before each distance."""

    @staticmethod
    def of(effect: Effect, sharpness: float, areas: tuple[Float[ndarray, " a"], Float[ndarray, " a"]]) -> ShownShare:
        """The haze that the shown particles of an effect leave.

        Args:
            effect: what is simulated of it is between `smallest` and `largest`.
            sharpness: distance up to which all particles are shown, relative to their diameter.
            areas: diameters in metres of all that the haze stands for, ascending, and the density of their areas in 1/m^2, per
                metre of diameter.
        """
        diameters, density = areas
        inside = (diameters >= effect.emission.smallest) & (diameters <= effect.emission.largest)
        drawn = (density * inside * shown(sharpness * diameters, at) for at in DISTANCES.tolist())
        taken = np.array([integral(one, diameters) for one in drawn])
        left = 1.0 - 0.5 * taken / integral(density, diameters)
        # The trapezoidal rule over each step.
        lengths = np.concatenate([[0.0], np.cumsum(0.5 * (left[1:] + left[:-1]) * np.diff(DISTANCES))])
        return ShownShare(DISTANCES, lengths)

    @cached_property
    def _pieces(self) -> tuple[Float[ndarray, " d"], Float[ndarray, " d"]]:
        """Value at zero and slope of the straight piece that begins at each distance; after the last one all air counts."""
        slopes = np.concatenate([np.diff(self.lengths) / np.diff(self.distances), [1.0]])
        return self.lengths - slopes * self.distances, slopes

    def before(self, distances: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Metres of full haze before distances in metres; beyond the last one all air counts."""
        values, slopes = (torch.from_numpy(numbers).to(distances) for numbers in self._pieces)
        # Distances after the first grow by one factor, so that the piece of a distance follows from its logarithm.
        nearest, farthest, pieces = float(self.distances[1]), float(self.distances[-1]), len(slopes) - 2
        per_logarithm = pieces / math.log(farthest / nearest)
        slots = (distances.detach().clamp_min(1e-30) / nearest).log() * per_logarithm
        piece = (slots.floor() + 1).clamp(0, pieces + 1).long()
        return values[piece] + slopes[piece] * distances
