"""One training clip: roll out, render, ask the distiller, and carry its gradient back frame by frame.

The gradient on the pixels comes first, from a clip rendered without a graph. Then each frame is rendered again and
differentiated by itself, so that at no time there is a graph over all frames; what reaches the Gaussians of the roll-out goes
on from there with nerfstudio's own backward pass, through a surrogate that has this gradient.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.moment import Moment
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene

# By so much a particle may lie outside of the picture and still count as seen:
SLACK = 0.1  # m, for its size and what it has learned
BLUR = 3  # pixels, for the rasterizer's blur


class Stopwatch:
    """Seconds of each part of one step."""

    def __init__(self, device: torch.device) -> None:
        self.seconds: dict[str, float] = {}
        self._wait: Callable[[], object] = torch.cuda.synchronize if device.type == "cuda" else lambda: None

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._wait()
        self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start


def seen_by(prepared: PreparedScene, cameras: Cameras, history: ParticleHistory, start: int) -> Bool[Tensor, " p"]:
    """Particles that appear in at least one picture of a clip, in the simulated motion.

    Args:
        prepared: the scene.
        cameras: of the clip, one a frame, in scene units.
        history: the simulated motion.
        start: first frame of the clip.
    """
    seen = torch.zeros(len(history), dtype=torch.bool, device=history.device)
    stop = start + len(cameras)
    window = history.window(start, stop)
    inside = torch.stack([_inside(prepared, cameras[k], window.positions[:, k]) for k in range(len(cameras))], dim=1)
    seen[window.ids[(inside & window.active).any(1)]] = True
    resting = history.resting(stop - 1)
    at_rest = history.rest_positions[resting]
    for k in range(len(cameras)):
        seen[resting[_inside(prepared, cameras[k], at_rest)]] = True
    return seen


def _inside(prepared: PreparedScene, camera: Cameras, metres: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    viewmat, K = camera.viewmats[0].to(metres), camera.Ks[0].to(metres)
    slack = SLACK / prepared.scene.frame.metres_per_unit
    local = prepared.scene.frame.to_scene(metres) @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = local.unbind(1)
    right, left = (camera.width + BLUR - K[0, 2]) / K[0, 0], (-BLUR - K[0, 2]) / K[0, 0]
    below, above = (camera.height + BLUR - K[1, 2]) / K[1, 1], (-BLUR - K[1, 2]) / K[1, 1]
    beside = (x > right * z + slack) | (x < left * z - slack) | (y > below * z + slack) | (y < above * z - slack)
    return (z > -slack) & ~beside


def render_clip(
    prepared: PreparedScene,
    cameras: Cameras,
    weather: Sequence[Gaussians],
    background: Float[Tensor, "3"],
    moments: Sequence[Moment | None],
) -> Float[Tensor, "t 3 h w"]:
    """The clip in 0..1, without a graph.

    Args:
        prepared: the scene.
        cameras: of the clip, one a frame.
        weather: the particles of each frame, in scene units.
        background: colour behind the scene.
        moments: the answer of the scene at each frame; None: as it was trained.
    """
    with torch.no_grad():
        return prepared.clip_rasterizer.render(cameras, weather, background, moments).rgb.permute(0, 3, 1, 2).clamp(0, 1)


def surrogate(
    prepared: PreparedScene,
    cameras: Cameras,
    weather: Sequence[Gaussians],
    background: Float[Tensor, "3"],
    moments: Sequence[Moment | None],
    gradient: Float[Tensor, "t 3 h w"],
) -> tuple[Float[Tensor, ""], dict[str, float]]:
    """A scalar whose gradient is that of the loss, and the norm of what reached each quantity of the Gaussians.

    Args:
        prepared: as for `render_clip`.
        cameras: as for `render_clip`.
        weather: the particles of each frame, in scene units, with the graph of the roll-out.
        background: as for `render_clip`.
        moments: as for `render_clip`.
        gradient: of the loss with respect to the clip.
    """
    total = gradient.new_zeros(())
    squares: dict[str, float] = {}
    for k, gaussians in enumerate(weather):
        if len(gaussians) == 0:
            continue
        names = [name for name, tensor in gaussians.tensors.items() if tensor.requires_grad]
        if not names:
            continue
        leaves = {name: getattr(gaussians, name).detach().requires_grad_() for name in names}
        picture = prepared.clip_rasterizer.render(
            cameras[k], replace(gaussians.detach(), **leaves), background, moments[k]
        ).rgb[0]
        found = torch.autograd.grad(picture, list(leaves.values()), gradient[k].permute(1, 2, 0), allow_unused=True)
        for name, on_leaf in zip(names, found, strict=True):
            if on_leaf is not None:
                total = total + (getattr(gaussians, name) * on_leaf).sum()
                squares[name] = squares.get(name, 0.0) + float(on_leaf.square().sum())
    return total, {name: square**0.5 for name, square in squares.items()}
