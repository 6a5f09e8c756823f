"""Clips of the built-in courtyard, made the way training makes them: the same flakes, camera paths and rasterizer.

A path is drawn from one training view to one of its nearest, as the plugin's trajectories are; several windows of the weather
are shown along each path, because preparing the frozen scene for a camera costs more than a picture from it.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bundled_prior.families import FRAMES, HEIGHT, WIDTH, Family, draw_looks
from bundled_prior.looks import DEMO_SCENE, Look
from pgsd_nerfstudio.effects import effect, initial_look
from pgsd_nerfstudio.effects.appearance import InitialLook, ParticleLook
from pgsd_nerfstudio.physics import Clock, ParticleHistory, simulate_metric
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.cameras import Cameras, interpolate
from pgsd_nerfstudio.scene.demo import demo_scene
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

WEATHERS = (("light", 0.5, 7_000), ("moderate", 1.5, 20_000), ("moderate", 1.5, 20_000), ("heavy", 4.0, 30_000))
"""Word, mm/h, and most flakes in the air at once: on a CPU the plugin shows moderate snow with 20,000."""
NAMES = (DEMO_SCENE, DEMO_SCENE, "a courtyard", "a scene", "a garden with a table", "a table with a vase in a garden", "a yard")
NEAREST = 6
WINDOWS = 4  # per camera path
SH_CONSTANT = 0.28209479177387814


@dataclass(frozen=True)
class Weather:
    amount: str
    history: ParticleHistory
    look: InitialLook


class Courtyard:
    """Draws families of clips; simulates its weathers once, at the start."""

    def __init__(self, *, frames: int = 250) -> None:
        self.scene = demo_scene()
        vertices, triangles = self.scene.mesh
        surface = SurfaceMesh(self.scene.frame.to_metric(vertices), triangles)
        self.weathers = []
        for seed, (amount, intensity, flakes) in enumerate(WEATHERS):
            snow = effect("snowfall")
            snow = replace(snow, emission=replace(snow.emission, intensity=intensity))
            clock = Clock(fps=25.0, frames=frames)
            history = simulate_metric(
                surface, snow, clock, domain_of(self.scene), seed=seed, max_particles=flakes, progress=False
            )
            self.weathers.append(Weather(amount, history, initial_look(snow, history, seed=seed)))
        self._left = 0

    def __call__(self, rng: random.Random) -> tuple[Family, Tensor]:
        """One family and its clips [kinds, t, 3, h, w]; every WINDOWS-th call turns to a new camera path."""
        if self._left == 0:
            self._turn_to_new_path(rng)
        self._left -= 1
        weather = rng.choice(self.weathers)
        start = rng.randrange(weather.history.frames - FRAMES + 1)
        family = Family(draw_looks(rng), weather.amount, rng.choice(NAMES))
        return family, torch.stack([self._clip(weather, start, look) for look in family.looks])

    def _turn_to_new_path(self, rng: random.Random) -> None:
        views = self.scene.cameras
        first = rng.randrange(len(views))
        away = (views.centers - views.centers[first]).norm(dim=1)
        last = int(away.argsort()[rng.randrange(1, NEAREST + 1)])
        self._path: Cameras = interpolate(views, first, last, FRAMES).resized(WIDTH, HEIGHT)
        self._rasterizer = choose_rasterizer(_developed(self.scene.gaussians, rng), "cpu")
        self._still = self._rasterizer.render(self._path).rgb.permute(0, 3, 1, 2)
        self._left = WINDOWS

    def _clip(self, weather: Weather, start: int, look: Look | None) -> Float[Tensor, "t 3 h w"]:
        if look is None:
            return self._still.clamp(0, 1)
        history, shown = weather.history, with_look(weather.look, look)
        dynamic = [self.scene.frame.gaussians_to_scene(simulated(history, shown, start + t)) for t in range(FRAMES)]
        return self._rasterizer.render(self._path, dynamic).rgb.permute(0, 3, 1, 2).clamp(0, 1)


def with_look(curated: InitialLook, look: Look) -> InitialLook:
    """The initial look of the effect, changed by the factors of `look`, in the air and on the surface alike."""

    def changed(part: ParticleLook) -> ParticleLook:
        tint = torch.tensor(look.tint)
        return ParticleLook(
            (part.opacity * look.opacity).clamp(0, 0.98), part.scales * look.size, (part.rgb * tint).clamp(0, 1)
        )

    return InitialLook(changed(curated.active), changed(curated.collided), curated.settle_seconds)


def simulated(history: ParticleHistory, look: InitialLook, frame: int) -> Gaussians:
    """The Gaussians of one frame in metres, as an untrained field shows them."""
    flying, lying = history.active(frame), history.resting(frame)
    active, landed = look.active.select(flying), look.collided_at(history, frame, lying)
    return Gaussians(
        torch.cat([history.positions_at(frame, flying), history.rest_positions[lying]]),
        torch.cat([history.quats[flying], history.rest_quats[lying]]),
        torch.cat([active.scales, landed.scales]),
        torch.cat([active.opacity, landed.opacity]),
        torch.cat([active.rgb, landed.rgb]),
        antialiased=True,
        whole=True,
    )


def _developed(gaussians: Gaussians, rng: random.Random) -> Gaussians:
    """The scene in another light, half of the time: exposure and tint change, so that its colours are no constants."""
    if rng.random() < 0.5:
        return gaussians
    exposure = 2 ** rng.uniform(-0.7, 0.4)
    gain = torch.tensor([exposure * rng.uniform(0.85, 1.15) for _ in range(3)])
    if rng.random() < 0.3:  # another season: channels change places
        colors = gaussians.colors[..., torch.tensor(rng.sample(range(3), 3))] * gain
    else:
        colors = gaussians.colors * gain
    if gaussians.sh_degree is not None:  # colour = 0.5 + SH_CONSTANT * first coefficient + ...
        colors[:, 0] += 0.5 * (gain - 1) / SH_CONSTANT
    return replace(gaussians, colors=colors)
