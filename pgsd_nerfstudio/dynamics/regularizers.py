"""Terms that keep the learned motion near the simulated one and the appearance calm; paper, eq. physics_guidance and app_reg.

Every term is an L2 norm per Gaussian (not its square), averaged over the Gaussians and the frames of the clip. The norms are
sqrt(x^2 + eps^2) - eps with eps = 1e-6: the same for all that matters, zero at zero, and with a finite gradient there.

The paper's code takes mean squares instead ("squares"). A norm pulls with the same force near and far; a square hardly feels
small offsets, and large ones all the more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.dynamics.look import LearnedLook
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame
from pgsd_nerfstudio.scene import rotations

EPSILON = 1e-6
APPEARANCE = tuple(f"{state}_{name}" for state in ("active", "collided") for name in ("opacity", "scale", "rgb"))

Form = Literal["norms", "squares"]


@dataclass(frozen=True, kw_only=True)
class RegularizationWeights:
    """Weights of the terms, from the paper's supplement; in adaptive weighting all are multiplied by |L_SDS|."""

    xyz: float = 0.1
    """Distance to the simulated position, per metre."""
    vel: float = 0.1
    """Velocity correction, per metre per frame."""
    rot: float = 0.1
    """Angle to the initial orientation, per radian."""
    active_opacity: float = 1.0
    """Change of opacity per frame, of active particles."""
    active_scale: float = 1.0
    """Change of the logarithm of the scales per frame, of active particles."""
    active_rgb: float = 35.0
    """Change of colour per frame, of active particles."""
    collided_opacity: float = 35.0
    """Change of opacity per frame, of collided particles."""
    collided_scale: float = 35.0
    """Change of the logarithm of the scales per frame, of collided particles."""
    collided_rgb: float = 35.0
    """Change of colour per frame, of collided particles."""
    look: float = 0.001
    """Shift of the look that all particles share; not in the paper, which regularizes changes from frame to frame only."""
    without: tuple[str, ...] = ()
    """Terms to leave out, by the names above; "app" names all six of the appearance per frame, as the paper's ablation does."""
    constant: tuple[str, ...] = ()
    """Terms whose weight stays as it is, whatever scales the others; the paper's study of drift holds xyz so."""
    times: float = 1.0
    """Factor on all terms; the paper's study of sensitivity tries 0.1 and 10, on one term at a time."""
    form: Form = "norms"
    """Form of the terms: norms per particle, as the paper writes them, or squares, as its code has them (units squared; for
    orientations the squared difference of the quaternions)."""

    def __post_init__(self) -> None:
        """Raises ValueError: a term to leave out does not exist, or the factor is negative."""
        known = [f.name for f in fields(self) if f.name not in ("without", "constant", "times", "form")]
        for what, names, known_here in (
            ("to leave out", self.without, [*known, "app"]),
            ("of constant weight", self.constant, known),
        ):
            unknown = [name for name in names if name not in known_here]
            if unknown:
                raise ValueError(f"terms {what} must be among {', '.join(known_here)}; found {', '.join(unknown)}")
        if not self.times >= 0:
            raise ValueError(f"the factor on all terms must not be negative, got {self.times}")

    def of(self, name: str) -> float:
        """The weight of one term as it is used; zero where it is left out."""
        out = name in self.without or ("app" in self.without and name in APPEARANCE)
        return 0.0 if out else self.times * getattr(self, name)

    def scaled(self, name: str, scale: float) -> float:
        """The weight of one term in a step where the others are scaled by `scale`."""
        return self.of(name) * (1.0 if name in self.constant else scale)

    def weighted(self, terms: Mapping[str, Tensor], scale: float = 1.0) -> dict[str, Tensor]:
        """Each term times its weight and `scale`, without those of weight zero."""
        return {name: self.scaled(name, scale) * value for name, value in terms.items() if self.of(name)}

    def total(self, terms: Mapping[str, Tensor], scale: float = 1.0) -> Tensor:
        """Weighted sum of `terms`, times `scale`."""
        used = list(self.weighted(terms, scale).values())
        return torch.stack(used).sum() if used else torch.zeros_like(next(iter(terms.values())))


def regularization(
    clip: Sequence[RolloutFrame], learned_look: LearnedLook | None = None, form: Form = "norms"
) -> dict[str, Tensor]:
    """The terms of one clip, named and formed as in RegularizationWeights; zero where there is no particle."""
    stepped = [instant.deltas for instant in clip if instant.deltas is not None]
    mean = _Mean(clip[0].gaussians.means.new_zeros(()))
    size, turn = (safe_norm, rotation_angle) if form == "norms" else (squared_norm, quaternion_difference)
    terms = {
        "xyz": mean(size(instant.offset) for instant in clip),
        "vel": mean(size(deltas.active.velocity) for deltas in stepped),
        "rot": mean(turn(instant.quats, instant.simulated_quats) for instant in clip),
    }
    for state, changes in (
        ("active", [deltas.active.change for deltas in stepped]),
        ("collided", [deltas.collided for deltas in stepped]),
    ):
        terms[f"{state}_opacity"] = mean(size(change.opacity[:, None]) for change in changes)
        terms[f"{state}_scale"] = mean(size(change.log_scale) for change in changes)
        terms[f"{state}_rgb"] = mean(size(change.rgb) for change in changes)
    if learned_look is not None:
        shifts = learned_look.bounded()
        parts = [size(part).sum() for shift in shifts for part in (shift.opacity[:, None], shift.log_scale, shift.rgb)]
        terms["look"] = torch.stack(parts).sum()
    return terms


def safe_norm(x: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """L2 norm per row; its gradient is finite everywhere and zero at zero."""
    return (x.square().sum(dim=1) + EPSILON**2).sqrt() - EPSILON


def squared_norm(x: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """Squared L2 norm per row."""
    return x.square().sum(dim=1)


def quaternion_difference(a: Float[Tensor, "n 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, " n"]:
    """|a - b|^2 of wxyz quaternions, of both signs of `a` the nearer: 2 - 2 |a . b|, for small angles angle^2 / 4."""
    sign = torch.where((a * b).sum(dim=1, keepdim=True) < 0, -1.0, 1.0)
    return squared_norm(sign * a - b)


def rotation_angle(a: Float[Tensor, "n 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, " n"]:
    """Angle in radians, 0..pi, between two orientations given as wxyz quaternions: 2 arccos |a . b|.

    Computed as 2 atan2 of the sine and cosine of the half angle: the arccos has an infinite gradient at equal orientations.
    """
    between = rotations.quat_product(rotations.quat_conjugation(rotations.quat_wxyz_to_xyzw(b)), rotations.quat_wxyz_to_xyzw(a))
    return 2 * torch.atan2(safe_norm(between[:, :3]), between[:, 3].abs())


class _Mean:
    """Mean over all rows of several frames; zero (and no NaN) where there are none."""

    def __init__(self, zero: Tensor) -> None:
        self._zero = zero

    def __call__(self, rows: Iterable[Float[Tensor, " n"]]) -> Tensor:
        every = torch.cat([self._zero[None], *rows])
        return every.sum() / max(len(every) - 1, 1)
