"""The neural dynamics field: small corrections to the simulated motion, and changes of appearance, per particle and frame.

Architecture of the paper's supplement, "Implementation Details": one network per physical state, each a backbone of two hidden
layers of 128 with ReLU and one linear head per quantity. The heads start at zero, so that an untrained field changes nothing,
and every output is bounded by construction (bound x tanh), so that no weights can make a roll-out explode. FieldConfig can
leave out the parts that the paper's ablation "Per-Particle Appearance and Rotation" takes away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

from pgsd_nerfstudio.dynamics.encodings import WIDTH, fourier, sinusoidal
from pgsd_nerfstudio.dynamics.look import Change
from pgsd_nerfstudio.effects.appearance import ParticleLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory

HIDDEN = 128
LOOK = {"opacity": 1, "scale": 3, "rgb": 3}  # heads of the appearance
PARTICLE = 3 * WIDTH + sum(LOOK.values())  # inputs of one particle: place, velocity and time, and its appearance
REFERENCE_SCALE = 0.01  # m; scales enter as the logarithm of their ratio to it, since metres of a flake are all but zero


@dataclass(frozen=True, kw_only=True)
class DeltaBounds:
    """Largest change of one particle from one frame to the next."""

    velocity: float = 0.02
    """Velocity correction per axis in metres per frame; at 25 fps 0.5 m/s, half the fall speed of a flake."""
    rotation: float = 0.2
    """Angular velocity per axis in radians per frame; at 25 fps 0.8 turns per second."""
    opacity: float = 0.05
    """Change of opacity per frame: within a second at 25 fps it can go from one end to the other."""
    log_scale: float = 0.05
    """Change of the logarithm of the scales per frame."""
    rgb: float = 0.05
    """Change of colour per frame."""


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """Quantities that the field may change."""

    velocity: bool = True
    """Whether motion of active particles is corrected; off it stays the simulated one, the paper's "w/o PG" (with
    rotation off too)."""
    rotation: bool = True
    """Whether active particles turn; off there is no angular velocity to learn and orientations stay the simulated ones."""
    appearance: Literal["per particle", "shared", "fixed"] = "per particle"
    """How the look changes from frame to frame. "per particle": by place, velocity, time and look. "shared": by time alone, one
    change per state and frame for all particles. "fixed": not at all, and the look that all share is not learned either."""


class ActiveDelta(NamedTuple):
    """Changes that the field makes to n active particles in one frame."""

    velocity: Float[Tensor, "n 3"]
    """Metres per frame."""
    rotation: Float[Tensor, "n 3"]
    """Rotation vector in the particle's own axes, radians per frame."""
    change: Change


class StateNet(nn.Module):
    """The network of one physical state; without heads it is never evaluated."""

    def __init__(self, heads: dict[str, int], inputs: int = PARTICLE) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, HIDDEN)
        self.second = nn.Linear(HIDDEN, HIDDEN)
        self.heads = nn.ModuleDict({name: nn.Linear(HIDDEN, width) for name, width in heads.items()})
        for head in self.heads.parameters():
            nn.init.zeros_(head)

    def forward(self, own: Float[Tensor, "n k"], shared: Float[Tensor, "1 m"]) -> dict[str, Tensor]:
        """Heads in -1..1.

        Args:
            own: first inputs, of each particle.
            shared: the other inputs, the same for all particles; they cost one row.
        """
        k = own.shape[1]
        constant = linear(shared, self.first.weight[:, k:], self.first.bias)
        hidden = torch.relu(self.second(torch.relu(linear(own, self.first.weight[:, :k]) + constant)))
        # All heads in one product: each by itself is too narrow to be worth its call.
        weight, bias = (torch.cat([getattr(head, part) for head in self.heads.values()]) for part in ("weight", "bias"))
        out = torch.tanh(linear(hidden, weight, bias))
        return dict(zip(self.heads, out.split([head.out_features for head in self.heads.values()], dim=1), strict=True))


