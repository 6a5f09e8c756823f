"""The front of a storm: a wall of weather that the wind carries over the ground, soft and with lobes.

The head of a gravity current, such as the cold air that drives a wall of dust, has lobes and clefts of all sizes up to its own
(Simpson, "Effects of the lower boundary on the head of a gravity current", Journal of Fluid Mechanics 53, 1972). Here they are
a sum of waves along the front whose amplitudes are a share of their lengths. Large ones are flattened where the particles are
simulated, whose own front is a plane (`physics.air.arrival`), so that both pass a place within a second of each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.clock import Domain

SOFT, SPREAD = 0.7, 0.03
"""Metres over which the weather before the front falls to 1 / e, and by how much more per metre outside of the domain: without
that the edge of a storm that is kilometres deep would be a line."""
LAGS = 0.4  # metres by which the front is farther back per metre outside of the domain, a tongue with the domain at its tip
CUT = 12.0  # so many times that length before the front there is nothing, and behind it everything
WAVES = 32
SHORTEST, LONGEST = 1.5, 200.0  # m; lengths of the waves
STEEP = 0.09  # amplitude of a wave relative to its length
FLAT = 3.0  # m; within the domain all waves are as low as if they were no longer than this
TURNS = 0.1  # speed of the waves along the front relative to its own


@dataclass(frozen=True, eq=False, kw_only=True)
class Front:
    """A wall of weather with clear air before it and full weather behind it."""

    along: tuple[float, float]
    """Unit vector of its motion, horizontal, in the metric frame."""
    start: float
    """Mean position at second 0, in metres along its motion."""
    speed: float
    """Speed in m/s."""
    middle: tuple[float, float]
    """Middle of the domain in metres."""
    radius: float
    """Half of the domain's diagonal, horizontally, metres."""
    waves: Float[Tensor, "w 2"]
    """Wave numbers across the motion and upwards, turns per metre."""
    phases: Float[Tensor, " w"]
    """Turns."""

    @staticmethod
    def of(arrival: Arrival, domain: Domain, seed: int = 0) -> Front:
        """The front of the particles, which starts at the upwind corner of the domain.

        Args:
            arrival: of the particles.
            domain: in which they are simulated, metres.
            seed: of the lobes.

        Raises:
            ValueError: the particles do not arrive as a front.
        """
        if not arrival.is_front:
            raise ValueError(f"only what arrives as a front within an onset has one, found {arrival.timeline}")
        start = arrival.front_position(0.0)
        x, y = arrival.along.tolist()
        sides = [high - low for low, high in zip(domain.lower[:2], domain.upper[:2], strict=True)]
        generator = torch.Generator().manual_seed(seed)
        lengths = SHORTEST * (LONGEST / SHORTEST) ** ((torch.arange(WAVES) + torch.rand(WAVES, generator=generator)) / WAVES)
        turn = 2 * math.pi * torch.rand(WAVES, generator=generator)
        return Front(
            along=(x, y),
            start=start,
            speed=arrival.front_position(1.0) - start,
            middle=(0.5 * (domain.lower[0] + domain.upper[0]), 0.5 * (domain.lower[1] + domain.upper[1])),
            radius=0.5 * math.hypot(*sides),
            waves=torch.stack([turn.cos(), turn.sin()], 1) / lengths[:, None],
            phases=torch.rand(WAVES, generator=generator),
        )

    def passed(self, points: Float[Tensor, "n 3"], seconds: float) -> Float[Tensor, " n"]:
        """Share of the full weather at metric points at a second, 0..1."""
        x, y, z = points.unbind(1)
        outside = (torch.hypot(x - self.middle[0], y - self.middle[1]) - self.radius).clamp_min(0.0)
        behind = self.start + self.speed * seconds - x * self.along[0] - y * self.along[1] - LAGS * outside
        wide = SOFT + SPREAD * outside
        found = torch.full_like(behind, 0.5).copysign(behind) + 0.5  # 0 before it and 1 behind, wherever no lobe reaches
        near = (behind.abs() < CUT * wide + reach(outside)).nonzero()[:, 0]
        across = torch.stack([y * self.along[0] - x * self.along[1], z], 1)[near]
        behind = behind[near] + self._lobes(across, outside[near], seconds)
        least = 1 / (1 + math.exp(CUT))
        found[near] = ((torch.sigmoid(behind / wide[near]) - least) / (1 - 2 * least)).clamp(0.0, 1.0)
        return found

    def left(self, domain: Domain, seconds: float, distance: float) -> bool:
        """Whether all air within a distance in metres of the domain has full weather at a second."""
        slack = LAGS * distance + CUT * (SOFT + SPREAD * distance) + float(reach(torch.tensor(distance)))
        farthest = sum(max(a * low, a * high) for a, low, high in zip(self.along, domain.lower, domain.upper, strict=False))
        return self.start + self.speed * seconds - farthest > distance + slack

    def _lobes(self, across: Float[Tensor, "n 2"], outside: Float[Tensor, " n"], seconds: float) -> Float[Tensor, " n"]:
        """Metres by which the front is ahead of its mean position."""
        waves, phases = self.waves.to(across), self.phases.to(across)
        lengths = 1 / waves.norm(dim=1)
        turns = across @ waves.T + phases + TURNS * self.speed * seconds / lengths
        return (_amplitudes(lengths, outside) * torch.cos(2 * math.pi * turns)).sum(1)


def reach(outside: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Metres by which lobes are ahead of the mean front, at most, from the distance to the domain in metres."""
    lengths = SHORTEST * (LONGEST / SHORTEST) ** ((torch.arange(WAVES).to(outside) + 1) / WAVES)
    return _amplitudes(lengths, outside).sum(-1)


def _amplitudes(lengths: Float[Tensor, " w"], outside: Float[Tensor, "*n"]) -> Float[Tensor, "*n w"]:
    return -STEEP * lengths * torch.expm1(-(FLAT + outside[..., None]) / lengths)
