"""Score distillation teaches: from a wrong look of the snow, training moves towards the look whose clips the prior has seen."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from pgsd_nerfstudio.dynamics import DynamicsField, LearnedLook, Rollout, regularization
from pgsd_nerfstudio.dynamics.regularizers import RegularizationWeights
from pgsd_nerfstudio.effects import effect, initial_look
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.guidance import DistillationConfig, distill_clip, load_prior
from pgsd_nerfstudio.guidance.schedules import TimestepSchedule, regularization_scale
from pgsd_nerfstudio.physics import Clock, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import interpolate
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

STEPS = 16
PATHS = ((25, 27, 40), (8, 10, 20))  # two training views and the first frame of the clip


def wrong(look: ParticleLook) -> ParticleLook:
    """Grey, twice too large and half as opaque."""
    return ParticleLook(0.5 * look.opacity, 2.0 * look.scales, 0.5 * look.rgb)


def distances(look: InitialLook, aim: InitialLook) -> dict[str, float]:
    """How far a look is from another: mean difference of opacity and colour, mean absolute log ratio of the sizes."""
    found = {}
    for state in ("active", "collided"):
        now, then = getattr(look, state), getattr(aim, state)
        found[f"{state} opacity"] = float((now.opacity - then.opacity).abs().mean())
        found[f"{state} size"] = float((now.scales / then.scales).log().abs().mean())
        found[f"{state} colour"] = float((now.rgb - then.rgb).abs().mean())
    return found


@pytest.fixture(scope="module")
def lesson():
    """The same training twice, with the video prior and without, on the courtyard: distances before and after."""
    scene, snow = demo_scene(), effect("snowfall")
    vertices, triangles = scene.mesh
    surface = SurfaceMesh(scene.frame.to_metric(vertices), triangles)
    clock = Clock(fps=25.0, frames=60)
    history = simulate_metric(surface, snow, clock, domain_of(scene), seed=3, max_particles=20_000, progress=False)
    curated = initial_look(snow, history, seed=3)
    start = InitialLook(wrong(curated.active), wrong(curated.collided), curated.settle_seconds)
    prior, rasterizer = load_prior("bundled", "cpu"), choose_rasterizer(scene.gaussians, "cpu")
    frames, height, width = prior.clip_shape
    text = prior.encode_prompt([snow.prompt_for(scene.description)])
    against = prior.encode_prompt([snow.negative_prompt])
    paths = [interpolate(scene.cameras, a, b, frames).resized(width, height) for a, b, _ in PATHS]

    def train(taught: bool) -> dict[str, float]:
        torch.manual_seed(0)
        generator = torch.Generator().manual_seed(0)
        field, look = DynamicsField.for_history(history), LearnedLook()
        rollout = Rollout(history, start, field, look)
        optimizer = torch.optim.Adam([{"params": look.parameters(), "lr": 3e-2}, {"params": field.parameters(), "lr": 1e-3}])
        rates = [group["lr"] for group in optimizer.param_groups]
        for step in range(STEPS):
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * (0.5 + 0.5 * math.cos(math.pi * step / STEPS))
            which = step % len(PATHS)
            instants = rollout.window(PATHS[which][2], frames, begin="simulation")
            # The prior's clips were drawn with footprints that are never thinner than a pixel.
            wide = [replace(one.gaussians, antialiased=False, whole=False) for one in instants]
            weather = [scene.frame.gaussians_to_scene(one) for one in wide]
            clip = rasterizer.render(paths[which], weather).rgb.permute(0, 3, 1, 2)
            guidance, scale = torch.zeros(()), 1.0
            if taught:
                timestep = TimestepSchedule().sample(step, STEPS, generator)
                seen = clip.detach().clamp(0, 1)
                distilled = distill_clip(prior, seen, text, against, timestep, config=DistillationConfig(), generator=generator)
                guidance = (clip * distilled.gradient).sum()
                scale = regularization_scale("adaptive", distilled.loss)
            loss = guidance + RegularizationWeights().total(regularization(instants, look), scale)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            return distances(look(start), curated)

    with torch.no_grad():
        before = distances(start, curated)
    return before, train(taught=True), train(taught=False)


@pytest.mark.parametrize("quantity", ["active opacity", "active size", "active colour", "collided colour"])
def test_the_prior_moves_the_look_towards_the_one_it_has_seen(lesson, quantity):
    before, taught, untaught = lesson
    print({name: (round(before[name], 3), round(taught[name], 3), round(untaught[name], 3)) for name in before})
    assert taught[quantity] < 0.85 * before[quantity]
    assert taught[quantity] < 0.9 * untaught[quantity]
