"""Motion without simulation: Gaussians spread over the box and moved by a network of place and time alone.

The paper's ablation "w/o Motion": in place of its 4D Gaussian splatting (Wu et al. 2024, a deformation of canonical Gaussians
by time) the same backbone and encodings as the field's, so that only the source of motion differs. There are no births, no
landings and no recurrence. A DeformedCloud is used like a Rollout; the terms xyz, vel and rot then hold it to its first places
and must be left out (RegularizationWeights.without) for the ablation as published.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pgsd_nerfstudio.dynamics.encodings import WIDTH, fourier, sinusoidal
from pgsd_nerfstudio.dynamics.field import LOOK, ActiveDelta, StateNet, within
from pgsd_nerfstudio.dynamics.in_sight import Eye
from pgsd_nerfstudio.dynamics.look import LOG_SCALE_BOUND, Change, LearnedLook, accumulate, changed
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame
from pgsd_nerfstudio.dynamics.sequence import Begin, GaussianSequence, Progress
from pgsd_nerfstudio.dynamics.state import Deltas, turned
from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians


@dataclass(frozen=True, kw_only=True)
class DeformationConfig:
    """Bounds of a Gaussian's displacement and turn."""

    reach: float = 0.5
    """Largest displacement per axis as a share of the box along it: half the box, so that one can fall through a good part."""
    rotation: float = math.pi
    """Largest turn about each axis in radians."""


class Deformation(nn.Module):
    """Network of initial position and time; zero heads, its start, deform nothing. Every output is bounded (bound x tanh)."""

    box: Tensor

    def __init__(self, box: Float[Tensor, "2 3"], frames: int, config: DeformationConfig | None = None) -> None:
        """Set up with zero heads.

        Args:
            box: corners of the domain in metres.
            frames: length of the sequence.
            config: bounds of the deformation; None: the defaults.
        """
        super().__init__()
        self.frames, self.config = frames, config or DeformationConfig()
        self.register_buffer("box", box.detach().clone().float())
        self.net = StateNet({"position": 3, "rotation": 3, **LOOK}, 2 * WIDTH)

    def forward(
        self, position: Float[Tensor, "n 3"], frame: int
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Change]:  # m, rad about the particle's own axes
        """Displacement, rotation vector and change of look at a frame, of Gaussians spread at `position` (metres)."""
        out = self.net(fourier(within(self.box, position)), sinusoidal(frame / self.frames, self.box))
        low, high = self.box
        change = Change(out["opacity"][:, 0], LOG_SCALE_BOUND * out["scale"], out["rgb"])
        return self.config.reach * (high - low) * out["position"], self.config.rotation * out["rotation"], change


def scattered(box: Float[Tensor, "2 3"], like: ParticleHistory, count: int, *, seed: int = 0) -> ParticleHistory:
    """Particles at random places of a box, active and unmoved in all frames.

    Args:
        box: corners in metres.
        like: particles to take sizes, orientations and the number of frames from.
        count: number of particles.
        seed: of places and sizes.

    Raises:
        ValueError: there is nothing to scatter, or no particle to take a size from.
    """
    if count < 1 or len(like) < 1:
        raise ValueError(f"scattering takes at least one particle and one to be like, got {count} like {len(like)}")
    rng = torch.Generator().manual_seed(seed)
    low, high = box.to(like.positions)
    places = low + torch.rand(count, 3, generator=rng).to(like.positions) * (high - low)
    chosen = torch.randint(len(like), (count,), generator=rng).to(like.device)
    zeros = torch.zeros(count, dtype=torch.int32, device=like.device)
    return ParticleHistory(
        births=zeros,
        ends=zeros + like.frames,
        collided=zeros.bool(),
        offsets=torch.arange(count + 1, device=like.device) * like.frames,
        positions=places.repeat_interleave(like.frames, dim=0),
        rest_positions=torch.zeros_like(places),
        rest_quats=like.quats[chosen],
        rest_extents=like.rest_extents[chosen],
        rest_covers=torch.zeros_like(like.rest_covers[chosen]),
        quats=like.quats[chosen],
        diameters=like.diameters[chosen],
        represents=like.represents[chosen],
        reaches=like.reaches[chosen],
        kinds=torch.zeros_like(like.kinds[chosen]),
        fps=like.fps,
        frames=like.frames,
        about={"scattered": count, "seed": seed},
    )


