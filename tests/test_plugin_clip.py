"""The gradient of a training clip: frame by frame it must be the same as through one graph over everything."""

from types import SimpleNamespace

import pytest
import torch
from plugin_scene import write_scene

from pgsd_nerfstudio.dynamics import DynamicsField, LearnedLook, Rollout
from pgsd_nerfstudio.effects import effect, initial_look
from pgsd_nerfstudio.physics.clock import Clock, Domain
from pgsd_nerfstudio.physics.metric import simulate_metric
from pgsd_nerfstudio.plugin.clip import render_clip, seen_by, surrogate
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.response.prepare import answer_of
from pgsd_nerfstudio.scene.cameras import interpolate
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.weather.loading import load_scene
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene

START, FRAMES = 14, 3
BACKGROUND = torch.tensor([0.2, 0.3, 0.4])


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A scene with 200 flakes above a floor, and a field that has learned something at random."""
    ply = write_scene(tmp_path_factory.mktemp("scene"))
    scene = load_scene(ply, ply.parent)
    rasterizer = choose_rasterizer(scene.gaussians, "cpu")
    prepared = PreparedScene(scene, rasterizer, rasterizer, torch.device("cpu"))
    corners = torch.tensor([[-4.0, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
    floor = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    domain = Domain((-3.5, -3.5, -0.3), (3.5, 3.5, 2.5))
    history = simulate_metric(floor, effect("snowfall"), Clock(frames=24), domain, max_particles=200, progress=False)
    torch.manual_seed(0)
    field, look = DynamicsField.for_history(history), LearnedLook()
    with torch.no_grad():
        for parameter in [*field.parameters(), *look.parameters()]:
            parameter += 0.01 * torch.randn_like(parameter)
    rollout = Rollout(history, initial_look(effect("snowfall"), history), field, look)
    cameras = interpolate(scene.cameras, 0, 1, FRAMES)
    gradient = torch.randn(FRAMES, 3, cameras.height, cameras.width, generator=torch.Generator().manual_seed(1))
    answer = answer_of(scene, floor, effect("snowfall"), seconds=1.0)
    return SimpleNamespace(
        prepared=prepared,
        moments=[answer.at((START + k) / history.fps) for k in range(FRAMES)],
        history=history,
        rollout=rollout,
        cameras=cameras,
        gradient=gradient,
        learned=[*field.parameters(), *look.parameters()],
    )


def weather(world: SimpleNamespace, visible=None) -> list:
    clip = world.rollout.window(START, FRAMES, visible=visible)
    return [world.prepared.scene.frame.gaussians_to_scene(instant.gaussians) for instant in clip]


def test_frame_by_frame_gives_the_gradient_of_the_whole_graph(world: SimpleNamespace):
    picture = world.prepared.rasterizer.render(world.cameras, weather(world), BACKGROUND, world.moments).rgb.permute(0, 3, 1, 2)
    whole = torch.autograd.grad((picture * world.gradient).sum(), world.learned, allow_unused=True)
    total, norms = surrogate(world.prepared, world.cameras, weather(world), BACKGROUND, world.moments, world.gradient)
    parts = torch.autograd.grad(total, world.learned, allow_unused=True)
    assert sum(g is not None and bool(g.any()) for g in whole) > 10
    for a, b in zip(whole, parts, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            assert float((a - b).norm()) <= 1e-4 * float(a.norm()) + 1e-9
    assert all(norm > 0 for norm in norms.values())


def test_the_air_of_a_moment_dims_the_gradient_of_what_moves_in_it(world: SimpleNamespace):
    through, clear = (
        surrogate(world.prepared, world.cameras, weather(world), BACKGROUND, moments, world.gradient)[1]["colors"]
        for moments in (world.moments, [None] * FRAMES)
    )
    assert all(moment is not None and moment.medium is not None for moment in world.moments)
    assert 0 < through < clear


def test_particles_out_of_sight_change_nothing(world: SimpleNamespace):
    seen = seen_by(world.prepared, world.cameras, world.history, START)
    assert 0 < int(seen.sum()) < len(seen)
    every = render_clip(world.prepared, world.cameras, weather(world), BACKGROUND, world.moments)
    some = render_clip(world.prepared, world.cameras, weather(world, seen), BACKGROUND, world.moments)
    assert float((every - some).abs().max()) < 0.02 and float((every - some).square().mean()) < 1e-6


def test_a_clip_without_particles_has_a_gradient_of_nothing(world: SimpleNamespace):
    nothing = [one.select(torch.zeros(0, dtype=torch.long)) for one in weather(world)]
    total, norms = surrogate(world.prepared, world.cameras, nothing, BACKGROUND, world.moments, world.gradient)
    assert float(total) == 0 and not any(norms.values())
