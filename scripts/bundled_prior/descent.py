"""The test that counts: from a wrong look of the snow, does score distillation with this prior lead to the curated one?

Only the 14 numbers that all flakes share are moved (opacity, scale and colour, in the air and landed), with the plugin's own
guidance and learning rate, on the courtyard, from a look that is grey, twice too large and half as opaque.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from bundled_prior.courtyard import simulated, with_look
from bundled_prior.families import FRAMES, HEIGHT, WIDTH
from bundled_prior.looks import WRONG
from pgsd_nerfstudio.dynamics.look import LearnedLook
from pgsd_nerfstudio.effects import effect, initial_look
from pgsd_nerfstudio.guidance import DistillationConfig, distill_clip, load_prior
from pgsd_nerfstudio.physics import Clock, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import interpolate
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

CLIPS = 6


@dataclass(frozen=True)
class Descent:
    """Means over all particles relative to the curated look: opacity, scale and brightness, for flying and landed ones."""

    rows: list[tuple[int, dict[str, float]]]
    """Every fifth step."""
    clips: list[Float[Tensor, "t 3 h w"]]
    """Every fifth step."""

    def table(self) -> list[str]:
        return [f"step {step:3d}  " + "  ".join(f"{k} {v:.2f}" for k, v in row.items()) for step, row in self.rows]


def descend(
    folder: Path | str,
    *,
    negative: str,
    steps: int = 40,
    rate: float = 2e-2,
    guidance_scale: float = 100.0,
    max_particles: int = 20_000,
    seed: int = 0,
) -> Descent:
    """Distils with the bundled prior's classifier-free guidance against `negative`.

    Six clips take turns, because preparing the frozen scene for a new camera costs more than all else.
    """
    scene, snow = demo_scene(), effect("snowfall")
    vertices, triangles = scene.mesh
    surface = SurfaceMesh(scene.frame.to_metric(vertices), triangles)
    clock = Clock(fps=25.0, frames=125)
    history = simulate_metric(surface, snow, clock, domain_of(scene), seed=97, max_particles=max_particles, progress=False)
    curated = initial_look(snow, history, seed=97)
    wrong, learned = with_look(curated, WRONG), LearnedLook()
    prior, rasterizer = load_prior(folder, "cpu"), choose_rasterizer(scene.gaussians, "cpu")
    text = prior.encode_prompt([snow.prompt_for(scene.description)])
    against = prior.encode_prompt([negative.format(scene=scene.description)])
    optimizer = torch.optim.Adam(learned.parameters(), lr=rate, betas=(0.9, 0.99))
    generator = torch.Generator().manual_seed(seed)
    config = DistillationConfig(guidance_scale=guidance_scale)
    rows, clips, draws, views = [], [], [], scene.cameras
    for _ in range(CLIPS):
        first = int(torch.randint(len(views), (), generator=generator))
        away = (views.centers - views.centers[first]).norm(dim=1).argsort()
        last = int(away[int(torch.randint(1, 7, (), generator=generator))])
        start = int(torch.randint(clock.frames - FRAMES + 1, (), generator=generator))
        draws.append((interpolate(views, first, last, FRAMES).resized(WIDTH, HEIGHT), start))
    for step in range(steps + 1):
        look = learned(wrong)
        path, start = draws[step % CLIPS]
        dynamic = [scene.frame.gaussians_to_scene(simulated(history, look, start + t)) for t in range(FRAMES)]
        clip = rasterizer.render(path, dynamic).rgb.permute(0, 3, 1, 2)
        if step % 5 == 0:
            rows.append((step, _relative(look, curated)))
            clips.append(clip.detach())
        for group in optimizer.param_groups:
            group["lr"] = rate * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        t_max = round(980 - 240 * step / steps)
        t = int(torch.randint(20, t_max + 1, (), generator=generator))
        gradient = distill_clip(prior, clip, text, against, t, config=config, generator=generator).gradient
        optimizer.zero_grad()
        clip.backward(gradient)
        optimizer.step()
    return Descent(rows, clips)


def _relative(look, curated) -> dict[str, float]:
    found = {}
    for name in ("active", "collided"):
        now, aim = getattr(look, name), getattr(curated, name)
        found[f"{name} opacity"] = float((now.opacity.mean() / aim.opacity.mean()).detach())
        found[f"{name} scale"] = float((now.scales / aim.scales).log().mean().exp().detach())
        found[f"{name} brightness"] = float((now.rgb.mean() / aim.rgb.mean()).detach())
    return found