class _Deformed(NamedTuple):
    """Some particles at one frame."""

    ids: Int[Tensor, " n"]
    moved: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    change: Change


class DeformedCloud(GaussianSequence):
    """Scattered Gaussians that a network of place and time moves, without recurrence."""

    def __init__(
        self, history: ParticleHistory, look: InitialLook, deformation: Deformation, learned_look: LearnedLook | None = None
    ) -> None:
        """Set up without evaluating anything.

        Args:
            history: particles as `scattered` makes them.
            look: initial look of all particles.
            deformation: the network.
            learned_look: the shift of the look that all particles share; None means none.

        Raises:
            ValueError: a particle is not active in all frames.
        """
        active = (history.births == 0) & (history.ends == history.frames)
        if not bool(active.all()):
            raise ValueError(
                f"a deformed cloud has neither births nor landings, but {int((~active).sum())} of {len(history)} particles are "
                f"not active in all {history.frames} frames"
            )
        super().__init__(history, look, learned_look)
        self.deformation = deformation

    @property
    def stale(self) -> bool:
        """False: without recurrence no state is kept that could be out of date."""
        return False

    def refresh(self, progress: Progress | None = None) -> None:
        """Does nothing: without recurrence no state has to be kept."""

    def _at(self, frame: int, visible: Bool[Tensor, " p"] | None, look: InitialLook, eye: Eye | None = None) -> RolloutFrame:
        """Every Gaussian of the cloud is shown to every camera."""
        return self._rendered(frame, self._deformed(frame, visible, look), None, look)

    def _clip(
        self, start: int, frames: int, visible: Bool[Tensor, " p"] | None, begin: Begin, gradient_frames: int | None
    ) -> list[RolloutFrame]:
        """Without recurrence `begin` and `gradient_frames` do nothing. Deltas are the differences to the frame before, so that
        the appearance terms of the loss mean what they do elsewhere."""
        # The learned look is worked out anew at each use: one for the whole clip would add up its gradient in another order,
        # and trainings would not repeat to the bit.
        before, clip = self._deformed(start - 1, visible, self._present_look()) if start else None, []
        for frame in range(start, start + frames):
            now = self._deformed(frame, visible, self._present_look())
            clip.append(self._rendered(frame, now, before, self._present_look()))
            before = now
        return clip

    def _deformed(self, frame: int, visible: Bool[Tensor, " p"] | None, look: InitialLook) -> _Deformed:
        ids = self.history.active(frame)
        ids = ids if visible is None else ids[visible[ids]]
        moved, rotation, change = self.deformation(self.history.positions_at(0, ids), frame)
        change = accumulate(look.active.select(ids), Change.none(len(ids), moved), change)
        return _Deformed(ids, moved, turned(self.history.quats[ids], rotation), change)

    def _rendered(self, frame: int, now: _Deformed, before: _Deformed | None, initial: InitialLook) -> RolloutFrame:
        ids, moved, quats, change = now
        look = changed(initial.active.select(ids), change)
        places = self.history.positions_at(0, ids) + moved
        gaussians = Gaussians(places, quats, look.scales, look.opacity, look.rgb, antialiased=True, whole=True)
        deltas = None if before is None else _deltas(before, now)
        return RolloutFrame(frame, gaussians, ids, ids[:0], moved, quats, self.history.quats[ids], deltas)


def _deltas(before: _Deformed, now: _Deformed) -> Deltas:
    back = rotations.quat_conjugation(rotations.quat_wxyz_to_xyzw(before.quats))
    rotation = rotations.unitquat_to_rotvec(rotations.quat_product(back, rotations.quat_wxyz_to_xyzw(now.quats)))
    change = Change(*(b - a for a, b in zip(before.change, now.change, strict=True)))
    return Deltas(ActiveDelta(now.moved - before.moved, rotation, change), Change.none(0, now.moved))
