"""Options of training alone, in groups: what teaches, what may be learned, which clips are shown, how fast it is learned."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from pgsd_nerfstudio.dynamics import FieldConfig, RegularizationWeights
from pgsd_nerfstudio.guidance.distillation import DistillationConfig
from pgsd_nerfstudio.guidance.schedules import Weighting

CUDA = torch.cuda.is_available()


@dataclass(frozen=True, kw_only=True)
class GuidanceOptions:
    """What teaches."""

    prior: str = "bundled"
    """The video prior: bundled (small, knows only clips like the demo's), a diffusers folder of CogVideoX or Wan 2.1, or a
    hub id such as THUDM/CogVideoX-2b or Wan-AI/Wan2.1-T2V-1.3B-Diffusers."""
    prompt: str | None = None
    """What the video prior is told; by default the effect's own prompt, or that of --weather, with the scene's description."""
    negative_prompt: str | None = None
    """What the video prior is told to keep away from; by default the effect's own."""
    scene_description: str | None = None
    """What the prompt calls the scene, such as "a garden with a table"; by default made from the scene's name."""
    distillation: DistillationConfig = field(default_factory=DistillationConfig)
    """How the video prior's predictions become a gradient; the paper's ablations of SDS variants."""
    tiny_vae: Path | None = None
    """Weights of taecvx (.safetensors or .pth), a small encoder in place of the prior's own, at a fraction of memory
    and time. How far its gradient agrees with the full one is printed at the start."""

    def check(self) -> None:
        """Raises ValueError: there are no weights where `tiny_vae` says."""
        if self.tiny_vae is not None and not self.tiny_vae.is_file():
            raise ValueError(f"no tiny VAE at {self.tiny_vae}: expected a file with the weights of taecvx")


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """What may be learned of the motion, and what holds it to the simulation."""

    dynamics: FieldConfig = field(default_factory=FieldConfig)
    """What the field may change; the paper's ablations of fixed appearance, fixed rotation and fixed motion ("w/o PG")."""
    motion: Literal["particle", "field", "deformation"] = "particle"
    """What moves a particle that has left its simulated path: its own simulated velocity (the paper), that of the place where
    it is (field), or no simulation at all but a learned deformation of scattered particles (the paper's "w/o Motion")."""
    begin: Literal["rollout", "simulation"] = "rollout"
    """Where a training clip starts: from the state that the roll-out reaches, or from the simulation (the paper's code), which
    never shows training the drift of the full-length video."""
    gradient_frames: int | None = None
    """Frames through which the gradient follows the recurrence: the whole clip by default, 1 as in the paper's code."""
    regularization: RegularizationWeights = field(default_factory=RegularizationWeights)
    """Weights of the physics and appearance losses; --regularization.without xyz leaves one out, app all of the appearance."""
    weights: Weighting = "adaptive"
    """How the physics and appearance losses are weighed: times the magnitude of the video loss (the paper), as they are, or by
    one of the paper's schedules over the training (all three worse, it says)."""

    def check(self) -> None:
        """Raises ValueError: the gradient runs through no frame."""
        if self.gradient_frames is not None and self.gradient_frames < 1:
            raise ValueError(f"--gradient-frames must be at least 1, got {self.gradient_frames}")


@dataclass(frozen=True, kw_only=True)
class ClipOptions:
    """Which clips training shows to the video prior."""

    trajectory: Literal["near", "any"] = "near"
    """Camera path of a training clip: from a random training view to one of the six nearest, or to any other, as in the paper
    (whose straight way through a ring of views leads across its middle within a third of a second)."""
    surfaces_in_clips: bool | None = None
    """Whether training clips show the scene's answer (cover, wetness, light, haze), as every other picture does. By default
    they do, except with the bundled prior, which has only ever seen flakes in a scene that stays as it is."""
    layers: int | None = None
    """Without a GPU: press the frozen scene behind every 16x16 pixels into so many layers, which makes training frames faster
    at a small error (64 for 96x64 pixels, 16 for larger ones). The error, larger where particles lie on surfaces than where
    they fly, is printed with the first clip; by default exact."""
    clip_frames: int | None = None
    """Frames of a training clip; by default 9 as in the paper, or what the video prior was made for if that is less."""
    clip_height: int | None = None
    """Height of a training clip in pixels; by default what the video prior was made for."""
    clip_width: int | None = None
    """Width of a training clip in pixels; by default what the video prior was made for."""
    clip_every: int = 20
    """Steps between training clips that go to the log as pictures, their frames side by side (--vis tensorboard); 0: never."""

    def check(self) -> None:
        """Raises ValueError: a number is out of its range, or layers are asked for where they do not exist."""
        if self.layers is not None and (CUDA or self.layers < 1):
            raise ValueError(f"--layers must be at least 1 and is meant for machines without CUDA, got {self.layers}")
        for name in ("clip_frames", "clip_height", "clip_width"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
        if self.clip_every < 0:
            raise ValueError(f"--clip-every must not be negative, got {self.clip_every}")


@dataclass(frozen=True, kw_only=True)
class LearningOptions:
    """How long and how fast it is learned."""

    steps: int | None = None
    """Training steps. By default the paper's 1000 with CUDA, on a CPU 60, as many as pass in a few minutes with the bundled
    prior. That one has only seen snow: for any other weather it teaches nothing good, so that by default nothing is learned
    from it, and the run keeps the simulated motion and the curated look."""
    lr: float = 1e-4 if CUDA else 1e-3
    """Learning rate of the field at the start, falling to zero along a cosine. The paper's 1e-4 is meant for 1000 steps; the
    few steps of a CPU need the larger one."""
    look_lr: float = 2e-3 if CUDA else 2e-2
    """Learning rate of the look that all particles share, along the same cosine: 14 numbers (logits, log scales, colours), each
    of which can move by no more than the sum of all rates."""
    refresh_every: int = 50
    """Steps between roll-outs of the whole weather, which keep the look of collided particles for the clips in between; active
    particles are always where the present weights lead them."""

    def check(self) -> None:
        """Raises ValueError: a number of steps is not positive, or a rate is negative."""
        for name in ("steps", "refresh_every"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}")
        for name in ("lr", "look_lr"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"--{name.replace('_', '-')} must not be negative, got {getattr(self, name)}")
