"""The teacher of a run: video prior, prompts and noise schedule, from a rendered clip to the gradient on its pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from pgsd_nerfstudio.guidance.distillation import DistillationConfig, DistilledClip, distill_clip
from pgsd_nerfstudio.guidance.loading import load_prior
from pgsd_nerfstudio.guidance.prompts import embed_texts, prompts_for
from pgsd_nerfstudio.guidance.schedules import TimestepSchedule
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder, gradient_cosine
from pgsd_nerfstudio.guidance.variants import Embeddings
from pgsd_nerfstudio.guidance.video_prior import VideoPrior
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import RunOptions

PAPER_FRAMES = 9

console = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class Distiller:
    """An opened video prior with its prompts embedded: it gives clips a gradient."""

    prior: VideoPrior
    wanted: str
    unwanted: str
    embeddings: Embeddings
    """Of all texts that the kind of distillation asks about, by role."""
    distillation: DistillationConfig
    timesteps: TimestepSchedule
    steps: int
    seed: int

    @staticmethod
    def of(prior: VideoPrior, options: RunOptions, description: str) -> Distiller:
        """A distiller toward the prompt of the run's effect.

        Args:
            prior: the opened video prior.
            options: of the run.
            description: what prompts call the scene.

        Raises:
            RunError: the text encoder cannot be used.
        """
        effect = options.chosen_effect()
        guidance = options.guidance
        unwanted = effect.negative_prompt if guidance.negative_prompt is None else guidance.negative_prompt
        prompts = prompts_for(effect.name, guidance.prompt or effect.prompt, unwanted, description)
        try:
            embeddings = embed_texts(prior, prompts.needed(guidance.distillation.variant))
        except (ValueError, OSError) as error:
            raise RunError(str(error)) from error
        steps, seed = options.training_steps, options.training_seed
        return Distiller(prior, prompts.text, unwanted, embeddings, guidance.distillation, TimestepSchedule(), steps, seed)

    def gradient(self, clip: Float[Tensor, "t 3 h w"], step: int) -> DistilledClip:
        """Which way a clip should change. The noise depends on the seed and the step only.

        Args:
            clip: pictures in 0..1.
            step: number of the training step.

        Raises:
            RunError: the prior cannot take clips of this shape.
            FloatingPointError: its prediction is not finite.
        """
        draw = torch.Generator().manual_seed(1_000_003 * self.seed + step)
        timestep = self.timesteps.sample(step, self.steps, draw)
        how = {"config": self.distillation, "generator": draw, "progress": step / self.steps}
        try:
            return distill_clip(self.prior, clip, self.embeddings, None, timestep, **how)
        except ValueError as error:
            raise RunError(str(error)) from error


def open_prior(options: RunOptions, device: torch.device | str) -> tuple[VideoPrior, RunOptions]:
    """The video prior of a run, and the options with the size of the training clips settled.

    Args:
        options: of the run.
        device: where the prior computes.

    Raises:
        RunError: the prior cannot be used, or the weather is shorter than a clip.
    """
    guidance, clips, simulation = options.guidance, options.clips, options.simulation
    try:
        prior = load_prior(guidance.prior, device, frames=clips.clip_frames)
        own, height, width = prior.clip_shape
        frames = clips.clip_frames or min(own, PAPER_FRAMES)
        if guidance.tiny_vae is not None:
            prior = _through_tiny(prior, guidance.tiny_vae, frames)
    except (ValueError, OSError) as error:
        raise RunError(str(error)) from error
    if simulation.frames < frames:
        raise RunError(
            f"the weather has {simulation.frames} frames ({simulation.seconds:g} s), a training clip {frames}: "
            "use more --seconds"
        )
    sizes = {"clip_height": clips.clip_height or height, "clip_width": clips.clip_width or width}
    return prior, replace(options, clips=replace(clips, clip_frames=frames, **sizes))


def _through_tiny(prior: VideoPrior, weights: Path, frames: int) -> VideoPrior:
    """The prior with a tiny encoder before it; prints how far their gradients agree on so many frames of noise in its size."""
    tiny = TinyEncoder.load(weights, prior.device, prior.dtype)
    _, height, width = prior.clip_shape
    clip = torch.rand(frames, 3, height, width, generator=torch.Generator().manual_seed(0)).to(prior.device)
    console.print(f"tiny VAE {weights.name}: cosine of its gradient with the full one {gradient_cosine(prior, tiny, clip):.3f}")
    return prior.through(tiny)
