"""Particles for the tests of dynamics: they fall on slanted lines; some land, some leave, some are there from the start."""

from dataclasses import replace

import torch

from pgsd_nerfstudio.dynamics import DynamicsField, LearnedLook, Rollout
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory


def falling(count: int = 60, frames: int = 40, seed: int = 0) -> ParticleHistory:
    rng = torch.Generator().manual_seed(seed)
    births = torch.randint(0, frames, (count,), generator=rng)
    births[: count // 5] = 0
    lengths = torch.randint(1, 25, (count,), generator=rng)
    ends = torch.minimum(births + lengths, torch.tensor(frames))
    collided = (torch.rand(count, generator=rng) < 0.6) & (ends < frames)
    start = torch.rand(count, 3, generator=rng) * torch.tensor([4.0, 4.0, 3.0])
    velocity = torch.tensor([0.01, 0.005, -0.04]) + 0.005 * torch.randn(count, 3, generator=rng)
    paths = [start[i] + torch.arange(int(ends[i] - births[i]))[:, None] * velocity[i] for i in range(count)]
    rest = torch.stack([path[-1] for path in paths]) - torch.tensor([0.0, 0.0, 0.003])
    return ParticleHistory(
        births=births.int(),
        ends=ends.int(),
        collided=collided,
        offsets=torch.cat([torch.zeros(1, dtype=torch.int64), (ends - births).cumsum(0)]),
        positions=torch.cat(paths),
        rest_positions=torch.where(collided[:, None], rest, 0.0),
        rest_quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        rest_extents=torch.ones(count),
        rest_covers=torch.zeros(count),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        diameters=torch.full((count,), 0.005),
        represents=torch.ones(count),
        reaches=torch.full((count,), 1e9),
        kinds=torch.zeros(count, dtype=torch.uint8),
        fps=25.0,
        frames=frames,
    )


def looks(count: int, seed: int = 1) -> InitialLook:
    rng = torch.Generator().manual_seed(seed)

    def one(opacity: float, size: float) -> ParticleLook:
        spread = torch.rand(count, 7, generator=rng)
        return ParticleLook(
            (opacity + 0.1 * spread[:, 0]).clamp(0, 1),
            size * (0.5 + spread[:, 1:4]),
            (0.9 + 0.2 * spread[:, 4:] - 0.05).clamp(0, 1),
        )

    return InitialLook(one(0.8, 0.003), one(0.5, 0.02), settle_seconds=0.4)


def rollout(history: ParticleHistory, *, weights: float = 0.0, stride: int = 7) -> Rollout:
    """An untrained roll-out, or one whose heads hold random weights of that size."""
    torch.manual_seed(3)
    field = DynamicsField.for_history(history)
    if weights:
        with torch.no_grad():
            for net in (field.active_net, field.collided_net):
                for parameter in net.heads.parameters():
                    parameter.normal_(0.0, weights)
    return Rollout(history, looks(len(history)), field, LearnedLook(), stride=stride)


def double(roll: Rollout) -> Rollout:
    """The same in float64."""
    h = roll.history
    unit = {k: torch.nn.functional.normalize(getattr(h, k).double(), dim=1) for k in ("rest_quats", "quats")}
    history = replace(h, positions=h.positions.double(), rest_positions=h.rest_positions.double(), **unit)
    active, collided = (
        ParticleLook(look.opacity.double(), look.scales.double(), look.rgb.double())
        for look in (roll.look.active, roll.look.collided)
    )
    look = InitialLook(active, collided, roll.look.settle_seconds)
    assert roll.learned_look is not None
    return Rollout(history, look, roll.field.double(), roll.learned_look.double(), stride=roll.stride)