class DynamicsField(nn.Module):
    """Separate networks for active and for collided particles."""

    box: Tensor
    speed: Tensor

    def __init__(
        self,
        box: Float[Tensor, "2 3"],  # corners of the domain, metres
        speed: float,  # m per frame, of the fastest particle
        frames: int,
        bounds: DeltaBounds | None = None,
        config: FieldConfig | None = None,
    ) -> None:
        super().__init__()
        self.frames, self.bounds, self.config = frames, bounds or DeltaBounds(), config or FieldConfig()
        self.register_buffer("box", box.detach().clone().float())
        self.register_buffer("speed", torch.tensor(max(float(speed), 1e-6)))
        motion = {name: 3 for name in ("velocity", "rotation") if getattr(self.config, name)}
        own = LOOK if self.config.appearance == "per particle" else {}
        self.active_net = StateNet({**motion, **own})
        self.collided_net = StateNet(own)
        shared = ("active", "collided") if self.config.appearance == "shared" else ()
        self.shared_nets = nn.ModuleDict({state: StateNet(LOOK, WIDTH) for state in shared})

    @staticmethod
    def for_history(
        history: ParticleHistory, bounds: DeltaBounds | None = None, config: FieldConfig | None = None
    ) -> DynamicsField:
        """A field for these particles: domain box and fastest speed come from their trajectories."""
        if history.positions.shape[0] == 0:
            return DynamicsField(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, history.frames, bounds, config)
        low, high = history.positions.aminmax(dim=0)
        steps = (history.positions[1:] - history.positions[:-1]).norm(dim=1)
        same = torch.ones_like(steps, dtype=torch.bool)
        between = history.offsets[1:-1]  # rows where the next particle starts; a particle without rows repeats its neighbour's
        same[between[(between > 0) & (between <= steps.shape[0])] - 1] = False
        speed = float(steps[same].max()) if bool(same.any()) else 0.0
        return DynamicsField(torch.stack([low, high]), speed, history.frames, bounds, config).to(history.device)

    def still(self) -> bool:
        """Whether the field changes nothing at all: every head is zero, as before training."""
        return not any(bool(parameter.any()) for head in self.heads() for parameter in head.parameters())

    def heads(self) -> list[nn.Module]:
        """The last layers of all networks; if they are zero, so is all that is learned."""
        nets = [self.active_net, self.collided_net, *self.shared_nets.values()]
        return [head for net in nets for head in net.heads.values()]  # type: ignore[union-attr, operator]

    def active(
        self,
        position: Float[Tensor, "n 3"],  # m, of the previous frame, as rendered
        velocity: Float[Tensor, "n 3"],  # m per frame, simulated, from the previous frame to this one
        frame: int,
        look: ParticleLook,  # of the previous frame
    ) -> ActiveDelta:
        """Corrections of active particles."""
        own = torch.cat([self._place(position), _appearance(look), fourier((velocity / self.speed).clamp(-1, 1))], dim=1)
        out = self.active_net(own, self._time(frame))
        still = torch.zeros_like(position)
        velocity = self.bounds.velocity * out["velocity"] if self.config.velocity else still
        rotation = self.bounds.rotation * out["rotation"] if self.config.rotation else still
        return ActiveDelta(velocity, rotation, self._change("active", out, frame, position))

    def collided(self, position: Float[Tensor, "n 3"], frame: int, look: ParticleLook) -> Change:
        """Changes of collided particles; their motion is fixed, their velocity enters as zero."""
        if self.config.appearance != "per particle":
            return self._change("collided", {}, frame, position)
        own = torch.cat([self._place(position), _appearance(look)], dim=1)
        shared = torch.cat([fourier(position.new_zeros(1, 3)), self._time(frame)], dim=1)
        return self._change("collided", self.collided_net(own, shared), frame, position)

    def _place(self, position: Tensor) -> Float[Tensor, "n 24"]:
        return fourier(within(self.box, position))

    def _time(self, frame: int) -> Float[Tensor, "1 24"]:
        return sinusoidal(frame / self.frames, self.box)

    def _change(self, state: str, out: dict[str, Tensor], frame: int, like: Float[Tensor, "n 3"]) -> Change:
        """The change of n particles from the heads of their own network, or from where the config says."""
        bounds, count = self.bounds, len(like)
        if self.config.appearance == "fixed":
            return Change.none(count, like)
        if self.config.appearance == "shared":
            one = self.shared_nets[state](like.new_zeros(1, 0), self._time(frame))
            out = {name: value.expand(count, -1) for name, value in one.items()}
        return Change(bounds.opacity * out["opacity"][:, 0], bounds.log_scale * out["scale"], bounds.rgb * out["rgb"])


def within(box: Float[Tensor, "2 3"], position: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Positions as -1..1 between the corners of a box; positions outside count as on its wall."""
    low, high = box
    return (2 * (position - low) / (high - low).clamp_min(1e-6) - 1).clamp(-1, 1)


def _appearance(look: ParticleLook) -> Float[Tensor, "n 7"]:
    scales = look.scales.clamp_min(1e-6).log() - math.log(REFERENCE_SCALE)
    return torch.cat([look.opacity[:, None], scales, look.rgb], dim=1)
